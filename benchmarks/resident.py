# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory of the process that is measured, told by itself; `memory.py` asks from outside."""
from __future__ import annotations

import sys
from pathlib import Path

import psutil

_MEGABYTE = 1e6


def held() -> float:
    """MB, now."""
    return float(psutil.Process().memory_info().rss) / _MEGABYTE


def held_at_most() -> float:
    """MB, since this program began.

    Linux' getrusage would count the program that started this one, too.
    """
    if sys.platform == "win32":
        return float(psutil.Process().memory_info().peak_wset) / _MEGABYTE
    if sys.platform == "linux":
        status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
        return int(status["VmHWM"].split()[0]) * 1024 / _MEGABYTE
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _MEGABYTE
