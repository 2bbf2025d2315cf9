# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors by kind, and the sentences for what the system refuses.

Every message is one sentence for the user: what is wrong, where, and what to do. The commands and the add-on print it
unchanged; any other exception that escapes is a defect.
"""
from __future__ import annotations

import errno
from collections.abc import Sequence


class FitFlareError(Exception):
    """Base of all errors whose message is for the user."""


class SettingsError(FitFlareError):
    """A setting or argument that is invalid."""


class CaptureError(FitFlareError):
    """A capture folder, camera model, lights or split file that cannot be used."""


class FrameError(FitFlareError):
    """A picture that cannot be read or written."""


class FlareFileError(FitFlareError):
    """A .flare or PLY file that cannot be read."""


class RunError(FitFlareError):
    """A run folder that is missing, damaged, or made with other settings."""


class EngineError(FitFlareError):
    """A part of the engine that is needed and not installed."""


class Cancelled(FitFlareError):
    """The user or the system stopped a long job; what is on disk is whole."""


class SpecialFileError(OSError):
    """A named pipe, a socket or a device in the place of a file; `strerror` says which."""


MAX_SPELLED_OUT = 20
"""Number of failures that a joint message spells out."""


def join_failures(failures: Sequence[str]) -> str:
    """Join the sentences of several failures; after the first MAX_SPELLED_OUT, say how many more there are."""
    more = f" And {len(failures) - MAX_SPELLED_OUT} more." if len(failures) > MAX_SPELLED_OUT else ""
    return " ".join(failures[:MAX_SPELLED_OUT]) + more


DISK_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))
"""Error numbers of a full disk or an exhausted quota."""


def is_out_of_memory(problem: BaseException) -> bool:
    """Return whether an exception says that memory is short.

    torch has a class for that of graphics cards; for the processor's it raises RuntimeError, as OpenCV does.
    """
    return (isinstance(problem, MemoryError) or type(problem).__name__ == "OutOfMemoryError"
            or any(text in str(problem) for text in ("DefaultCPUAllocator", "Insufficient memory")))


def os_error_message(problem: OSError) -> str:
    """Return the sentence for what the system refused: a full disk, a folder that is not writable, ..."""
    where = f" ({problem.filename})" if problem.filename else ""
    if problem.errno in DISK_FULL:
        return f"The disk is full{where}; make room and start it again, what is finished is kept."
    if isinstance(problem, SpecialFileError):
        return f"A file cannot be used: {problem.strerror}{where}; put a file in its place or choose another path."
    if isinstance(problem, IsADirectoryError):
        return f"The path of a file to write is a folder{where}; choose another name."
    if isinstance(problem, FileExistsError | NotADirectoryError):
        return f"The path of a folder to create is a file{where}; choose another name or move the file."
    if problem.errno == errno.ELOOP:
        return f"A symbolic link leads back to itself{where}; remove it or choose another path."
    return f"The system refused: {problem.strerror or problem}{where}."
