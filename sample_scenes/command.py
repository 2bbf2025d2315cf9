# SPDX-License-Identifier: GPL-3.0-or-later
"""Helpers that the scripts here share: progress, cancellation and errors in the terminal, and a quiet Blender that
exits cleanly."""
from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import NoReturn

from core.errors import FitFlareError, os_error_message
from core.system.progress import Progress, TerminalProgress, stop_on_request


def run_command(work: Callable[[Progress], None]) -> int:
    """Do the work with progress in the terminal and return the exit code. An error is printed as one sentence."""
    progress = TerminalProgress()
    try:
        with stop_on_request(progress):
            work(progress)
    except FitFlareError as problem:
        progress.error(str(problem))
        return 1
    except OSError as problem:
        progress.error(os_error_message(problem))
        return 1
    finally:
        progress.close()
    return 0


@contextlib.contextmanager
def silence_blender() -> Iterator[None]:
    """Send to the null device what Blender's library writes to standard output (file descriptor 1) in this context."""
    sys.stdout.flush()
    saved, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    try:
        yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(null)


def exit_process(code: int) -> NoReturn:
    """End the process at once: Blender's library may hang when its interpreter shuts down."""
    sys.stdout.flush()
    os._exit(code)
