# SPDX-License-Identifier: GPL-3.0-or-later
"""--frames: selects the frames that a command processes."""
from __future__ import annotations

import argparse
from collections.abc import Sequence

from ..core.conventions.frame_numbers import NumberedFrame, missing_numbers, select_frames, select_task_frames
from ..core.system.progress import Progress


def add_option(parser: argparse.ArgumentParser,
               description: str = "frame numbers, such as 1-20,31 or 1-99:2 (default: all)") -> None:
    """Add --frames, with this description."""
    parser.add_argument("--frames", metavar="A-B", help=description)


def add_job_option(parser: argparse.ArgumentParser) -> None:
    """Add --job-frames, by which a task of a farm knows the frames of its whole job."""
    parser.add_argument("--job-frames", metavar="A-B",
                        help="on a farm: the frames of the whole job, of which --frames is one task's; a task whose "
                             "frames do not exist has nothing to do, as long as others of the job exist")


def select(known: Sequence[NumberedFrame], text: str | None, progress: Progress) -> list[NumberedFrame]:
    """Return the frames of `known` that --frames selects, and report the selected numbers that do not exist.

    Raises SettingsError where none of them exists.
    """
    frames = select_frames(known, text)
    _report_missing(known, text, progress)
    return frames


def select_task(known: Sequence[NumberedFrame], args: argparse.Namespace, progress: Progress) -> list[NumberedFrame]:
    """Return the frames of `known` that --frames selects for one task of a farm, and report missing numbers.

    --job-frames lists the frames of the whole job: a task none of whose frames exists gets an empty list, which is
    reported. Raises SettingsError where none of the job's frames exists.
    """
    frames = select_task_frames(known, args.frames, args.job_frames)
    _report_missing(known, args.frames, progress)
    if not frames and args.frames is not None:
        progress.say(f"None of the frames {args.frames} exists, so nothing is to be done here.")
    return frames


def _report_missing(known: Sequence[NumberedFrame], text: str | None, progress: Progress) -> None:
    if missing := missing_numbers(known, text):
        numbers = [frame.number for frame in known]
        progress.say(f"The frames {missing} do not exist; there are {min(numbers)} to {max(numbers)}.")
