# SPDX-License-Identifier: GPL-3.0-or-later
"""Tables in docs/engine.md, each between markers of its own, and a description of the machine."""
from __future__ import annotations

import os
import platform
import re
from collections.abc import Sequence
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Markdown; columns but the first to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def milliseconds(seconds: float | None) -> str:
    """Three digits; a dash for what was not measured."""
    if seconds is None:
        return "–"
    value = seconds * 1e3
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def processor() -> str:
    """Model, cores in use and widest vectors."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    models = re.findall(r"^model name\s*: (.*)$", text, re.M) or [platform.machine()]
    words = set(text.split())
    wide = next((name for flag, name in (("avx512f", "AVX-512"), ("avx2", "AVX2")) if flag in words), "SSE or NEON")
    codes = [re.findall(rf"^{key}\s*: (\d+)$", text, re.M) for key in ("cpu family", "model")]
    code = f" (family {codes[0][0]}, model {codes[1][0]})" if all(codes) else ""
    return f"{models[0]}{code}, {wide}, {len(os.sched_getaffinity(0))} cores"


def conditions() -> str:
    """One line: machine, versions, and whether anything else was running."""
    import numba

    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    idle = "idle" if load < 0.5 else f"with other work (load {load:.1f}), so that ratios say more than times"
    return (
        f"{processor()}; {platform.system()} {platform.machine()}, Python {platform.python_version()}, "
        f"torch {torch.__version__.split('+')[0]}, numba {numba.__version__}; machine {idle} at the start."
    )


def write_section(path: Path, name: str, text: str) -> None:
    """Replaces what stands between the markers of this name, or appends it."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    old = path.read_text(encoding="utf-8") if path.exists() else "# The engine, measured\n"
    section = f"{begin}\n{text.strip()}\n{end}"
    if begin in old and end in old:
        before, rest = old.split(begin, 1)
        new = before + section + rest.split(end, 1)[1]
    else:
        new = old.rstrip() + "\n\n" + section + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(new, encoding="utf-8")
