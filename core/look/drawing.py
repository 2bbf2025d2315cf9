# SPDX-License-Identifier: GPL-3.0-or-later
"""Plane Gaussians to pixels in numpy, for thumbnails and checks.

The definition is core/gaussians/reference.py. Not for speed: each Gaussian is drawn over the box it reaches.
"""
from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..choices import Blend
from ..conventions.pixel_grid import Sampling
from ..conventions.splatting import ALPHA_MIN, PROFILE_MIN
from ..conventions.splatting import OPACITY_MAX as OPACITY_MAX
from .plane import Floats, PlaneGaussians, arc_level, joined, pixels, strengths, ways


def reach(gaussians: PlaneGaussians, blend: Blend = "add") -> Floats:
    """(n,) Mahalanobis radius beyond which nothing of a Gaussian is drawn."""
    if blend == "add":
        radius = np.full(len(gaussians), math.sqrt(-2 * math.log(PROFILE_MIN)), np.float32)
    else:
        peaks = np.minimum(gaussians.opacities, OPACITY_MAX)
        radius = np.sqrt(2 * np.log(np.maximum(peaks / ALPHA_MIN, 1)))
    if gaussians.rings is not None:
        r0, w = gaussians.rings.T
        radius = np.maximum(r0 + w * radius + w * w * gaussians.strengths, 0)
    return np.asarray(radius, np.float32)


def draw(flares: Iterable[PlaneGaussians], intrinsics: ArrayLike, width: int, height: int,
         blend: Blend = "add", sampling: Sampling | None = None) -> Floats:
    """The flares as a picture (height, width, 3) under intrinsics (3, 3), pixel centres at + 0.5. sampling: the grid on
    which they were learned.

    "add": scene-linear light. "over": display colour, premultiplied, laid over black.
    """
    picture = np.zeros((height, width, 3), np.float32)
    gaussians = joined(list(flares))
    if gaussians is None:
        return picture
    left = np.ones((height, width), np.float32)
    centres, covariances = pixels(gaussians, intrinsics, sampling)
    arcs = ways(gaussians, intrinsics)
    radii = reach(gaussians, blend)
    for number in range(len(gaussians)):
        box = _box(centres[number], covariances[number], float(radii[number]), width, height)
        if box is None:
            continue
        ring = None if gaussians.rings is None else gaussians.rings[number]
        profile = _profile(centres[number], covariances[number], ring, arcs[number], box)
        rows, columns = slice(box[1], box[3]), slice(box[0], box[2])
        if blend == "add":
            profile = np.where(profile >= PROFILE_MIN, profile, 0) * gaussians.opacities[number]
        else:
            profile = profile * min(float(gaussians.opacities[number]), OPACITY_MAX)
            profile = np.where(profile >= ALPHA_MIN, profile, 0)
            profile, left[rows, columns] = profile * left[rows, columns], left[rows, columns] * (1 - profile)
        picture[rows, columns] += profile[..., None] * gaussians.colours[number]
    return picture


def _box(centre: Floats, covariance: Floats, radius: float, width: int,
         height: int) -> tuple[int, int, int, int] | None:
    """Columns and rows that a Gaussian reaches: left, top, right, bottom; None where it reaches none."""
    xx, xy, yy = (float(value) for value in covariance)
    if not xx * yy - xy * xy > 0:
        return None
    half = radius * math.sqrt(xx), radius * math.sqrt(yy)
    x, y = float(centre[0]), float(centre[1])
    if not all(map(math.isfinite, (x, y, *half))):
        return None
    box = (max(math.floor(x - half[0]), 0), max(math.floor(y - half[1]), 0),
           min(math.ceil(x + half[0]) + 1, width), min(math.ceil(y + half[1]) + 1, height))
    return box if box[0] < box[2] and box[1] < box[3] else None


def _profile(centre: Floats, covariance: Floats, ring: NDArray[Any] | None, way: Floats,
             box: tuple[int, int, int, int]) -> Floats:
    xx, xy, yy = covariance
    dx = np.arange(box[0], box[2], dtype=np.float32) + 0.5 - centre[0]
    dy = (np.arange(box[1], box[3], dtype=np.float32) + 0.5 - centre[1])[:, None]
    q = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
    if ring is None:
        return np.asarray(np.exp(-q / 2), np.float32)
    r0, w = ring
    halves = (np.sqrt(np.maximum(q, 1e-12)) - r0) ** 2 / (2 * w * w)
    if way.any():
        slope = np.array([yy * way[0] - xy * way[1], xx * way[1] - xy * way[0]]) / (xx * yy - xy * xy)
        level = arc_level(strengths(way[None], covariance[None])[0], ring)
        halves = halves - (slope[0] * dx + slope[1] * dy - level)
    return np.asarray(np.exp(-halves), np.float32)
