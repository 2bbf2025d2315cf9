# SPDX-License-Identifier: GPL-3.0-or-later
"""What the scripts here have in common: how their work is shown, stopped and refused, and how a process with Blender's
module in it keeps quiet and ends."""
from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import NoReturn

from core.errors import FitFlareError, refusal
from core.system.progress import Progress, TerminalProgress, stoppable


def run(work: Callable[[Progress], None]) -> int:
    """Do the work in the terminal; its exit code. What goes wrong is told in one sentence."""
    progress = TerminalProgress()
    try:
        with stoppable(progress):
            work(progress)
    except FitFlareError as problem:
        progress.error(str(problem))
        return 1
    except OSError as problem:
        progress.error(refusal(problem))
        return 1
    finally:
        progress.close()
    return 0


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Blender's own lines go to the null device for as long as this context lasts."""
    sys.stdout.flush()
    saved, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    try:
        yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(null)


def leave(code: int) -> NoReturn:
    """End the process at once: Blender's library may hang when its interpreter winds down."""
    sys.stdout.flush()
    os._exit(code)
