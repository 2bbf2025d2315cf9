# SPDX-License-Identifier: GPL-3.0-or-later
"""How much of each light is to be seen, smooth along a path.

A light that is hidden in a frame has no flare in it; before and after it the flare fades, instead of switching.
The smoothed share of a frame depends on its neighbours alone, whatever part of the shot is rendered.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..look.shot import ShotFrame

STEP = 0.05
"""Share of the distance to the light that a camera may move between frames for them to be one path."""


def on_one_path(frame: ShotFrame, after: ShotFrame, light: str) -> bool:
    """Whether two frames follow each other, so near that the light's visibility may run from one to the other."""
    places = [next((one.xyz for one in each.lights if one.name == light), None) for each in (frame, after)]
    if after.frame - frame.frame != 1 or frame.name != after.name or places[0] is None or places[1] is None:
        return False
    moved = np.linalg.norm((after.camera.position - places[1]) - (frame.camera.position - places[0]))
    return bool(moved <= STEP * np.linalg.norm(frame.camera.position - places[0]))


def smoothed(frames: Sequence[ShotFrame], index: int, light: str, radius: int,
             share_of: Callable[[int], float]) -> float:
    """The light's share in frame `index`, from its neighbours up to 2 `radius` away on the same path.

    First the smallest of each frame's neighbours within `radius`, then their mean with binomial weights: so a frame
    in which the light is hidden keeps 0 exactly, and the way there is a ramp. share_of: by index, 0..1.
    """
    if radius <= 0:
        return share_of(index)
    near = {0: share_of(index)}
    for side in (-1, 1):
        for away in range(1, 2 * radius + 1):
            here = index + side * away
            if not 0 <= here < len(frames):
                break
            first, second = sorted((here, here - side))
            if not on_one_path(frames[first], frames[second], light):
                break
            near[side * away] = share_of(here)
    weights = np.array([1.0])
    for _ in range(2 * radius):
        weights = np.convolve(weights, [0.5, 0.5])
    total = value = 0.0
    for offset in range(-radius, radius + 1):
        if offset in near:
            lowest = min(near[at] for at in range(offset - radius, offset + radius + 1) if at in near)
            value += weights[offset + radius] * lowest
            total += weights[offset + radius]
    return value / total
