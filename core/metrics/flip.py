# SPDX-License-Identifier: GPL-3.0-or-later
"""LDR-FLIP of Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images", with separable filters.

`pictures.flip` calls `flip_map`. Section numbers below are those of the paper. Every filter is a Gaussian, a derivative
of one, or a sum of two, so each is applied by rows and by columns. Agrees with NVIDIA's flip-evaluator to rounding.
"""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..colour.srgb import linear_from_srgb

Plane = NDArray[np.float32]
Planes = NDArray[np.float32]

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180
"""A display 0.7 m wide with 3840 pixels, seen from 0.7 m."""
_CONTRAST = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
"""Contrast sensitivity of luminance, red-green and blue-yellow as Gaussians (a, b) of the frequency, table 1."""
_EDGE_WIDTH = 0.082
"""Degrees, section 4.2."""
_COLOUR_EXPONENT, _KNEE, _KNEE_VALUE = 0.7, 0.4, 0.95
"""q_c, p_c and p_t of section 4.1.3."""
_FEATURE_EXPONENT = 0.5
"""q_f of section 4.2."""
_XYZ_FROM_RGB = np.array([[10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
                          [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
                          [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382]])
_WHITE = _XYZ_FROM_RGB.sum(1)
_OPPONENT_FROM_XYZ = np.array([[0.0, 116.0, 0.0], [500.0, -500.0, 0.0], [0.0, 200.0, -200.0]]) / _WHITE
"""Y C_x C_z without the offset of Y, which no filter changes."""
_OPPONENT_FROM_RGB = (_OPPONENT_FROM_XYZ @ _XYZ_FROM_RGB).astype(np.float32)
_RGB_FROM_OPPONENT = np.linalg.inv(_OPPONENT_FROM_XYZ @ _XYZ_FROM_RGB).astype(np.float32)
_RELATIVE_XYZ_FROM_RGB = (_XYZ_FROM_RGB / _WHITE[:, None]).astype(np.float32)


def flip_map(image: Planes, target: Planes) -> Plane:
    """Return the FLIP error (height, width), 0 to 1, between sRGB pictures (height, width, 3), at 67 pixels per degree.

    Values beyond 0..1 are clipped.
    """
    opponents = [_to_opponent(picture) for picture in (image, target)]
    colour = _redistribute(_hyab_distance(*(_to_perceived_lab(planes) for planes in opponents)))
    exponent = 1 - _feature_difference(*(planes[..., 0] / 116 for planes in opponents))
    return np.asarray(np.power(colour, exponent), np.float32)


def _to_opponent(picture: Planes) -> Planes:
    """Convert sRGB to Y C_x C_z."""
    return _apply_matrix(linear_from_srgb(np.clip(picture, 0, 1).astype(np.float32)), _OPPONENT_FROM_RGB)


def _apply_matrix(planes: Planes, matrix: NDArray[np.float32]) -> Planes:
    """Apply a matrix (3, 3) to each pixel."""
    return np.asarray(planes.reshape(-1, 3) @ matrix.T, np.float32).reshape(planes.shape)


def _to_perceived_lab(planes: Planes) -> Planes:
    """Filter Y C_x C_z by the contrast sensitivity, and convert to Hunt-adjusted L*a*b*, sections 4.1.1 and 4.1.2."""
    lab = _to_lab(np.clip(_apply_matrix(_filter_contrast(planes), _RGB_FROM_OPPONENT), 0, 1))
    lab[..., 1:] *= 0.01 * lab[..., :1]  # Hunt: colours look paler where it is dark
    return lab


def _filter_contrast(planes: Planes) -> Planes:
    """Filter each channel of Y C_x C_z by its contrast sensitivity, section 4.1.1."""
    widest = max(b for gaussians in _CONTRAST for _, b in gaussians)
    radius = math.ceil(3 * math.sqrt(widest / (2 * math.pi ** 2)) * PIXELS_PER_DEGREE)  # three standard deviations
    degrees = np.arange(-radius, radius + 1) / PIXELS_PER_DEGREE
    filtered = np.empty_like(planes)
    for channel, gaussians in enumerate(_CONTRAST):
        rows = [np.exp(-math.pi ** 2 * degrees ** 2 / b) for _, b in gaussians]
        gains = [a * math.sqrt(math.pi / b) for a, b in gaussians]  # the weights of the authors' program
        total = sum(gain * row.sum() ** 2 for gain, row in zip(gains, rows, strict=True))
        plane = np.ascontiguousarray(planes[..., channel])
        filtered[..., channel] = sum(_convolve(plane, row * (gain / total), row)
                                     for gain, row in zip(gains, rows, strict=True))
    return filtered


def _convolve(plane: Plane, row: NDArray[np.float64], column: NDArray[np.float64]) -> Plane:
    """Convolve with a separable filter; the border is repeated outwards."""
    import cv2

    return np.asarray(cv2.sepFilter2D(plane, cv2.CV_32F, row, column, borderType=cv2.BORDER_REPLICATE), np.float32)


def _to_lab(rgb: Planes) -> Planes:
    """Convert linear Rec. 709 to CIE L*a*b*, relative to the white of Rec. 709."""
    relative = _apply_matrix(rgb, _RELATIVE_XYZ_FROM_RGB)
    edge = 6 / 29
    root = np.where(relative > edge ** 3, np.cbrt(relative), relative / (3 * edge ** 2) + 4 / 29)
    x, y, z = root[..., 0], root[..., 1], root[..., 2]
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1).astype(np.float32)


def _hyab_distance(first: Planes, second: Planes) -> Plane:
    """Return the HyAB distance."""
    difference = first - second
    return np.asarray(np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2]), np.float32)


def _largest_distance() -> float:
    """Return the distance of green and blue to the power q_c, the largest of the display."""
    corners = _to_lab(np.array([[[0, 1, 0], [0, 0, 1]]], np.float32))
    corners[..., 1:] *= 0.01 * corners[..., :1]
    return float(_hyab_distance(corners[:, :1], corners[:, 1:])[0, 0]) ** _COLOUR_EXPONENT


def _redistribute(distance: Plane) -> Plane:
    """Map distances to 0..1, section 4.1.3."""
    power, largest = np.power(distance, np.float32(_COLOUR_EXPONENT)), _largest_distance()
    knee = _KNEE * largest
    return np.asarray(np.where(power < knee, power * (_KNEE_VALUE / knee),
                               _KNEE_VALUE + (power - knee) * ((1 - _KNEE_VALUE) / (largest - knee))), np.float32)


def _feature_difference(first: Plane, second: Plane) -> Plane:
    """Return how much edges and points differ between two luminances 0..1, (height, width), by section 4.2: first and
    second derivatives of a Gaussian."""
    sigma = 0.5 * _EDGE_WIDTH * PIXELS_PER_DEGREE
    offsets = np.arange(-math.ceil(3 * sigma), math.ceil(3 * sigma) + 1)
    gaussian = np.exp(-offsets ** 2 / (2 * sigma ** 2))
    edges = -offsets * gaussian
    points = (offsets ** 2 / sigma ** 2 - 1) * gaussian
    largest = np.zeros(first.shape, np.float32)
    for row in (edges, points):
        # Scale positive and negative weights separately, so that each sum to 1 in magnitude.
        row = np.where(row > 0, row / row[row > 0].sum(), row / -row[row < 0].sum())
        smoothing = gaussian / gaussian.sum()
        strengths = [np.hypot(_convolve(plane, row, smoothing), _convolve(plane, smoothing, row))
                     for plane in map(np.ascontiguousarray, (first, second))]
        np.maximum(largest, np.abs(strengths[0] - strengths[1]), out=largest)
    return np.asarray(np.power(largest / np.float32(math.sqrt(2)), np.float32(_FEATURE_EXPONENT)), np.float32)
