# SPDX-License-Identifier: GPL-3.0-or-later
"""Rasterizes plane Gaussians in numpy, for thumbnails, checks and `pyramid`.

The definition is core/gaussians/reference.py. Not fast: each Gaussian is drawn over its bounding box.
"""
from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..choices import Blend
from ..conventions.pixel_grid import PixelGrid
from ..conventions.splatting import ALPHA_MIN, PROFILE_MIN
from ..conventions.splatting import OPACITY_MAX as OPACITY_MAX
from .plane import Floats, PlaneGaussians, arc_log_peak, arc_strengths, arcs_to_pixels, concatenate, to_pixels

Box = tuple[int, int, int, int]
"""Left, top, right, bottom of a rectangle of pixels; the last two are outside."""


def extent(gaussians: PlaneGaussians, blend: Blend = "add") -> Floats:
    """Return (n,) the Mahalanobis radius beyond which a Gaussian is not drawn."""
    if blend == "add":
        radius = np.full(len(gaussians), math.sqrt(-2 * math.log(PROFILE_MIN)), np.float32)
    else:
        peaks = np.minimum(gaussians.opacities, OPACITY_MAX)
        radius = np.sqrt(2 * np.log(np.maximum(peaks / ALPHA_MIN, 1)))
    if gaussians.rings is not None:
        r0, w = gaussians.rings.T
        # The last term is how far an arc moves the peak outwards.
        radius = np.maximum(r0 + w * radius + w * w * gaussians.arc_strengths, 0)
    return np.asarray(radius, np.float32)


def draw(flares: Iterable[PlaneGaussians], intrinsics: ArrayLike, width: int, height: int,
         blend: Blend = "add", pixel_grid: PixelGrid | None = None) -> Floats:
    """Draw flares to a picture (height, width, 3) with intrinsics (3, 3), pixel centres at + 0.5.

    blend "add": scene-linear light; "over": display colour, premultiplied, over black. pixel_grid: of the fit.
    """
    return draw_with_transmittance(flares, intrinsics, width, height, blend, pixel_grid)[0]


def draw_with_transmittance(flares: Iterable[PlaneGaussians], intrinsics: ArrayLike, width: int, height: int,
                            blend: Blend = "add", pixel_grid: PixelGrid | None = None) -> tuple[Floats, Floats]:
    """Return the picture of `draw`, and the share of the light behind it that passes (height, width): 1 for "add"."""
    picture = np.zeros((height, width, 3), np.float32)
    transmittance = np.ones((height, width), np.float32)
    gaussians = concatenate(list(flares))
    if gaussians is None:
        return picture, transmittance
    centres, covariances = to_pixels(gaussians, intrinsics, pixel_grid)
    arcs = arcs_to_pixels(gaussians, intrinsics)
    radii = extent(gaussians, blend)
    for number in range(len(gaussians)):
        box = bounding_box(centres[number], covariances[number], float(radii[number]), width, height)
        if box is None:
            continue
        ring = None if gaussians.rings is None else gaussians.rings[number]
        profile = profile_in(box, centres[number], covariances[number], ring, arcs[number])
        rows, columns = slice(box[1], box[3]), slice(box[0], box[2])
        if blend == "add":
            profile = np.where(profile >= PROFILE_MIN, profile, 0) * gaussians.opacities[number]
        else:
            profile = profile * min(float(gaussians.opacities[number]), OPACITY_MAX)
            profile = np.where(profile >= ALPHA_MIN, profile, 0)
            in_front = transmittance[rows, columns]
            profile, transmittance[rows, columns] = profile * in_front, in_front * (1 - profile)
        picture[rows, columns] += profile[..., None] * gaussians.colours[number]
    return picture, transmittance


def bounding_box(centre: Floats, covariance: Floats, radius: float, width: int, height: int) -> Box | None:
    """Return the bounding box of a Gaussian in the picture; None if it is outside, or flat, or not finite.

    centre (2,), px; covariance (3,), px²; radius: Mahalanobis, see `extent`."""
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


def profile_in(box: Box, centre: Floats, covariance: Floats, ring: NDArray[Any] | None, pixel_arc: Floats) -> Floats:
    """Return the profile (rows, columns) of a Gaussian in a box of pixels, 1 at its peak.

    centre (2,), px; covariance (3,), px²; ring (2,): r0 and w, or None; pixel_arc (2,): see `arcs_to_pixels`."""
    xx, xy, yy = covariance
    dx = np.arange(box[0], box[2], dtype=np.float32) + 0.5 - centre[0]
    dy = (np.arange(box[1], box[3], dtype=np.float32) + 0.5 - centre[1])[:, None]
    q = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
    if ring is None:
        return np.asarray(np.exp(-q / 2), np.float32)
    r0, w = ring
    exponent = (np.sqrt(np.maximum(q, 1e-12)) - r0) ** 2 / (2 * w * w)
    if pixel_arc.any():
        x, y = pixel_arc
        slope = np.array([yy * x - xy * y, xx * y - xy * x]) / (xx * yy - xy * xy)
        log_peak = arc_log_peak(arc_strengths(pixel_arc[None], covariance[None])[0], ring)
        exponent = exponent - (slope[0] * dx + slope[1] * dy - log_peak)
    return np.asarray(np.exp(-exponent), np.float32)
