# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds lights on a fitted scene, the paper's way (section "Light Positions"): detections are lifted on to scene
Gaussians, those are clustered, and each cluster's centroid is a light.

A Gaussian belongs to a light if enough of the views that see it have it inside a detection. In each view only Gaussians
near the front of their cell of a coarse depth buffer count as seen.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..capture.camera import Camera, Floats
from .detection import Detection, union_mask
from .found_light import FoundLight

DEPTH_CELLS = 120
"""Cells of the depth buffer along the frame's long side."""
DEPTH_TOLERANCE = 1.05
"""Factor on the nearest depth in a cell up to which a Gaussian counts as its front."""
MIN_OPACITY = 0.3
"""Opacity below which a Gaussian hides nothing and is no part of a light."""
CLUSTER_DISTANCE = 0.03
"""Largest distance between neighbours of one cluster, in extents."""
MATCH_TOLERANCE = 0.006
"""Distance of a light's projection from a detection's rim up to which the detection shows the light, in frame
diagonals."""
MAX_GAUSSIANS = 4000
"""Gaussians that are clustered, those with the most views first."""


def lift_to_gaussians(views: Sequence[tuple[str, Camera]], detections: Sequence[Sequence[Detection]], means: ArrayLike,
                      opacities: ArrayLike, extent: float, min_views: int = 3, min_share: float = 0.3
                      ) -> list[FoundLight]:
    """Find lights from detections of each view and scene Gaussians: means (n, 3), opacities (n,) in 0..1.

    At least `min_share` of the views that see a Gaussian, and at least `min_views` views, must have it inside a
    detection. extent: size of the cameras' path, world units.
    """
    xyz, opacity = np.asarray(means, np.float64), np.asarray(opacities, np.float64)
    xyz, opacity = xyz[opacity > MIN_OPACITY], opacity[opacity > MIN_OPACITY]
    inside, visible = np.zeros(len(xyz), np.int64), np.zeros(len(xyz), np.int64)
    for (_, camera), in_view in zip(views, detections, strict=True):
        pixels, depth = camera.project(xyz)
        visible_rows = _visible_points(camera, pixels, depth)
        visible[visible_rows] += 1
        if in_view:
            mask = union_mask(in_view, camera.size)
            column, row = np.minimum(pixels[visible_rows].astype(int), np.array(camera.size) - 1).T
            inside[visible_rows[mask[row, column]]] += 1
    chosen = np.flatnonzero((inside >= min_views) & (inside >= min_share * np.maximum(visible, 1)))
    chosen = chosen[np.argsort(-inside[chosen], kind="stable")][:MAX_GAUSSIANS]
    lights = []
    for members in _cluster(xyz[chosen], CLUSTER_DISTANCE * extent):
        weight = (inside * opacity)[chosen[members]]
        centre = (xyz[chosen[members]] * weight[:, None]).sum(axis=0) / weight.sum()
        spread = float(np.sqrt((((xyz[chosen[members]] - centre) ** 2).sum(axis=1) * weight).sum() / weight.sum()))
        light = _to_light(centre, spread, views, detections)
        if len(light.support) >= min_views:
            lights.append(light)
    return sorted(lights, key=lambda light: -len(light.support))


def _visible_points(camera: Camera, pixels: Floats, depth: Floats) -> NDArray[np.int64]:
    """Return the indices of the points that are in frame and not hidden.

    A point is not hidden if it is near the nearest one in its cell of a coarse depth buffer. pixels (n, 2), depth (n,):
    the points' projections and depths.
    """
    index = np.flatnonzero(camera.contains(pixels, depth))
    size = max(camera.size) / DEPTH_CELLS
    column, row = (pixels[index] / size).astype(int).T
    cell = row * (DEPTH_CELLS + 1) + column
    nearest = np.full((DEPTH_CELLS + 1) ** 2, np.inf)
    np.minimum.at(nearest, cell, depth[index])
    return index[depth[index] <= DEPTH_TOLERANCE * nearest[cell]]


def _cluster(xyz: Floats, reach: float) -> list[NDArray[np.int64]]:
    """Return the clusters of points (n, 3) by single linkage, as arrays of indices: points nearer than `reach` share a
    cluster, and clusters of fewer than three points are dropped."""
    remaining = np.ones(len(xyz), bool)
    clusters = []
    while remaining.any():
        members = np.zeros(len(xyz), bool)
        frontier = np.flatnonzero(remaining)[:1]
        while len(frontier):
            members[frontier] = True
            remaining[frontier] = False
            others = np.flatnonzero(remaining)
            if not len(others):
                break
            near = np.zeros(len(others), bool)
            for point in xyz[frontier]:
                near |= ((xyz[others] - point) ** 2).sum(axis=1) < reach ** 2
            frontier = others[near]
        if members.sum() >= 3:
            clusters.append(np.flatnonzero(members))
    return clusters


def _to_light(centre: Floats, spread: float, views: Sequence[tuple[str, Camera]],
              detections: Sequence[Sequence[Detection]]) -> FoundLight:
    """Return the light at a cluster's centroid, with the nearest detection of each view that shows it.

    centre: the centroid (3,), world units. spread: root mean square distance of the cluster's Gaussians from it, taken
    as the light's uncertainty. views: name and camera of each view. detections: those of each view.
    """
    residuals: list[float] = []
    matched: list[tuple[str, Detection]] = []
    visible = 0
    for (name, camera), in_view in zip(views, detections, strict=True):
        pixels, depth = camera.project(centre[None])
        if not camera.contains(pixels, depth)[0]:
            continue
        visible += 1
        tolerance = MATCH_TOLERANCE * np.hypot(*camera.size)
        distances = [float(np.linalg.norm(detection.xy - pixels[0])) for detection in in_view]
        candidates = [(distance, number) for number, distance in enumerate(distances)
                      if distance < in_view[number].radius + tolerance]
        if candidates:
            distance, number = min(candidates)
            residuals.append(distance)
            matched.append((name, in_view[number]))
    colour = np.median([detection.colour for _, detection in matched], axis=0) if matched else np.ones(3)
    radius = float(np.median([detection.radius for _, detection in matched])) if matched else 0.0
    return FoundLight(centre, False, tuple(name for name, _ in matched), visible,
                      float(np.median(residuals)) if residuals else 0.0, spread,
                      colour / max(float(colour.max()), 1e-6), radius, how="lifted on to the scene",
                      detections=tuple(matched))
