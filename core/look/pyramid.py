# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws flares that add light quickly in numpy: each Gaussian on the coarsest grid that still resolves it.

The grids halve the size of the picture from one to the next. Their sum is taken from the coarsest to the finest, by
cubic interpolation. `drawing.draw` is the definition. A bake without an engine calls `draw_layers`.
"""
from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..colour.srgb import linear_from_srgb
from ..conventions.splatting import PROFILE_MIN
from .drawing import Box, bounding_box, cutoff_radii, draw_with_transmittance, profile_in_box
from .look import Look
from .plane import Floats, PlaneGaussians, arcs_to_pixels, to_pixels

LEVELS = (1, 2, 4, 8, 16, 32, 64)
"""Divisors of the picture's size."""
MIN_TEXELS = 4.0
"""Smallest standard deviation of the narrow side of a Gaussian, in texels of the grid that it is drawn on."""
_MARGIN = 4
"""Texels around a grid, which the interpolation at the edge of the picture needs."""
_LARGE_BOX = 1 << 14
"""Texels of a bounding box from which a thin ellipse is drawn in bands."""
_BANDS = 24
"""Bands of a thin ellipse."""
_FULL_SHARE = 0.35
"""Share of its bounding box from which an ellipse is drawn in one piece."""
_WEIGHTS = (-0.0703125, 0.8671875, 0.2265625, -0.0234375)
"""Weights of Catmull-Rom interpolation a quarter of a texel after the second of four; reversed for three quarters."""


def level_indices(covariances: Floats, rings: Floats | None) -> NDArray[np.int64]:
    """Return the index in LEVELS (n,) of the grid for each Gaussian; covariances (n, 3) in px².

    It is the coarsest grid on which the standard deviation of the Gaussian's narrow side is MIN_TEXELS or more, else
    the finest. rings (n, 2): r0 and w, or None.
    """
    xx, xy, yy = covariances.T
    # The variances along the axes are the mean plus and minus half their difference.
    mean_variance, half_difference = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    narrow = np.sqrt(np.maximum(mean_variance - half_difference, 0))
    if rings is not None:  # the line of a ring is w times as wide as its ellipse
        narrow = narrow * np.minimum(rings[:, 1], 1)
    return np.clip(np.searchsorted(np.array(LEVELS), narrow / MIN_TEXELS, side="right") - 1, 0, len(LEVELS) - 1)


def draw_added(gaussians: PlaneGaussians, look: Look, intrinsics: ArrayLike, width: int, height: int) -> Floats:
    """Return the scene-linear light (height, width, 3) of Gaussians of a look with the blend "add".

    0 or more: enlarging a grid by cubic interpolation can fall below 0, which is clipped at the end.
    """
    centres, covariances = to_pixels(gaussians, intrinsics, look.pixel_grid)
    arcs, radii = arcs_to_pixels(gaussians, intrinsics), cutoff_radii(gaussians)
    indices = level_indices(covariances, gaussians.rings)
    picture: Floats | None = None
    for index in reversed(range(len(LEVELS))):
        divisor = LEVELS[index]
        level_rows = np.flatnonzero(indices == index)
        if picture is None and not len(level_rows) and index:
            continue  # grids coarser than the coarsest that has a Gaussian are skipped; the finest is always made
        size = -(-height // divisor) + 2 * _MARGIN, -(-width // divisor) + 2 * _MARGIN
        grid = np.zeros((*size, 3), np.float32) if picture is None else _enlarge(picture, size)
        for row in level_rows.tolist():
            ring = None if gaussians.rings is None else gaussians.rings[row]
            light = gaussians.colours[row] * gaussians.opacities[row]
            _add_gaussian(grid, centres[row] / divisor + _MARGIN, covariances[row] / divisor**2, float(radii[row]),
                          ring, arcs[row] / divisor, light)
        picture = grid
    assert picture is not None
    return np.maximum(picture[_MARGIN:_MARGIN + height, _MARGIN:_MARGIN + width], 0)


def _add_gaussian(grid: Floats, centre: Floats, covariance: Floats, radius: float, ring: Floats | None, arc: Floats,
                  light: Floats) -> None:
    """Add one Gaussian to a grid (rows, columns, 3). Lengths are in texels of the grid.

    radius: Mahalanobis radius to which it is drawn. ring (2,): r0 and w, or None. arc (2,): towards the brighter side
    of a ring. light: RGB at the peak."""
    box = bounding_box(centre, covariance, radius, grid.shape[1], grid.shape[0])
    for band in () if box is None else _bands(box, centre, covariance, radius):
        left, top, right, bottom = band
        profile = profile_in_box(band, centre, covariance, ring, arc)
        profile[profile < PROFILE_MIN] = 0
        pixels = grid[top:bottom, left:right]
        for channel in range(3):
            pixels[..., channel] += profile * light[channel]


def _bands(box: Box, centre: Floats, covariance: Floats, radius: float) -> Iterator[Box]:
    """Yield rectangles inside `box` that cover the ellipse of this Mahalanobis radius.

    They are `box` itself, or horizontal bands of a large thin ellipse."""
    left, top, right, bottom = box
    xx, xy, yy = (float(value) for value in covariance)
    # The ellipse's area relative to that of its bounding box.
    area_share = math.pi / 4 * math.sqrt(max(xx * yy - xy * xy, 0) / (xx * yy))
    if (right - left) * (bottom - top) < _LARGE_BOX or area_share > _FULL_SHARE:
        yield box
        return
    step = max((bottom - top) // _BANDS, 4)
    half_width = radius * math.sqrt(xx)
    rightmost_dy = radius * xy / math.sqrt(xx)  # of the ellipse's rightmost point, below its centre
    for start in range(top, bottom, step):
        end = min(start + step, bottom)
        top_dy, bottom_dy = start + 0.5 - float(centre[1]), end - 0.5 - float(centre[1])
        row_ends = [_row_ends(dy, xx, xy, yy, radius) for dy in (top_dy, bottom_dy)]
        leftmost, rightmost = (min(ends[0] for ends in row_ends), max(ends[1] for ends in row_ends))
        if top_dy <= rightmost_dy <= bottom_dy:
            rightmost = max(rightmost, half_width)
        if top_dy <= -rightmost_dy <= bottom_dy:
            leftmost = min(leftmost, -half_width)
        band_left = max(math.floor(float(centre[0]) + leftmost) - 1, left)
        band_right = min(math.ceil(float(centre[0]) + rightmost) + 1, right)
        if band_left < band_right:
            yield band_left, start, band_right, end


def _row_ends(dy: float, xx: float, xy: float, yy: float, radius: float) -> tuple[float, float]:
    """Return the left and right end of the ellipse, relative to its centre, in the row `dy` below the centre.

    In a row above or below the ellipse, both are those of its highest or lowest point."""
    clamped_dy = min(max(dy, -radius * math.sqrt(yy)), radius * math.sqrt(yy))
    half = math.sqrt(max((radius * radius - clamped_dy * clamped_dy / yy) * (xx - xy * xy / yy), 0))
    return xy / yy * clamped_dy - half, xy / yy * clamped_dy + half


def _enlarge(grid: Floats, size: tuple[int, int]) -> Floats:
    """Return a grid at twice the resolution. size: rows and columns of the result; both have a margin of `_MARGIN`."""
    return _double_rows(_double_rows(grid, size[0]).swapaxes(0, 1), size[1]).swapaxes(0, 1)


def _double_rows(grid: Floats, count: int) -> Floats:
    """Interpolate to twice the resolution along the first axis: `count` rows, the first of which lies `_MARGIN` rows
    before the picture."""
    coarse_rows = (np.arange(count) - _MARGIN) // 2 + _MARGIN  # the coarse row that holds each fine one
    is_odd_row = (np.arange(count) - _MARGIN) % 2 == 1
    result = np.zeros((count, *grid.shape[1:]), np.float32)
    # An even fine row lies a quarter of a row before the middle of its coarse row, an odd one a quarter after it.
    for is_odd, weights, offset in ((False, _WEIGHTS[::-1], -2), (True, _WEIGHTS, -1)):
        rows = coarse_rows[is_odd_row == is_odd]
        result[is_odd_row == is_odd] = sum(
            np.float32(weights[tap]) * grid[np.clip(rows + offset + tap, 0, len(grid) - 1)] for tap in range(4))
    return result


def draw_layers(look: Look, flares: Mapping[str, PlaneGaussians], intrinsics: ArrayLike, width: int,
                height: int) -> dict[str, Floats]:
    """Return the scene-linear light (height, width, 3) of each light's flare over black; the layers add up.

    With the blend "over" a light's layer is the increase of the picture's light when its flare is drawn over the flares
    of the lights after it; it is negative where that flare covers a brighter one.
    """
    if look.blend == "add":
        return {name: draw_added(gaussians, look, intrinsics, width, height) for name, gaussians in flares.items()}
    layers: dict[str, Floats] = {}
    light_below = display = np.zeros((height, width, 3), np.float32)
    for name, gaussians in reversed(list(flares.items())):  # the first light lies in front
        colour, transmittance = draw_with_transmittance([gaussians], intrinsics, width, height, look.blend,
                                                        look.pixel_grid)
        display = colour + transmittance[..., None] * display
        light_above = np.asarray(linear_from_srgb(np.maximum(display, 0)), np.float32)
        layers[name], light_below = light_above - light_below, light_above
    return {name: layers[name] for name in flares}
