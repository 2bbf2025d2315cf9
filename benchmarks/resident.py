# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory of the calling process; `memory.py` measures other processes."""
from __future__ import annotations

import sys
from pathlib import Path

import psutil

_MEGABYTE = 1e6


def resident_memory() -> float:
    """Return the resident memory, MB."""
    return float(psutil.Process().memory_info().rss) / _MEGABYTE


def peak_memory() -> float:
    """Return the peak resident memory of this program, MB.

    On Linux VmHWM is read, since getrusage would include the parent process.
    """
    if sys.platform == "win32":
        return float(psutil.Process().memory_info().peak_wset) / _MEGABYTE
    if sys.platform == "linux":
        status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
        return int(status["VmHWM"].split()[0]) * 1024 / _MEGABYTE
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _MEGABYTE
