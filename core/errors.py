# SPDX-License-Identifier: GPL-3.0-or-later
"""What can go wrong, by kind.

Every message is one sentence for the person at the other end: what is wrong, where, and what to do.
The commands and the add-on show it as it stands; anything else that escapes is a defect of ours.
"""
from __future__ import annotations

import errno
from collections.abc import Sequence


class FitFlareError(Exception):
    """Base of all errors whose message is meant to be read by the user."""


class SettingsError(FitFlareError):
    """A setting or argument that makes no sense."""


class CaptureError(FitFlareError):
    """A capture folder, camera model, lights or split file that cannot be used."""


class FrameError(FitFlareError):
    """A picture that cannot be read or written."""


class FlareFileError(FitFlareError):
    """A .flare or PLY file that cannot be read."""


class RunError(FitFlareError):
    """A run folder that is missing, damaged, or made with other settings."""


class EngineError(FitFlareError):
    """The part of the engine that was asked for is not installed here."""


class Cancelled(FitFlareError):
    """The user, or the system, asked a long job to stop; what is on disk is whole."""


_MOST = 20
"""Failures that are spelled out in the last sentence of many."""


def spelled_out(failures: Sequence[str]) -> str:
    """The sentences of what failed, one after the other; of many the first, and how many more there are."""
    more = f" And {len(failures) - _MOST} more." if len(failures) > _MOST else ""
    return " ".join(failures[:_MOST]) + more


DISK_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))


def is_out_of_memory(problem: BaseException) -> bool:
    """Whether it says that memory is short: torch has a class for that of graphics cards, and for the processor's no
    more than words in a RuntimeError, as OpenCV has."""
    return (isinstance(problem, MemoryError) or type(problem).__name__ == "OutOfMemoryError"
            or any(words in str(problem) for words in ("DefaultCPUAllocator", "Insufficient memory")))


def refusal(problem: OSError) -> str:
    """The sentence for what the system refused: a full disk, a folder that may not be written, …"""
    where = f" ({problem.filename})" if problem.filename else ""
    if problem.errno in DISK_FULL:
        return f"The disk is full{where}; make room and start it again, what is finished is kept."
    if isinstance(problem, IsADirectoryError):
        return f"There is a folder where a file is to be written{where}; name another."
    if isinstance(problem, FileExistsError | NotADirectoryError):
        return f"There is a file where a folder is to be{where}; name another, or move it away."
    if problem.errno == errno.ELOOP:
        return f"A symbolic link leads back to itself{where}; remove it, or name another place."
    return f"The system refused: {problem.strerror or problem}{where}."
