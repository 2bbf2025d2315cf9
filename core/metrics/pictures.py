# SPDX-License-Identifier: GPL-3.0-or-later
"""Scores of one picture against another: PSNR, SSIM, FLIP, relative error of linear light.

Pictures are (height, width, 3) or (height, width), numpy. Display scores take sRGB values 0..1.
"""
from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingsError

Borders = Literal["valid", "same"]
Array = NDArray[Any]
Perceptual = Callable[[NDArray[np.float32], NDArray[np.float32]], float]
"""LPIPS, of two pictures of display values (height, width, 3)."""

WINDOW = 11
SIGMA = 1.5
"""Side and standard deviation of the window of SSIM, pixels."""


def psnr(image: Array, target: Array, mask: Array | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB for a peak of 1; infinite if the pictures are equal.

    mask: (height, width) bool, the pixels to score; NaN if there are none. Raises SettingsError if the sizes differ.
    """
    difference = _masked_difference(image, target, mask)
    if difference.size == 0:
        return math.nan
    error = float(np.mean(np.square(difference)))
    return math.inf if error == 0 else -10 * math.log10(error)


def relative_l2(image: Array, target: Array, mask: Array | None = None) -> float:
    """Return |image - target| / |target| in the L2 norm: 0 is exact, 1 is the score of an empty picture.

    mask: (height, width) bool, the pixels to score. NaN if the target is empty.
    """
    error = float(np.linalg.norm(_masked_difference(image, target, mask)))
    size = float(np.linalg.norm(_masked_difference(target, np.zeros_like(target), mask)))
    return error / size if size > 0 else math.nan


def _masked_difference(image: Array, target: Array, mask: Array | None) -> NDArray[np.float64]:
    """Return the differences of the pixels to score, in one row. Raises SettingsError if the sizes differ."""
    _check_same_size(image, target)
    difference = np.asarray(image, np.float64) - np.asarray(target, np.float64)
    return difference.ravel() if mask is None else difference[mask].ravel()


def _check_same_size(image: Array, target: Array) -> None:
    """Raise SettingsError if two pictures have different sizes."""
    if image.shape != target.shape:
        raise SettingsError(f"Pictures of sizes {image.shape} and {target.shape} cannot be compared; "
                            f"resize one of them.")


def ssim(image: Array, target: Array, borders: Borders = "valid", mask: Array | None = None) -> float:
    """Return the structural similarity, Wang et al. 2004, eq. 13: 11x11 Gaussian window of sigma 1.5, K = 0.01, 0.03.

    borders: "valid" counts only windows inside the picture, as the authors' program does; "same" pads with zeros and
    counts every pixel, as the 3DGS losses and tables do (slightly higher). The mean is over pixels and channels.
    mask: (height, width) bool; a window counts if its middle is set. Raises SettingsError for a picture smaller than
    the window.
    """
    _check_same_size(image, target)
    if borders == "valid" and min(image.shape[:2]) < WINDOW:
        raise SettingsError(f"SSIM needs pictures of {WINDOW} pixels or more a side, not "
                            f"{image.shape[1]} x {image.shape[0]}.")
    x, y = np.asarray(image, np.float64), np.asarray(target, np.float64)
    c1, c2 = 0.01 ** 2, 0.03 ** 2
    mean_x, mean_y = _blur(x, borders), _blur(y, borders)
    variance_x = _blur(x * x, borders) - mean_x ** 2
    variance_y = _blur(y * y, borders) - mean_y ** 2
    covariance = _blur(x * y, borders) - mean_x * mean_y
    similarity = ((2 * mean_x * mean_y + c1) * (2 * covariance + c2)
                  / ((mean_x ** 2 + mean_y ** 2 + c1) * (variance_x + variance_y + c2)))
    if mask is not None:
        # With "valid" borders the similarity map is smaller than the picture.
        margin = (image.shape[0] - similarity.shape[0]) // 2
        similarity = similarity[mask[margin:mask.shape[0] - margin, margin:mask.shape[1] - margin]]
    return float(similarity.mean()) if similarity.size else math.nan


def _blur(picture: NDArray[np.float64], borders: Borders) -> NDArray[np.float64]:
    """Convolve with the Gaussian window, one axis after the other; "valid" makes the picture smaller by the window."""
    offsets = np.arange(WINDOW) - WINDOW // 2
    window = np.exp(-offsets ** 2 / (2 * SIGMA ** 2))
    window /= window.sum()
    for axis in (0, 1):
        if borders == "same":
            pad = [(WINDOW // 2, WINDOW // 2) if a == axis else (0, 0) for a in range(picture.ndim)]
            picture = np.pad(picture, pad)
        length = picture.shape[axis] - WINDOW + 1
        weighted_shifts = (weight * np.take(picture, range(i, i + length), axis) for i, weight in enumerate(window))
        picture = sum(weighted_shifts, np.zeros(()))
    return picture


def flip(image: Array, target: Array, mask: Array | None = None) -> float:
    """Return the mean LDR-FLIP (Andersson et al. 2020), 0 for equal pictures, up to 1, at 67 pixels per degree.

    mask: (height, width) bool, the pixels to score; NaN if there are none.
    """
    from .flip import flip_map

    _check_same_size(image, target)
    errors = flip_map(image, target)
    scored_errors = errors if mask is None else errors[mask]
    return float(scored_errors.mean(dtype=np.float64)) if scored_errors.size else math.nan
