# SPDX-License-Identifier: GPL-3.0-or-later
"""A folder that one process has to itself for as long as a long job runs in it, by a lock of the system's, which goes
with the process however that ends. For a short turn in a folder that many write to there is `files.locked`."""
from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from ..errors import RunError

_LOCK = ".held"
_TAKEN = (errno.EACCES, errno.EAGAIN, errno.EWOULDBLOCK, errno.EDEADLK)


@contextlib.contextmanager
def held(folder: Path | str) -> Iterator[None]:
    """Have a folder. It is made where it is missing, and removed again at the end if nothing was put into it.

    Raises RunError where another process has it. On a disk that knows no locks nobody is kept out.
    """
    folder = Path(folder)
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    lock = folder / _LOCK
    descriptor = _locked(lock)
    if descriptor is None:
        raise RunError(f"Another process is at work in {folder}; wait for its end or stop it, or choose another "
                       "folder.")
    try:
        yield
    finally:
        _remove(lock, descriptor)
        if made:
            with contextlib.suppress(OSError):  # what is in it stays
                folder.rmdir()


def _locked(lock: Path) -> int | None:
    """The descriptor of the file, which is locked until that is closed; None where it is locked already."""
    while True:
        descriptor = os.open(lock, os.O_CREAT | os.O_RDWR)
        try:
            _lock(descriptor)
            if os.path.samestat(os.fstat(descriptor), lock.stat()):
                return descriptor
        except FileNotFoundError:  # who had it removed it meanwhile
            pass
        except OSError as problem:
            if problem.errno not in _TAKEN:
                return descriptor
            os.close(descriptor)
            return None
        os.close(descriptor)


def _lock(descriptor: int) -> None:
    """Until the file is closed, by whom that may be; OSError at once where it is locked."""
    if sys.platform == "win32":
        import msvcrt

        os.lseek(descriptor, 0, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _remove(lock: Path, descriptor: int) -> None:
    """While it is locked, or another process could have it and a third one a new file; but Windows removes no open
    file."""
    steps = [lambda: os.close(descriptor), lock.unlink]
    for step in steps if sys.platform == "win32" else reversed(steps):
        with contextlib.suppress(OSError):
            step()
