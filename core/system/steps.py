# SPDX-License-Identifier: GPL-3.0-or-later
"""Long computations in short steps, between which a window stays responsive.

A function in steps is a generator: it yields after each step, and returns the result. `finish` runs it in one go. A
window runs several steps in a turn; `yield PAUSE` ends the turn, after a step that gives the window work of its own.
"""
from __future__ import annotations

from collections.abc import Generator
from typing import Any, TypeVar

Result = TypeVar("Result")
PAUSE = "pause"
"""Yielded after a step after which the window is to work before the next step."""
Steps = Generator[Any, None, Result]
"""A computation in steps with a result of this type; it yields None or PAUSE."""

FRAMES_PER_STEP = 25
"""Frames that a loop over the frames of a capture handles in one step, some milliseconds of work."""


def finish(steps: Steps[Result]) -> Result:
    """Run all steps; return the result. Raises what the steps raise."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: Result = end.value
            return result
