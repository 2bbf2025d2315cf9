# SPDX-License-Identifier: GPL-3.0-or-later
"""Locks a folder for one process for the length of a job: fit, solve and training take it.

The lock is the operating system's and ends with the process, however that ends. `files.file_lock` is for a short turn
in a folder that many processes write to.
"""
from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from ..errors import RunError

LOCK_FILE = ".held"
_ALREADY_LOCKED = (errno.EACCES, errno.EAGAIN, errno.EWOULDBLOCK, errno.EDEADLK)
"""Error numbers that say that another process has the lock."""


@contextlib.contextmanager
def folder_lock(folder: Path | str) -> Iterator[None]:
    """Lock a folder. It is created where it is missing, and removed at the end if nothing was put into it.

    Raises RunError where another process has it. On a disk that supports no locks, no process is refused.
    """
    folder = Path(folder)
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    lock = folder / LOCK_FILE
    descriptor = _open_locked(lock)
    if descriptor is None:
        raise RunError(f"Another process is using {folder}; wait until it ends or stop it, or choose another "
                       "folder.")
    try:
        yield
    finally:
        _remove_lock_file(lock, descriptor)
        if is_new:
            with contextlib.suppress(OSError):  # not empty
                folder.rmdir()


def _open_locked(lock: Path) -> int | None:
    """Return the descriptor of the lock file, locked until it is closed; None where another process has it."""
    while True:
        descriptor = os.open(lock, os.O_CREAT | os.O_RDWR)
        try:
            _lock(descriptor)
            # Its last holder may have removed this file before it was locked; then try again with a new one.
            if os.path.samestat(os.fstat(descriptor), lock.stat()):
                return descriptor
        except FileNotFoundError:  # its holder removed the file in between: try again
            pass
        except OSError as problem:
            if problem.errno not in _ALREADY_LOCKED:
                return descriptor  # a disk without locks
            os.close(descriptor)
            return None
        os.close(descriptor)


def _lock(descriptor: int) -> None:
    """Lock the file until it is closed; raises OSError at once where it is locked."""
    if sys.platform == "win32":
        import msvcrt

        os.lseek(descriptor, 0, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _remove_lock_file(lock: Path, descriptor: int) -> None:
    """Remove the lock file while it is locked: after unlocking, a second process could lock it and a third a new file.

    Windows removes no open file, so there it is closed first.
    """
    steps = [lambda: os.close(descriptor), lock.unlink]
    for step in steps if sys.platform == "win32" else reversed(steps):
        with contextlib.suppress(OSError):
            step()
