# SPDX-License-Identifier: GPL-3.0-or-later
"""Processes: the cores that this one may use, what another is started with, by what status ours end, on which machine
they run, and whether one that was written down still runs, known by its number and by when it began, since systems give
the numbers of ended ones out again."""
from __future__ import annotations

import contextlib
import os
import platform
import re
import subprocess
import sys
import time
import uuid
from functools import lru_cache
from pathlib import Path
from typing import Any

WINDOWS = os.name == "nt"
DONE, FAILED, MISUSED, STOPPED = 0, 1, 2, 130
"""Statuses of our commands: done; it could not be; the words made no sense; it was asked to stop, and did."""
PROC = Path("/proc")
SLACK_S = 5.0
"""By which the clocks of the two may differ."""
DAY_S = 86400
CENTURY_S = 36525 * DAY_S
"""No process is as old."""


def python_at(place: Path) -> Path | None:
    """The interpreter that `place` is, or that the virtual environment in it has; on Windows conda has it at the top of
    the environment. None, too, where the Python that the environment was made from is gone."""
    for path in (place, place / "Scripts" / "python.exe", place / "bin" / "python", place / "python.exe"):
        if os.path.isfile(path) and not (WINDOWS and _lacks_its_base(path)):  # noqa: PTH113 - pathlib's may raise
            return path.absolute()  # not resolved: a virtual environment's python is a link
    return None


def _lacks_its_base(python: Path) -> bool:
    """Whether a virtual environment's python.exe, on Windows no link but a program that starts another, has lost that:
    the Blender that it was made by, say, has been replaced by a newer one."""
    try:
        told = (python.parent.parent / "pyvenv.cfg").read_text(encoding="utf-8", errors="replace")
    except OSError:  # it is its own base
        return False
    home = re.search(r"^home\s*=\s*(.+?)\s*$", told, re.MULTILINE)
    return home is not None and not Path(home[1], "python.exe").is_file()


def environment() -> dict[str, str]:
    """This environment, less what would lead another Python to the modules of this one."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONHOME", "PYTHONPATH")}


def own_group() -> dict[str, Any]:
    """Options of Popen that keep a terminal's Ctrl-C from a child, so that it is stopped by its parent alone."""
    if WINDOWS:
        return {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}
    return {"start_new_session": True}


@lru_cache(maxsize=1)
def machine() -> str:
    """What tells this machine from others that see the same folders, today and later: its name. A Mac's changes with
    the network, so there it is a name that was made up once and is kept for the user; elsewhere a user's folder may be
    the same on many machines."""
    if sys.platform == "darwin":
        with contextlib.suppress(OSError, RuntimeError, ValueError):  # of a user without a home, too
            return _made_up(Path.home() / "Library" / "Application Support" / "fit_flare" / "machine")
    return platform.node()


def _made_up(file: Path) -> str:
    """The name that the file holds; one is made up where there is none."""
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        fresh = file.with_name(f"{file.name}.{uuid.uuid4()}")
        try:
            fresh.write_text(str(uuid.uuid4()), encoding="utf-8")
            with contextlib.suppress(FileExistsError):  # another process was first
                os.link(fresh, file)
        finally:
            fresh.unlink(missing_ok=True)
    return file.read_text(encoding="utf-8")


def cores() -> int:
    """Those that this process may use: a farm or a container often gives it a few of many."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def is_same(pid: int, started: float) -> bool:
    """Whether the process that was begun and written down at `started`, seconds since the epoch, still runs.

    One that began later has come by its number; so has one that began earlier, where what was written down is of
    another machine or of the time before it was started anew.
    """
    began = _began(pid)
    return began is not None and abs(began - started) <= SLACK_S


def runs(pid: int) -> bool:
    """Whether there is a process of that number."""
    if WINDOWS or PROC.is_dir():
        return _began(pid) is not None
    try:
        os.kill(pid, 0)
    except PermissionError:  # it is somebody else's
        return True
    except OSError:
        return False
    return True


def _began(pid: int) -> float | None:
    """Seconds since the epoch; None where no such process runs."""
    try:
        if WINDOWS:
            return _told_by_windows(pid)
        return _told_by_proc(pid) if PROC.is_dir() else _told_by_ps(pid)
    except (OSError, ValueError, IndexError):
        return None


def _told_by_windows(pid: int) -> float | None:
    import ctypes

    kernel = ctypes.windll.kernel32  # type: ignore[attr-defined,unused-ignore]
    kernel.OpenProcess.restype = ctypes.c_void_p
    handle = ctypes.c_void_p(kernel.OpenProcess(0x1000, False, pid))
    if not handle:
        return None
    code, times = ctypes.c_ulong(), [ctypes.c_ulonglong() for _ in range(4)]
    kernel.GetExitCodeProcess(handle, ctypes.byref(code))
    kernel.GetProcessTimes(handle, *map(ctypes.byref, times))
    kernel.CloseHandle(handle)
    if code.value != 259:  # STILL_ACTIVE
        return None
    return times[0].value / 1e7 - 11_644_473_600  # tenths of microseconds since 1601


def _told_by_proc(pid: int) -> float | None:
    after_name = (PROC / str(pid) / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    if after_name[0] in "ZX":  # it has ended, and nobody has asked how
        return None
    booted = re.search(r"^btime (\d+)", (PROC / "stat").read_text(encoding="utf-8"), re.MULTILINE)
    return int(booted[1]) + int(after_name[19]) / os.sysconf("SC_CLK_TCK") if booted else None


def _told_by_ps(pid: int) -> float | None:
    """By its age: [[days-]hours:]minutes:seconds. Of one that has just begun procps tells 441077234 days now and
    then."""
    told = subprocess.run(["ps", "-o", "etime=", "-p", str(pid)], capture_output=True, text=True, check=False)
    days, _, clock = told.stdout.strip().rpartition("-")
    if not clock:
        return None
    age = 0
    for part in clock.split(":"):
        age = age * 60 + int(part)
    age += DAY_S * int(days or 0)
    return time.time() - (age if age < CENTURY_S else 0)
