# SPDX-License-Identifier: GPL-3.0-or-later
"""Reports what a command found in a capture or a folder of frames before its work, and what it left out in its last
line."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.images.listing import pictures_in, unlisted_entries
from ..core.system.progress import Progress
from ..core.system.tally import Tally

if TYPE_CHECKING:
    from ..core.capture import Capture


def report_capture(capture: Capture, progress: Progress) -> None:
    """Report the warnings about a capture before it is used."""
    for warning in capture.warnings:
        progress.say(warning)


def tally_capture(capture: Capture, verb: str = "used", used: int | None = None) -> Tally:
    """Return the tally of a capture's frames. verb: what was done with them. used: how many (default: all views)."""
    tally = Tally("frame", verb)
    tally.use(len(capture.views) if used is None else used)
    tally.merge(capture.left_out.items())
    return tally


def tally_solve(report: Mapping[str, Any], source: Path) -> Tally:
    """Return the tally of a solve by its report (solve.json): frames without a place, unreadable ones, other files."""
    tally = Tally("frame", "placed")
    tally.use(report["registered"])
    tally.skip("no place in the model", *report["unregistered"])
    names = [path.name for path in pictures_in(source)] if source.is_dir() else []
    for message in report["left_out"]:  # "PATH is damaged or truncated; export it again."
        # Each message becomes the name of a file and a reason without the advice.
        name = next((name for name in names if message.startswith(f"{source / name} ")), "")
        problem = message.removeprefix(f"{source / name} ").partition(";")[0].partition(" (")[0].rstrip(".")
        tally.skip(problem, name or source.name)
    if source.is_dir():
        tally.merge(unlisted_entries(source))
    return tally


def report_tally(tally: Tally, progress: Progress) -> dict[str, Any]:
    """Report a tally, as the last line of a command; return it for the command's result."""
    progress.say(tally.summary())
    return {"tally": tally.as_result()}
