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
from ..conventions.splatting import ALPHA_MIN, OPACITY_MAX, PROFILE_MIN
from .plane import Floats, PlaneGaussians, arc_log_peak, arc_strengths, arcs_to_pixels, concatenate, to_pixels

Box = tuple[int, int, int, int]
"""Left, top, right, bottom of a rectangle of pixels; the last two are outside."""


def cutoff_radii(gaussians: PlaneGaussians, blend: Blend = "add") -> Floats:
    """Return the Mahalanobis radius (n,) of each Gaussian beyond which it is not drawn.

    There its profile falls below PROFILE_MIN (blend "add"), or its alpha below ALPHA_MIN ("over").
    """
    if blend == "add":
        radius = np.full(len(gaussians), math.sqrt(-2 * math.log(PROFILE_MIN)), np.float32)
    else:
        peak_opacities = np.minimum(gaussians.opacities, OPACITY_MAX)
        radius = np.sqrt(2 * np.log(np.maximum(peak_opacities / ALPHA_MIN, 1)))
    if gaussians.rings is not None:
        r0, w = gaussians.rings.T
        # A ring of radius r0 and width w; the last term is how far an arc moves its peak outwards.
        radius = np.maximum(r0 + w * radius + w * w * gaussians.arc_strengths, 0)
    return np.asarray(radius, np.float32)


def draw(flares: Iterable[PlaneGaussians], intrinsics: ArrayLike, width: int, height: int,
         blend: Blend = "add", pixel_grid: PixelGrid | None = None) -> Floats:
    """Draw flares to a picture (height, width, 3) with intrinsics (3, 3), pixel centres at + 0.5.

    blend "add": scene-linear light; "over": display colour, premultiplied, over black. pixel_grid: that of
    the fit, which sets the low-pass filter; None for the default filter.
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
    radii = cutoff_radii(gaussians, blend)
    for index in range(len(gaussians)):
        box = bounding_box(centres[index], covariances[index], float(radii[index]), width, height)
        if box is None:
            continue
        ring = None if gaussians.rings is None else gaussians.rings[index]
        profile = profile_in_box(box, centres[index], covariances[index], ring, arcs[index])
        left, top, right, bottom = box
        rows, columns = slice(top, bottom), slice(left, right)
        if blend == "add":
            profile = np.where(profile >= PROFILE_MIN, profile, 0) * gaussians.opacities[index]
        else:
            profile = profile * min(float(gaussians.opacities[index]), OPACITY_MAX)
            profile = np.where(profile >= ALPHA_MIN, profile, 0)
            in_front = transmittance[rows, columns]
            profile, transmittance[rows, columns] = profile * in_front, in_front * (1 - profile)
        picture[rows, columns] += profile[..., None] * gaussians.colours[index]
    return picture, transmittance


def bounding_box(centre: Floats, covariance: Floats, radius: float, width: int, height: int) -> Box | None:
    """Return the bounding box of a Gaussian in the picture; None if it is outside, or flat, or not finite.

    centre (2,), px; covariance (3,), px²; radius: Mahalanobis radius to which it is drawn."""
    xx, xy, yy = (float(value) for value in covariance)
    if not xx * yy - xy * xy > 0:
        return None
    half_width, half_height = radius * math.sqrt(xx), radius * math.sqrt(yy)
    x, y = float(centre[0]), float(centre[1])
    if not all(map(math.isfinite, (x, y, half_width, half_height))):
        return None
    left, right = max(math.floor(x - half_width), 0), min(math.ceil(x + half_width) + 1, width)
    top, bottom = max(math.floor(y - half_height), 0), min(math.ceil(y + half_height) + 1, height)
    return (left, top, right, bottom) if left < right and top < bottom else None


def profile_in_box(box: Box, centre: Floats, covariance: Floats, ring: NDArray[Any] | None, pixel_arc: Floats
                   ) -> Floats:
    """Return the profile (rows, columns) of a Gaussian in a box of pixels, 1 at its peak.

    centre (2,), px. covariance (3,), px². ring (2,): radius r0 and width w of a ring-shaped profile
    exp(-(r - r0)²/(2 w²)), in standard deviations like the distance r; None for exp(-r²/2). pixel_arc (2,): vector to
    the ring's brighter side, px, 0 for an even ring; it tilts the profile's logarithm, see `arcs_to_pixels`."""
    left, top, right, bottom = box
    dx = np.arange(left, right, dtype=np.float32) + 0.5 - centre[0]
    dy = (np.arange(top, bottom, dtype=np.float32) + 0.5 - centre[1])[:, None]
    has_arc = ring is not None and pixel_arc.any()
    log_peak = arc_log_peak(arc_strengths(pixel_arc[None], covariance[None])[0], ring) if has_arc else None
    return np.asarray(np.exp(-profile_exponent(dx, dy, covariance, ring, pixel_arc, log_peak)), np.float32)


def profile_exponent(dx: Any, dy: Any, covariance: Any, ring: Any, pixel_arc: Any, log_peak: Any) -> Any:
    """Return -log of the profile of Gaussians at offsets (dx, dy) from their centres, px; all arguments broadcast.

    covariance: its xx, xy, yy. ring: its r0 and w, or None. pixel_arc: its x and y. log_peak: `arc_log_peak` of the
    arc, None for an even ring. See `profile_in_box`."""
    xx, xy, yy = covariance
    determinant = xx * yy - xy * xy
    squared_distance = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / determinant
    if ring is None:
        return squared_distance / 2
    r0, w = ring
    exponent = (np.sqrt(np.maximum(squared_distance, 1e-12)) - r0) ** 2 / (2 * w * w)
    if log_peak is None:
        return exponent
    # An arc multiplies the profile by exp(slope . d), d the offset from the centre; its peak is scaled to 1.
    arc_x, arc_y = pixel_arc
    slope_x, slope_y = (yy * arc_x - xy * arc_y) / determinant, (xx * arc_y - xy * arc_x) / determinant
    return exponent - (slope_x * dx + slope_y * dy - log_peak)
