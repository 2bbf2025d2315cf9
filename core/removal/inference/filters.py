# SPDX-License-Identifier: GPL-3.0-or-later
"""Resampling and blurs that `confidence`, `optical_flow`, `streaks` and `temporal` share."""
from __future__ import annotations

import numpy as np

from ...colour.srgb import Pixels

DOWNSAMPLING = 2
"""Side of one pixel of the flow, pixels of the frame."""


def downsample(values: Pixels) -> Pixels:
    """Average squares of DOWNSAMPLING pixels: (h, w, c) to (h / DOWNSAMPLING, w / DOWNSAMPLING, c)."""
    import cv2

    height, width = values.shape[:2]
    return np.asarray(cv2.resize(values, (width // DOWNSAMPLING, height // DOWNSAMPLING),
                                 interpolation=cv2.INTER_AREA))


def upsample(values: Pixels, like: Pixels) -> Pixels:
    """Interpolate to the height and width of `like`, bilinearly."""
    import cv2

    height, width = like.shape[:2]
    return np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def blur(values: Pixels, sigma: float) -> Pixels:
    """Apply a Gaussian blur; sigma in pixels."""
    import cv2

    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma), np.float32)
