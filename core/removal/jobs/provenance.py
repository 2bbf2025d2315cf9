# SPDX-License-Identifier: GPL-3.0-or-later
"""Distinguishes the clean frames in a capture's removed/ that a person made from estimates that `remove` made.

It uses the manifest there, which also shows whether the frames have changed since. It also checks whether the
estimates differ from the frames.
"""
from __future__ import annotations

from pathlib import Path

import numpy as np

from ...capture import REMOVED, Capture
from ...errors import CaptureError
from ...images.read import read_picture
from ...system.progress import Progress
from .manifest import Manifest

MAX_INVISIBLE_DIFFERENCE = 4.5 / 255
"""Largest difference in display values between a frame and its clean frame that counts as no flare: four codes of 8
bits."""


def has_exact_clean_frames(capture: Capture) -> bool:
    """Return whether a capture has clean frames that a fit may take as exact.

    Files that `remove` made and nobody has edited since are estimates, all others in removed/ are exact. Without
    removed/, a rendered capture has them in its exact layers.
    """
    if not capture.has_clean_frames:
        return capture.has_truth
    return not any(Manifest(capture.folder / REMOVED).unedited_frames(_frames_by_clean_name(capture)))


def check_clean_frames_current(capture: Capture) -> None:
    """Raise CaptureError if `remove` made clean frames from other frames than the capture has now. Clean frames that
    the manifest does not list were made by a person, and pass."""
    folder, sources = capture.folder / REMOVED, _frames_by_clean_name(capture)
    if others := Manifest(folder).changed_sources(sources):
        raise CaptureError(f"{len(others)} of the {len(sources)} clean frames in {folder} were made from other frames "
                           f"than the capture has now ({others[0].as_posix()} first); delete that folder to make them "
                           "again.")


def has_no_visible_flare(capture: Capture, progress: Progress) -> bool:
    """Return whether `remove` has found no flare in any frame of a capture: no channel of a pixel differs from its
    clean frame by more than MAX_INVISIBLE_DIFFERENCE. NaN counts as no difference.

    Raises Cancelled.
    """
    progress.stage("compare the clean frames", len(capture.views))
    for view in capture.views:
        frame, clean = (read_picture(path).display()
                        for path in (capture.frame_path(view), capture.clean_frame_path(view)))
        if frame.shape != clean.shape or (np.abs(frame - clean) > MAX_INVISIBLE_DIFFERENCE).any():
            return False
        progress.advance()
    return True


def _frames_by_clean_name(capture: Capture) -> dict[Path, Path]:
    """Return the path of each frame as filmed, by the name of its clean frame below removed/."""
    folder = (capture.folder / REMOVED).resolve()
    frames = {capture.clean_frame_path(view).resolve(): view for view in capture.views}
    return {path.relative_to(folder): capture.frame_path(view) for path, view in frames.items()
            if path.is_relative_to(folder)}
