# SPDX-License-Identifier: GPL-3.0-or-later
"""Smooths the visibility of each light along a camera path; called by `transfer`.

A hidden light has no flare; before and after, the flare fades instead of switching. The smoothed visibility in a frame
depends on its neighbouring frames alone, whatever part of the shot is rendered.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..look.shot import ShotFrame

MAX_STEP = 0.05
"""Largest motion of the camera between two frames of one path, relative to the distance of the light."""


def are_consecutive(frame: ShotFrame, next_frame: ShotFrame, light: str) -> bool:
    """Return whether two frames are consecutive on one path, so that the light's visibility is continuous."""
    xyz, next_xyz = (next((placed.xyz for placed in each.lights if placed.name == light), None)
                     for each in (frame, next_frame))
    if next_frame.frame - frame.frame != 1 or frame.name != next_frame.name or xyz is None or next_xyz is None:
        return False
    motion = np.linalg.norm((next_frame.camera.position - next_xyz) - (frame.camera.position - xyz))
    return bool(motion <= MAX_STEP * np.linalg.norm(frame.camera.position - xyz))


def smooth_visibility(frames: Sequence[ShotFrame], index: int, light: str, radius: int,
                      visibility_of: Callable[[int], float]) -> float:
    """Return the light's smoothed visibility in frame `index`, from neighbours up to 2 `radius` away on the same path.

    Takes the minimum over the neighbours within `radius` of each frame, then the mean of the minima with binomial
    weights: a frame in which the light is hidden stays exactly 0, with a ramp on both sides. visibility_of: returns the
    visibility, 0..1, in the frame of an index.
    """
    if radius <= 0:
        return visibility_of(index)
    values = {0: visibility_of(index)}
    for side in (-1, 1):
        for distance in range(1, 2 * radius + 1):
            neighbour = index + side * distance
            if not 0 <= neighbour < len(frames):
                break
            earlier, later = sorted((neighbour, neighbour - side))
            if not are_consecutive(frames[earlier], frames[later], light):
                break
            values[side * distance] = visibility_of(neighbour)
    weights = np.array([1.0])
    for _ in range(2 * radius):
        weights = np.convolve(weights, [0.5, 0.5])
    weight_sum = weighted_sum = 0.0
    for offset in range(-radius, radius + 1):
        if offset in values:  # offset 0 always is
            window = range(offset - radius, offset + radius + 1)
            minimum = min(values[other] for other in window if other in values)
            weighted_sum += weights[offset + radius] * minimum
            weight_sum += weights[offset + radius]
    return weighted_sum / weight_sum
