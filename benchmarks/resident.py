# SPDX-License-Identifier: GPL-3.0-or-later
"""Memory that this process holds."""
from __future__ import annotations

import sys
from pathlib import Path

import psutil

MEGABYTE = 1e6
_KIBIBYTE = 1024


def held() -> float:
    """MB, now."""
    return float(psutil.Process().memory_info().rss) / MEGABYTE


def held_at_most() -> float:
    """MB, since this program began.

    Linux' getrusage would count the program that started this one, too.
    """
    if sys.platform == "win32":
        return float(psutil.Process().memory_info().peak_wset) / MEGABYTE
    if sys.platform == "linux":
        status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
        return int(status["VmHWM"].split()[0]) * _KIBIBYTE / MEGABYTE
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MEGABYTE
