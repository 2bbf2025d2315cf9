# SPDX-License-Identifier: GPL-3.0-or-later
"""Fault injection: runs commands of the program in forks of one warm process, with one file operation failing or fatal.

`inject.c`, compiled by the system's compiler and preloaded, counts the opens, writes, fsyncs, renames and unlinks below
one folder, and fails the N-th. The process that forks has loaded the program, so an attempt costs little more than the
work itself. Linux alone; `reason_to_skip` says what a machine lacks.
"""
from __future__ import annotations

import ctypes
import mmap
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

SOURCE = Path(__file__).with_name("inject.c")
CALLS = ("open", "write", "fsync", "rename", "unlink")
ERRORS = ("ENOSPC", "EIO", "EACCES")
_LIBRARY = "FAULT_LIBRARY"
"""Variable with the path of the library in the preloaded process."""


class Fault(NamedTuple):
    """Call number `number` (from 1) of kind `call` fails with `error`, or kills where that is "kill".

    Number 0 only counts. sticky: so do all later calls, as on a disk that stays full.
    """

    call: str
    number: int
    error: str = "ENOSPC"
    sticky: bool = False

    def __str__(self) -> str:
        """The fault in a few words."""
        return f"{self.call} {self.number} {self.error}{' and all later ones' if self.sticky else ''}"


class Outcome(NamedTuple):
    """status: exit status of a command, negative for a signal. text: its output. counts: calls by kind."""

    status: int
    text: str
    counts: dict[str, int]


def reason_to_skip() -> str:
    """Return why faults cannot be injected on this machine, or ""."""
    if not sys.platform.startswith("linux"):
        return "faults are injected on Linux alone"
    return "" if shutil.which("cc") else "there is no C compiler (cc)"


def start_preloaded(script: Path, argv: Sequence[str], folder: Path) -> int:
    """Compile the fault library into `folder` and run a Python script with it preloaded; return the exit status."""
    library, counter = folder / "inject.so", folder / "counter"
    subprocess.run(["cc", "-O1", "-Wall", "-shared", "-fPIC", str(SOURCE), "-o", str(library), "-ldl"], check=True)
    counter.write_bytes(bytes(8 * len(CALLS)))
    variables = {"LD_PRELOAD": str(library), "FAULT_COUNTER": str(counter), "FAULT_CALL": "none",
                 _LIBRARY: str(library), "FAULT_FOLDER": "/nowhere", "OMP_NUM_THREADS": "1",
                 "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, "-P", str(script), *argv], env={**os.environ, **variables},
                          check=False).returncode


def is_preloaded() -> bool:
    """True in a process that `start_preloaded` started."""
    return _LIBRARY in os.environ


class Injector:
    """Runs commands in forks of this process, which has the library preloaded. log: file for their output."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._library = ctypes.CDLL(os.environ[_LIBRARY])
        with open(os.environ["FAULT_COUNTER"], "r+b") as stream:
            self._counter = mmap.mmap(stream.fileno(), 8 * len(CALLS))

    def run(self, argv: Sequence[str], folder: Path, fault: Fault, limit_s: float = 120.0) -> Outcome:
        """Run a command in a fork, with one fault in its calls on files below `folder`; return how it ended.

        Raises TimeoutError, and kills the fork, where it takes longer than `limit_s`.
        """
        self._counter[:] = bytes(8 * len(CALLS))
        sys.stdout.flush()
        pid = os.fork()
        if not pid:
            self._run_in_fork(argv, folder, fault)
        end, status = time.monotonic() + limit_s, None
        while status is None:
            if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            elif time.monotonic() > end:
                os.killpg(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                raise TimeoutError(f"{' '.join(argv)} still ran after {limit_s:g} s at {fault}")
            else:
                time.sleep(0.01)
        counts = struct.unpack(f"{len(CALLS)}q", self._counter[:])
        return Outcome(status, self._log.read_text(errors="replace"), dict(zip(CALLS, counts, strict=True)))

    def _run_in_fork(self, argv: Sequence[str], folder: Path, fault: Fault) -> None:
        """Run a command in the child of a fork, its output going to the log, and end the child with the command's
        status."""
        from fit_flare.headless import cli

        status = 99
        try:
            os.setpgid(0, 0)
            log = os.open(self._log, os.O_CREAT | os.O_TRUNC | os.O_WRONLY | os.O_APPEND, 0o666)
            os.dup2(log, 1)
            os.dup2(log, 2)
            real = os.path.realpath(folder)
            os.environ.update(FAULT_CALL=fault.call, FAULT_NUMBER=str(fault.number), FAULT_ERRNO=fault.error,
                              FAULT_STICKY=str(int(fault.sticky)), FAULT_FOLDER=real)
            self._library.fault_arm(fault.call.encode(), ctypes.c_long(fault.number), fault.error.encode(),
                                    int(fault.sticky), os.fsencode(real))
            status = cli.main(list(argv))
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
