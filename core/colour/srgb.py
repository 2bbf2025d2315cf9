# SPDX-License-Identifier: GPL-3.0-or-later
"""The sRGB transfer curve (IEC 61966-2-1) and Rec. 709 luminance, for numpy arrays.

`srgb_torch.py` has the same curve for tensors, with gradients.
"""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.float32]
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear Rec. 709 channels in the luminance."""


def srgb_from_linear(linear: NDArray[Any]) -> Pixels:
    """Encode by IEC 61966-2-1, continued unclipped above 1 and mirrored below 0."""
    size = np.abs(np.asarray(linear, np.float32))
    curve = 1.055 * np.power(np.maximum(size, 0.0031308), np.float32(1 / 2.4)) - 0.055
    return np.copysign(np.where(size <= 0.0031308, 12.92 * size, curve), linear).astype(np.float32)


def linear_from_srgb(display: NDArray[Any]) -> Pixels:
    """Decode: the inverse of `srgb_from_linear`."""
    size = np.abs(np.asarray(display, np.float32))
    curve = np.power((np.maximum(size, 0.04045) + 0.055) / 1.055, np.float32(2.4))
    return np.copysign(np.where(size <= 0.04045, size / 12.92, curve), display).astype(np.float32)
