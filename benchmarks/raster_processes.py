# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory, start and instruction sets of the kernel sets, measured by `raster.py --probe` in processes of their own."""
from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.report import milliseconds, table

SCRIPT = Path(__file__).with_name("raster.py")
INSTRUCTION_SETS = {
    "native": {},
    "AVX2": {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma,+bmi,+bmi2,+popcnt,+f16c,+lzcnt"},
    "SSE4.2": {"NUMBA_CPU_NAME": "nehalem", "NUMBA_CPU_FEATURES": "+sse4.2,+popcnt"},
}


def process_section(kernel_sets: list[str]) -> str:
    """Return the tables of memory, first call and instruction sets, each figure from a process of its own."""
    rows = []
    for name in kernel_sets:
        if name == "torch":
            continue
        cells = _probe("memory", name)
        rows.append([name, f"{cells['before']:.0f}", f"{cells['peak']:.0f}"])
    text = table(["Resident memory, training 50k at 480x270, MB", "after import", "peak"], rows)
    if "cpu" not in kernel_sets:
        return text
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = (_probe("start", "cpu", FIT_FLARE_CACHE=cache) for _ in range(2))
    rows = [
        [label, f"{cells['import']:.1f}", f"{cells['first']:.1f}", f"{cells['second'] * 1e3:.0f} ms"]
        for label, cells in (("empty cache: compiles", cold), ("from the cache", warm))
    ]
    text += "\n\n" + table(
        ["Start of a process", "imports (torch, numba), s", "first iteration, s", "second iteration"], rows
    )
    rows = []
    for label, variables in INSTRUCTION_SETS.items():
        with tempfile.TemporaryDirectory() as cache:
            _probe("start", "cpu", FIT_FLARE_CACHE=cache, **variables)  # compiles
            rows.append([label, milliseconds(_probe("both", "cpu", FIT_FLARE_CACHE=cache, **variables)["both"])])
    return text + "\n\n" + table(["50k, 480x270, forward + backward, ms, all threads", "cpu"], rows)


def _probe(measurement: str, kernel_set: str, **variables: str) -> dict[str, float]:
    """Return what `raster.py --probe WHAT KERNELS` measures (see `probe` there), with these environment variables."""
    process = subprocess.run(
        [sys.executable, str(SCRIPT), "--probe", measurement, kernel_set],
        env={**os.environ, **variables}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return json.loads(process.stdout.splitlines()[-1])
