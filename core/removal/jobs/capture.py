# SPDX-License-Identifier: GPL-3.0-or-later
"""Cleans all frames of a capture into its folder removed/, which a fit reads.

`fit` without exact clean frames and the panel's Make Clean Frames run it.
"""
from __future__ import annotations

import shutil
from collections.abc import Collection
from pathlib import Path

import numpy as np

from ...capture import REMOVED, Capture
from ...errors import CaptureError
from ...images.formats.kinds import JPEG_SUFFIXES
from ...images.plates import clean_name
from ...images.views import write_view_results
from ...system.files import retry_while_locked, safe_join
from ...system.progress import Progress
from ..inference.neighbours import ShotPredictor, shot_sort_key
from ..inference.remover import Remover
from .clean_frames import CleanFrame, PreparedResults, write_clean_frames
from .manifest import Manifest, digest_inputs

UNFINISHED_FOLDER = "removed.unfinished"
"""Holds the clean frames until all exist: an incomplete removed/ would be read as a complete one."""


class _FrameCleaner:
    """Predicts and removes the flare of one frame after the other, for `write_clean_frames`.

    flared_names: clean files of the frames that are known to show a flare.
    """

    def __init__(self, remover: Remover, predictor: ShotPredictor, flared_names: set[Path]) -> None:
        self._remover, self._predictor, self._flared_names = remover, predictor, flared_names

    def digest(self, frame: CleanFrame) -> str:
        """Hash the settings and all files that the clean frame depends on."""
        cache_key = self._remover.cache_key
        settings = f"{cache_key} flared" if frame.name in self._flared_names else cache_key
        return digest_inputs(settings, [frame.source, *self._predictor.dependencies(frame.source)])

    def clean(self, frame: CleanFrame) -> PreparedResults:
        """Predict a frame's flare, and prepare its results."""
        plate, prediction = self._predictor.predict(frame.source)
        if frame.name in self._flared_names:
            prediction = prediction._replace(confidence=np.float32(1))
        predictions = [prediction, *self._remover.predict_other_views(plate, prediction)]
        return PreparedResults(
            lambda: write_view_results(frame.results, plate, self._remover.remove_views(plate, predictions)),
            float(prediction.confidence))


def clean_capture(capture: Capture, remover: Remover, progress: Progress,
                  flared: Collection[str] = ()) -> Path:
    """Clean every frame into the capture's removed/ and return that folder; frames of an interrupted call are kept.

    JPEG frames are written as PNG. remover: for a fit, one that removes all of the glow. flared: names of views that
    certainly show a flare, since a light is on in them; the flare predicted there gets confidence 1.

    Raises CaptureError where removed/ exists already, where the folder cannot be written to and where two frames would
    have one clean file; FrameError for a frame that cannot be read; Cancelled.
    """
    target, unfinished = capture.folder / REMOVED, capture.folder / UNFINISHED_FOLDER
    if target.exists():
        raise CaptureError(f"{target} exists already; delete it to clean the frames again.")
    if capture.plate_space is not None:
        remover.use_plate_space(capture.plate_space)
    names = _clean_names(capture)
    progress.stage("remove", len(capture.views))
    predictor = ShotPredictor(remover, [capture.frame_path(view) for view in capture.views])
    frames = [CleanFrame(names[view.name], capture.frame_path(view),
                         [safe_join(unfinished, str(names[view.name]), CaptureError)])
              for view in sorted(capture.views, key=lambda view: shot_sort_key(capture.frame_path(view)))]
    cleaner = _FrameCleaner(remover, predictor, {names[name] for name in flared})
    try:
        write_clean_frames(frames, Manifest(unfinished), progress, digest=cleaner.digest, clean=cleaner.clean,
                           keep_finished=True, overwrite=True)
        # Files first, then `target`: if another fit renames the folder just before the files are tested, `target`
        # exists.
        if not all(frame.results[0].is_file() for frame in frames) and not target.exists():
            raise CaptureError(f"Another fit is cleaning the frames of {capture.folder} with other settings; wait "
                               "for it, and start this one again.")
        retry_while_locked(unfinished.rename, target)
    except OSError as problem:
        if target.is_dir():  # another fit of this capture has finished first
            shutil.rmtree(unfinished, ignore_errors=True)
            return target
        raise CaptureError(f"{unfinished} cannot be written ({problem.strerror or problem}); copy the capture to a "
                           "writable folder, or fit it without clean frames (--mode split).") from problem
    return target


def _clean_names(capture: Capture) -> dict[str, Path]:
    """Return the path of each view's clean file below removed/, by view name. Raises CaptureError where two views would
    have the same file, also where upper and lower case are not distinguished."""
    clean_names: dict[str, Path] = {}
    view_by_key: dict[str, str] = {}
    for view in capture.views:
        name = Path(view.name)
        name = name.with_suffix(".png") if name.suffix.lower() in JPEG_SUFFIXES else clean_name(name)
        key = name.as_posix().casefold()
        if key in view_by_key:
            raise CaptureError(f"The frames {view_by_key[key]} and {view.name} of {capture.folder} would both have "
                               f"{REMOVED}/{name.as_posix()}; give one of them another name, in the model too.")
        clean_names[view.name], view_by_key[key] = name, view.name
    return clean_names
