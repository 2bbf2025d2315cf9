# SPDX-License-Identifier: GPL-3.0-or-later
"""Write tables into the documents of docs/results, each between its own markers, draw plots, and describe the
machine."""
from __future__ import annotations

import os
import platform
import re
from collections.abc import Sequence
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
"""Documents that hold measured tables and their pictures."""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; all columns but the first are aligned to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def milliseconds(seconds: float | None) -> str:
    """Format seconds as milliseconds with three digits; None as a dash."""
    if seconds is None:
        return "–"
    value = seconds * 1e3
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def processor() -> str:
    """Return the processor's model, its widest vectors, and the cores that this process may use, as text."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    models = re.findall(r"^model name\s*: (.*)$", text, re.M) or [platform.machine()]
    flags = set(text.split())
    vectors = next((name for flag, name in (("avx512f", "AVX-512"), ("avx2", "AVX2")) if flag in flags), "SSE or NEON")
    code_matches = [re.findall(rf"^{key}\s*: (\d+)$", text, re.M) for key in ("cpu family", "model")]
    code = f" (family {code_matches[0][0]}, model {code_matches[1][0]})" if all(code_matches) else ""
    return f"{models[0]}{code}, {vectors}, {len(os.sched_getaffinity(0))} cores"


def conditions() -> str:
    """Return a line on the processor, the system, versions, and whether the machine is idle."""
    import numba

    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    activity = "idle" if load < 0.5 else f"under other load ({load:.1f})"
    return (
        f"{processor()}; {platform.system()} {platform.machine()}, Python {platform.python_version()}, "
        f"torch {torch.__version__.split('+')[0]}, numba {numba.__version__}; machine {activity} at the start."
    )


def write_section(path: Path, name: str, text: str) -> None:
    """Replace the text between the markers of this name in a document; append text and markers if these are missing."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    old_text = path.read_text(encoding="utf-8") if path.exists() else "# Results\n"
    section = f"{begin}\n{text.strip()}\n{end}"
    if begin in old_text and end in old_text:
        before, after = old_text.split(begin, 1)
        new_text = before + section + after.split(end, 1)[1]
    else:
        new_text = old_text.rstrip() + "\n\n" + section + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(new_text, encoding="utf-8")


def plot_times(times_by_set: dict[str, dict[str, float]], picture: Path) -> None:
    """Write a plot of times, ms, against the number of Gaussians, with a line for each kernel set.

    times_by_set: seconds by number of Gaussians (as text), by kernel set.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 3.6), layout="constrained")
    for name, times in times_by_set.items():
        thousands = [int(count) / 1000 for count in times]
        axes.plot(thousands, [seconds * 1e3 for seconds in times.values()], "o-", label=name)
    axes.set(xlabel="Gaussians, thousands", ylabel="forward + backward, ms", xlim=(0, None), ylim=(0, None))
    axes.set_title(f"480x270, {torch.get_num_threads()} threads", fontsize=10)
    axes.grid(alpha=0.3)
    if len(times_by_set) > 1:
        axes.legend()
    figure.savefig(picture, dpi=150)
    pyplot.close(figure)
