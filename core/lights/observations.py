# SPDX-License-Identifier: GPL-3.0-or-later
"""The detections of all views as arrays, and how they relate to a place: the data of `triangulation.py`.

A place is homogeneous, (x, y, z, w): w = 1 for a point, w = 0 for a direction at infinity.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..capture.camera import Camera, Floats
from .detection import Detection

MIN_DEPTH = 1e-9
CUT_WEIGHT = 0.3
"""Weight of a detection that the frame's edge cuts: its centroid is off, but better than none."""


@dataclass(eq=False)
class Observations:
    """All detections as arrays: view index (d,), pixel (d, 2), tolerance (d,) px, weight (d,), ray (d, 3).

    Detections are in the order of their views.
    """

    cameras: list[Camera]
    names: list[str]
    view: NDArray[np.int64]
    pixel: Floats
    tolerance: Floats
    weight: Floats
    ray: Floats
    detection: list[Detection]

    def __post_init__(self) -> None:
        self.rotation = np.array([camera.world_to_camera[:3, :3] for camera in self.cameras])
        self.position = np.array([camera.position for camera in self.cameras])
        self.focal = np.array([(camera.fx, camera.fy) for camera in self.cameras])
        self.centre = np.array([(camera.cx, camera.cy) for camera in self.cameras])
        self.size = np.array([camera.size for camera in self.cameras], np.float64)

    @classmethod
    def of(cls, views: Sequence[tuple[str, Camera]], detections: Sequence[Sequence[Detection]],
           tolerance: float) -> Observations:
        """Collect the detections of each view. tolerance: share of the frame's diagonal, to which half the light's
        radius is added."""
        cameras = [camera for _, camera in views]
        flat = [(i, detection) for i, in_view in enumerate(detections) for detection in in_view]
        diagonal = np.array([np.hypot(*camera.size) for camera in cameras])
        return cls(
            cameras, [name for name, _ in views],
            view=np.array([i for i, _ in flat], np.int64),
            pixel=np.array([detection.xy for _, detection in flat], np.float64).reshape(-1, 2),
            tolerance=np.array([tolerance * diagonal[i] + 0.5 * detection.radius for i, detection in flat]),
            weight=np.array([detection.score * (CUT_WEIGHT if detection.is_cut else 1.0) for _, detection in flat]),
            ray=np.array([cameras[i].rays(detection.xy)[0] for i, detection in flat]).reshape(-1, 3),
            detection=[detection for _, detection in flat])

    def project(self, places: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Project homogeneous places (n, 4) to pixels (n, v, 2) in all v views; return also (n, v), whether each place
        lies in front of the camera."""
        local = np.einsum("vij,nvj->nvi", self.rotation, places[:, None, :3] - places[:, None, 3:] * self.position)
        front = local[..., 2] > MIN_DEPTH
        depth = np.where(front, local[..., 2], 1.0)[..., None]
        return local[..., :2] / depth * self.focal + self.centre, front

    def is_inlier(self, places: Floats, index: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (n,), whether place i of (n, 4) projects within tolerance of the detection index[i]."""
        view = self.view[index]
        local = np.einsum("nij,nj->ni", self.rotation[view], places[:, :3] - places[:, 3:] * self.position[view])
        front = local[:, 2] > MIN_DEPTH
        pixel = local[:, :2] / np.where(front, local[:, 2], 1.0)[:, None] * self.focal[view] + self.centre[view]
        return np.asarray(front & (((pixel - self.pixel[index]) ** 2).sum(axis=1) < self.tolerance[index] ** 2))

    def inliers(self, place: Floats, remaining: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the indices of the detections within tolerance of a place's (4,) projections, at most the nearest of
        each view.

        remaining: (d,), true for detections that no light has claimed yet; only these are returned.
        """
        pixels, front = self.project(place[None])
        distance = np.linalg.norm(pixels[0, self.view] - self.pixel, axis=1) / self.tolerance
        nearest: dict[int, int] = {}
        for i in np.flatnonzero(remaining & front[0, self.view] & (distance < 1)):
            view = int(self.view[i])
            if view not in nearest or distance[i] < distance[nearest[view]]:
                nearest[view] = int(i)
        return np.array(sorted(nearest.values()), np.int64)

    def scores(self, places: Floats, index: NDArray[np.int64]) -> Floats:
        """Return (n,), the score of each place (n, 4): the summed weights of the detections near its projections.

        index: the detections to consider, ascending. In each view only the best counts, with its weight times
        1 - (distance / tolerance)².
        """
        pixels, front = self.project(places)
        view = self.view[index]
        squared = np.zeros((len(places), len(index)))
        for axis in range(2):
            squared += ((pixels[:, view, axis] - self.pixel[index, axis]) / self.tolerance[index]) ** 2
        gain = np.where(front[:, view] & (squared < 1), self.weight[index] * (1 - squared), 0.0)
        # Detections are in the order of their views: those of a view are side by side.
        starts = np.flatnonzero(np.diff(view, prepend=-1))
        return np.asarray(np.maximum.reduceat(gain, starts, axis=1).sum(axis=1))
