# SPDX-License-Identifier: GPL-3.0-or-later
"""Interpolates the path of a light through frames that do not show it, for `tracks`.

The path has the least squared jerk that agrees with the measured places (Flash & Hogan 1985 found this of movements of
the hand). Unlike a cubic, it keeps its acceleration in the gap, so a light that leaves the frame and comes back goes
as far out as its motion in the frame implies.
"""
from __future__ import annotations

import numpy as np

from ..capture.camera import Floats

JERK_ORDER = 3
"""Order of the differences that are least: third differences of places are the jerk per frame."""
NEIGHBOURS = 6
"""Number of measured places before and after a gap that determine the path in it."""
MAX_SQUARE = 20.0
"""Largest squared difference that counts, in medians of the squares: measured places may be wrong."""
MIN_SIGNAL = 0.02
"""Least variance of the differences of the true path, as a share of the variance that noise adds to them."""


def interpolate_path(frames: Floats, places: Floats, noise: float) -> dict[int, Floats]:
    """Return, by frame, the places (2,) in all gaps between measured frames, on the path of least squared jerk.

    frames: (n,) the measured frames, whole numbers, ascending. places: (n, 2), pixels. noise: standard deviation of
    measured places, pixels.
    """
    numbers = np.asarray(frames).astype(int)
    order = min(JERK_ORDER, len(numbers))
    variance = _variance_of_differences(numbers, places, order, noise)
    path: dict[int, Floats] = {}
    for gap in np.nonzero(np.diff(numbers) > 1)[0]:
        near = slice(max(gap + 1 - NEIGHBOURS, 0), gap + 1 + NEIGHBOURS)
        smooth = _smooth_path(numbers[near] - numbers[near][0], places[near], order, noise ** 2, variance)
        for frame in range(numbers[gap] + 1, numbers[gap + 1]):
            path[frame] = smooth[frame - numbers[near][0]]
    return path


def _smooth_path(frames: Floats, places: Floats, order: int, noise_variance: float, variance: float) -> Floats:
    """Return the most likely path (last frame + 1, 2), one place for each frame from 0 on, through measured places.

    Both the errors of the places and the path's differences of this order are taken as normally distributed, so the
    path solves one linear system. frames: (n,) whole numbers, the first is 0. places: (n, 2), pixels. noise_variance:
    of the places, pixels². variance: of the differences, (pixels per frame^order)².
    """
    count = int(frames[-1]) + 1
    is_measured, measured = np.zeros(count), np.zeros((count, 2))
    is_measured[frames], measured[frames] = 1.0, places
    differences = np.diff(np.eye(count), min(order, count - 1), axis=0)
    precision = np.diag(is_measured) / noise_variance + differences.T @ differences / variance
    return np.asarray(np.linalg.solve(precision, measured / noise_variance))


def _variance_of_differences(frames: Floats, places: Floats, order: int, noise: float) -> float:
    """Return the variance of the true path's differences of this order, estimated from consecutive measured frames.

    The variance that noise adds to measured differences is subtracted. Without order + 1 consecutive frames it is the
    variance from noise alone. frames: (n,) numbers of the measured frames, ascending. places: (n, 2), pixels. noise:
    standard deviation of the places, pixels.
    """
    coefficients = np.diff(np.eye(order + 1), order, axis=0)[0]
    noise_variance = float(np.square(coefficients).sum()) * noise ** 2
    starts = [index for index in range(len(frames) - order) if frames[index + order] - frames[index] == order]
    if not starts:
        return noise_variance
    squares = np.square([coefficients @ places[index:index + order + 1] for index in starts])
    limited = np.minimum(squares, MAX_SQUARE * np.median(squares))
    return max(float(limited.mean()) - noise_variance, MIN_SIGNAL * noise_variance)
