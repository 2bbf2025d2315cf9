# SPDX-License-Identifier: GPL-3.0-or-later
"""--frames: which of the frames that there are a command does, and what it tells of them."""
from __future__ import annotations

import argparse
from collections.abc import Sequence

from ..core.conventions.frame_numbers import Frame, absent, chosen
from ..core.system.progress import Progress


def add_option(parser: argparse.ArgumentParser,
               what: str = "frame numbers, such as 1-20,31 or 1-99:2; all where not given") -> None:
    """--frames."""
    parser.add_argument("--frames", metavar="A-B", help=what)


def asked(known: Sequence[Frame], text: str | None, progress: Progress) -> list[Frame]:
    """The frames of `known` that --frames asks for; what it asks for besides is told. Raises SettingsError where none
    of them is there."""
    frames = chosen(known, text)
    if missing := absent(known, text):
        numbers = [frame.number for frame in known]
        progress.say(f"The frames {missing} are not there: they are {min(numbers)} to {max(numbers)}.")
    return frames
