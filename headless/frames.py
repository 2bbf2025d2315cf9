# SPDX-License-Identifier: GPL-3.0-or-later
"""--frames: selects the frames that a command processes."""
from __future__ import annotations

import argparse
from collections.abc import Sequence

from ..core.conventions.frame_numbers import NumberedFrame, missing_numbers, select_frames
from ..core.system.progress import Progress


def add_option(parser: argparse.ArgumentParser,
               description: str = "frame numbers, such as 1-20,31 or 1-99:2 (default: all)") -> None:
    """Add --frames, with this description."""
    parser.add_argument("--frames", metavar="A-B", help=description)


def select(known: Sequence[NumberedFrame], text: str | None, progress: Progress) -> list[NumberedFrame]:
    """Return the frames of `known` that --frames selects, and report the selected numbers that do not exist.

    Raises SettingsError where none of them exists.
    """
    frames = select_frames(known, text)
    if missing := missing_numbers(known, text):
        numbers = [frame.number for frame in known]
        progress.say(f"The frames {missing} do not exist; there are {min(numbers)} to {max(numbers)}.")
    return frames
