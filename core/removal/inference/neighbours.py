# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the neighbouring frames of a plate in its folder, and predicts its flare with them (`temporal`).

Neighbours are found by the numbers in the file names, as far as the shot goes: it is followed from frame to frame while
their details are alike. It ends at a cut, and a folder of single photographs is no shot. `jobs.batch` and
`jobs.capture` go through their plates with it.
"""
from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from ...colour.srgb import Pixels
from ...images.plates import Plate, is_plate_error, read_plate
from ...system.file_names import natural_key
from .optical_flow import compute_flow
from .prediction import FlarePrediction
from .remover import Remover
from .temporal import FrameFeatures, FramePrediction, Neighbour, filter_in_time, frame_features, shot_similarity

NEIGHBOUR_OFFSETS = (1, 2, 3, 4, 6, 8, 12, 16)
"""Frames to either side that the prediction is filtered with: near ones, in which optical flow finds most places, and
far ones, in which a slow camera has its flare elsewhere."""
MAX_OFFSET = NEIGHBOUR_OFFSETS[-1]
"""Frames to either side that the shot is followed."""


class ShotPredictor:
    """Predicts the flares of plates with their neighbours: the plates of the same folder, in natural order.

    The prediction for a plate does not depend on which others are cleaned, or in what order.
    """

    def __init__(self, remover: Remover, paths: Iterable[Path]) -> None:
        """Find the neighbours of each plate. paths: every picture that may be a neighbour; a plate that is not among
        them is predicted by itself."""
        self._remover = remover
        self._before: dict[Path, Sequence[Path]] = {}
        self._after: dict[Path, Sequence[Path]] = {}
        folders: dict[Path, list[Path]] = {}
        for path in paths:
            folders.setdefault(path.parent, []).append(path)
        for frames in folders.values():
            frames.sort(key=natural_key)
            for index, path in enumerate(frames):
                self._before[path] = frames[max(index - MAX_OFFSET, 0):index]
                self._after[path] = frames[index + 1:index + 1 + MAX_OFFSET]
        self._features: dict[Path, FrameFeatures | None] = {}
        self._predictions: dict[Path, FramePrediction] = {}
        self._flows: dict[tuple[Path, Path], Pixels] = {}

    def dependencies(self, path: Path) -> Sequence[Path]:
        """Return the other frames that the prediction for a plate depends on, in their order."""
        return [*self._before.get(path, ()), *self._after.get(path, ())]

    def predict(self, path: Path) -> tuple[Plate, FlarePrediction]:
        """Read a plate and predict its flare.

        Neighbours are read first and only their features are kept, so that one plate is in memory at a time. Neighbours
        that cannot be read or belong to another shot are skipped before the network runs, which takes far longer than
        reading. Predictions are cached: the network runs once for each frame. Raises FrameError where the plate itself
        cannot be read.
        """
        before, after = self._before.get(path, ()), self._after.get(path, ())
        self._evict({path, *before, *after}, before)
        for neighbour in (*before, *after):
            self._read_features(neighbour)
        plate = read_plate(path, self._remover.plate_space)
        features = self._features[path] = self._features.get(path) or self._compute_features(plate)
        frame = self._predict_frame(path, features)
        # Each neighbour is predicted before its flows, which need that prediction's features.
        return plate, filter_in_time(frame, [
            Neighbour(self._predict_frame(neighbour, neighbour_features), weight, self._flow(path, neighbour),
                      self._flow(neighbour, path))
            for side in (before[::-1], after)
            for neighbour, neighbour_features, weight in self._follow_shot(features, side)],
            self._remover.sensitivity.log_odds_bias)

    def _follow_shot(self, features: FrameFeatures,
                     side: Sequence[Path]) -> Iterator[tuple[Path, FrameFeatures, np.float32]]:
        """Yield (frame, its features, its weight) at NEIGHBOUR_OFFSETS to one side of a frame, nearest first.

        features: features of the frame. side: the frames on that side, nearest first. A weight, 0..1, is the least
        `shot_similarity` of two successive frames on the way.

        A moving camera soon shows something else, so each frame is compared with the last similar one before it, not
        with the first. Frames that differ, for instance by a flash, are skipped.
        """
        min_similarity, previous_features = np.float32(1), features
        for offset, path in enumerate(side, 1):
            path_features = self._features[path]
            if path_features is not None and (similarity := shot_similarity(previous_features, path_features)) > 0:
                min_similarity, previous_features = min(min_similarity, similarity), path_features
                if offset in NEIGHBOUR_OFFSETS:
                    yield path, path_features, min_similarity

    def _compute_features(self, plate: Plate) -> FrameFeatures:
        return frame_features(self._remover.to_network_input(plate))

    def _read_features(self, path: Path) -> FrameFeatures | None:
        """Return the features of a plate; None where it cannot be read."""
        if path not in self._features:
            try:
                self._features[path] = self._compute_features(
                    read_plate(path, self._remover.plate_space))
            except Exception as problem:
                if not is_plate_error(problem):
                    raise
                self._features[path] = None
        return self._features[path]

    def _predict_frame(self, path: Path, features: FrameFeatures) -> FramePrediction:
        if path not in self._predictions:
            self._predictions[path] = FramePrediction(features, self._remover.predict_with_tta(features.display))
        return self._predictions[path]

    def _flow(self, source: Path, target: Path) -> Pixels:
        """Return the flow between two frames that have predictions."""
        if (source, target) not in self._flows:
            self._flows[source, target] = compute_flow(self._predictions[source].features.grey,
                                                       self._predictions[target].features.grey)
        return self._flows[source, target]

    def _evict(self, in_reach: Container[Path], before: Container[Path]) -> None:
        """Drop the cached features, predictions and flows of frames out of reach, and the flows within `before`.

        in_reach: a plate and its neighbours. before: its earlier neighbours. Plates are predicted in order, so two
        earlier ones need no flow between them any more.
        """
        self._features = {path: value for path, value in self._features.items() if path in in_reach}
        self._predictions = {path: value for path, value in self._predictions.items() if path in in_reach}
        self._flows = {(source, target): value for (source, target), value in self._flows.items()
                       if source in in_reach and target in in_reach
                       and not (source in before and target in before)}


def shot_sort_key(path: Path) -> tuple[Path, object]:
    """Return a sort key for plates of any folders: in this order `ShotPredictor` computes nothing twice.

    The plates of a folder follow each other. `natural_key` alone would put those of its subfolders between them.
    """
    return path.parent, natural_key(path.name)
