# SPDX-License-Identifier: GPL-3.0-or-later
"""Processes: usable cores, environment and options of child processes, exit statuses, and whether a process still runs.

A process that was written down is identified by its id and its start time, since systems use the ids of ended processes
again. The command line, the add-on's jobs and `files.py` use this module.
"""
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
DONE, FAILED, USAGE_ERROR, STOPPED = 0, 1, 2, 130
"""Exit statuses of the commands: success; failure; invalid arguments; stopped on request."""
PROC = Path("/proc")
CLOCK_TOLERANCE_S = 5.0
"""Allowed difference between the recorded start time and the system's."""
DAY_S = 86400
CENTURY_S = 36525 * DAY_S
"""Upper bound for the age of a process."""


def find_python(path: Path) -> Path | None:
    """Return the Python interpreter at a path: the file itself, or the python of a virtual environment or (Windows)
    conda environment in that folder.

    None if there is none, or if the Python that a virtual environment was made from is gone.
    """
    for python in (path, path / "Scripts" / "python.exe", path / "bin" / "python", path / "python.exe"):
        if os.path.isfile(python) and not (WINDOWS and _is_base_missing(python)):  # noqa: PTH113 - pathlib's may raise
            return python.absolute()  # not resolved: a virtual environment's python is a link
    return None


def _is_base_missing(python: Path) -> bool:
    """Return whether a virtual environment's python.exe, which on Windows starts another program, has lost that
    program.

    For instance because the Blender that made the environment has been replaced by a newer one.
    """
    try:
        config = (python.parent.parent / "pyvenv.cfg").read_text(encoding="utf-8", errors="replace")
    except OSError:  # no virtual environment: python.exe is the interpreter itself
        return False
    home = re.search(r"^home\s*=\s*(.+?)\s*$", config, re.MULTILINE)
    return home is not None and not Path(home[1], "python.exe").is_file()


def child_environment() -> dict[str, str]:
    """Return this process's environment without the variables that lead another Python to its modules."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONHOME", "PYTHONPATH")}


def new_process_group() -> dict[str, Any]:
    """Return options of Popen that keep a terminal's Ctrl-C from a child, so that only its parent stops it."""
    if WINDOWS:
        return {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}
    return {"start_new_session": True}


@lru_cache(maxsize=1)
def machine_id() -> str:
    """Return a name of this machine that never changes and differs from those of other machines with the same folders.

    It is the host name; on a Mac, whose host name changes with the network, a random name in a file of the user. Other
    systems get no such file, since their machines may share a user's folder.
    """
    if sys.platform == "darwin":
        with contextlib.suppress(OSError, RuntimeError, ValueError):  # RuntimeError: the user has no home
            return _read_or_create_id(Path.home() / "Library" / "Application Support" / "fit_flare" / "machine")
    return platform.node()


def _read_or_create_id(file: Path) -> str:
    """Return the name that the file holds; write a random one where there is none."""
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_name(f"{file.name}.{uuid.uuid4()}")
        try:
            temporary.write_text(str(uuid.uuid4()), encoding="utf-8")
            with contextlib.suppress(FileExistsError):  # another process was first
                os.link(temporary, file)
        finally:
            temporary.unlink(missing_ok=True)
    return file.read_text(encoding="utf-8")


def available_cores() -> int:
    """Number of cores that this process may use: a farm or a container often grants a few of many."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def is_same_process(pid: int, started: float) -> bool:
    """Return whether the process that was recorded with start time `started`, seconds since the epoch, still runs.

    A process with another start time has the id by coincidence: it began later, or the record is of another machine or
    of the time before this one was restarted.
    """
    actual_start = _start_time(pid)
    return actual_start is not None and abs(actual_start - started) <= CLOCK_TOLERANCE_S


def is_running(pid: int) -> bool:
    """Return whether a process of that id exists."""
    if WINDOWS or PROC.is_dir():  # on Windows os.kill would end it; /proc also shows which have ended
        return _start_time(pid) is not None
    try:
        os.kill(pid, 0)
    except PermissionError:  # another user's
        return True
    except OSError:
        return False
    return True


def _start_time(pid: int) -> float | None:
    """Start time of a process, seconds since the epoch; None where no such process runs."""
    try:
        if WINDOWS:
            return _start_time_windows(pid)
        return _start_time_proc(pid) if PROC.is_dir() else _start_time_ps(pid)
    except (OSError, ValueError, IndexError):
        return None


def _start_time_windows(pid: int) -> float | None:
    """Return the start time of a running process, seconds since 1970; None where there is none."""
    import ctypes

    kernel = ctypes.windll.kernel32  # type: ignore[attr-defined,unused-ignore]
    kernel.OpenProcess.restype = ctypes.c_void_p
    handle = ctypes.c_void_p(kernel.OpenProcess(0x1000, False, pid))  # PROCESS_QUERY_LIMITED_INFORMATION
    if not handle:
        return None
    exit_code, times = ctypes.c_ulong(), [ctypes.c_ulonglong() for _ in range(4)]
    kernel.GetExitCodeProcess(handle, ctypes.byref(exit_code))
    kernel.GetProcessTimes(handle, *map(ctypes.byref, times))
    kernel.CloseHandle(handle)
    if exit_code.value != 259:  # STILL_ACTIVE
        return None
    return times[0].value / 1e7 - 11_644_473_600  # tenths of microseconds since 1601


def _start_time_proc(pid: int) -> float | None:
    """Return the start time of a running process by /proc, seconds since 1970; None where there is none."""
    after_name = (PROC / str(pid) / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    if after_name[0] in "ZX":  # ended, and its parent has not read its status
        return None
    booted = re.search(r"^btime (\d+)", (PROC / "stat").read_text(encoding="utf-8"), re.MULTILINE)
    # Field 22 of the line, starttime: clock ticks since the system started.
    return int(booted[1]) + int(after_name[19]) / os.sysconf("SC_CLK_TCK") if booted else None


def _start_time_ps(pid: int) -> float | None:
    """Return the start time of a running process by the age that ps prints, [[days-]hours:]minutes:seconds; None where
    there is none.

    An age above CENTURY_S counts as 0: for a process that has just begun, procps sometimes prints 441077234 days.
    """
    listing = subprocess.run(["ps", "-o", "etime=", "-p", str(pid)], capture_output=True, text=True, check=False)
    days, _, clock = listing.stdout.strip().rpartition("-")
    if not clock:
        return None
    age = 0
    for part in clock.split(":"):
        age = age * 60 + int(part)
    age += DAY_S * int(days or 0)
    return time.time() - (age if age < CENTURY_S else 0)
