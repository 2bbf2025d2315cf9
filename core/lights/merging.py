# SPDX-License-Identifier: GPL-3.0-or-later
"""Removes duplicates of lights, and ghosts that were taken for lights."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..capture.camera import Camera
from .found_light import FoundLight

GHOST_TOLERANCE, GHOST_RADIUS_SHARE = 0.006, 0.25
"""Distance of a ghost from its predicted place, frame diagonals, to which this share of its radius is added."""
MIN_VIEWS, MIN_GHOST_MOTION = 3, 8
"""Smallest number of views of a ghost, and its motion in tolerances: a spot that hardly moves fits any ratio."""
MIN_RATIO_OFFSET = 0.05
"""Distance of a ghost's ratio from 1, which is that of the light itself."""


def merge_duplicates(lights: Sequence[FoundLight], views: Sequence[tuple[str, Camera]],
                     extent: float) -> list[FoundLight]:
    """Merge lights that most views show at one spot: the best supported stays and gets the support of the others.

    Returns the lights by support, most first. extent: size of the cameras' path, world units.
    """
    distinct: list[FoundLight] = []
    for light in _by_support(lights):
        for i, other in enumerate(distinct):
            if _is_same_light(light, other, views, extent):
                support = tuple(sorted({*other.support, *light.support}))
                distinct[i] = replace(other, support=support, visible=max(other.visible, len(support)),
                                      detections=other.detections + light.detections)
                break
        else:
            distinct.append(light)
    return _by_support(distinct)


def remove_ghosts(lights: Sequence[FoundLight], views: Sequence[tuple[str, Camera]]) -> list[FoundLight]:
    """Remove the ghosts of better supported lights; returns the others by support, most first.

    A ghost g lies, in every frame, at the same ratio mu of the way from the principal point p to its light l,
    g = p + mu (l - p), while l moves over the frame.
    """
    distinct: list[FoundLight] = []
    cameras = dict(views)
    for light in _by_support(lights):
        if not any(_is_ghost(light, other, cameras) for other in distinct):
            distinct.append(light)
    return distinct


def _by_support(lights: Sequence[FoundLight]) -> list[FoundLight]:
    return sorted(lights, key=lambda light: -len(light.support))


def _is_ghost(light: FoundLight, other: FoundLight, cameras: dict[str, Camera]) -> bool:
    """Return whether `light` is a ghost of `other`: while its detections move over the frame, they keep to one ratio of
    the way from the principal point to `other`. cameras: by the views' names."""
    ghosts, sources, tolerances = [], [], []
    for name, detection in light.detections:
        camera = cameras[name]
        pixel, depth = camera.project(other.xyz[None])
        if depth[0] > 0:
            centre = np.array([camera.cx, camera.cy])
            ghosts.append(detection.xy - centre)
            sources.append(pixel[0] - centre)
            tolerances.append(GHOST_TOLERANCE * float(np.hypot(*camera.size)) + GHOST_RADIUS_SHARE * detection.radius)
    if len(ghosts) < MIN_VIEWS:
        return False
    # Both are offsets from the principal point; the ratio of ghost to source is fitted by least squares.
    ghost, source = np.array(ghosts), np.array(sources)
    ratio = float((ghost * source).sum() / (source * source).sum())
    distances = np.linalg.norm(ghost - ratio * source, axis=1) / tolerances
    motion = float(np.linalg.norm(np.ptp(ghost, axis=0))) / float(np.median(tolerances))
    return bool(np.median(distances) < 1 and motion > MIN_GHOST_MOTION and abs(ratio - 1) > MIN_RATIO_OFFSET)


def _is_same_light(light: FoundLight, other: FoundLight, views: Sequence[tuple[str, Camera]], extent: float) -> bool:
    """Return whether two lights are one: nearer to each other than the sum of their radii in more than two thirds of
    the views that have either in frame, or nearer in space than twice the sum of their uncertainties. Small tolerances
    are added to both distances. extent: size of the cameras' path, world units.
    """
    max_distance = 0.02 * extent + 2 * (light.uncertainty + other.uncertainty)
    if not light.far and not other.far and np.linalg.norm(light.xyz - other.xyz) < min(max_distance, 0.3 * extent):
        return True
    matching_views = differing_views = 0
    for _, camera in views:
        (a, b), depth = camera.project([light.xyz, other.xyz])
        if (depth > 0).all() and camera.contains([a, b], depth).any():
            joint_radius = light.radius + other.radius + 0.004 * np.hypot(*camera.size)
            matching_views += bool(np.linalg.norm(a - b) < joint_radius)
            differing_views += bool(np.linalg.norm(a - b) >= joint_radius)
    return matching_views > 2 * differing_views
