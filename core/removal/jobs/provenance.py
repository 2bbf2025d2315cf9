# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the flare-free frames in a capture's folder removed/ come from: someone's hand, or `remove`, and of what."""
from __future__ import annotations

from pathlib import Path

from ...capture import REMOVED, Capture
from ...errors import CaptureError
from .manifest import Record


def has_exact(capture: Capture) -> bool:
    """Whether a capture has clean frames that are taken for exact: someone's own, made here and all worked on since, or
    where there is no removed/ the layers of a scene that is known. As `remove` makes them they are estimates."""
    if not capture.has_removed:
        return capture.has_truth
    return not any(Record(capture.folder / REMOVED).as_made(_sources(capture)))


def check_removed(capture: Capture) -> None:
    """Raises CaptureError where the capture has clean frames that were made here from others than it has now. Those of
    which nothing is written down are someone's own."""
    folder, sources = capture.folder / REMOVED, _sources(capture)
    if others := Record(folder).made_from_others(sources):
        raise CaptureError(f"{len(others)} of the {len(sources)} flare-free frames in {folder} were made from other "
                           f"frames than the capture has now ({others[0].as_posix()} first); remove that folder, and "
                           "they are made again.")


def _sources(capture: Capture) -> dict[Path, Path]:
    """Of every clean frame, by its name below removed/, the frame that it is of."""
    folder = (capture.folder / REMOVED).resolve()
    frames = {capture.removed_path(view).resolve(): view for view in capture.views}
    return {path.relative_to(folder): capture.frame_path(view) for path, view in frames.items()
            if path.is_relative_to(folder)}
