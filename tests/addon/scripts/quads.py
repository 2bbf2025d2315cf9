# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the overlay's quads with numpy as the shaders draw them, since no GPU is in a Blender without a window."""
from __future__ import annotations

import numpy as np


def drawn_levels(overlay, gaussians, window, look):
    """Draw the overlay's quads with numpy, as its shaders do; return the picture (h, w, 3), scene-linear.

    Each level is a picture of 1 / divisor of the size, in which a quad adds its Gaussian, ring or arc; the levels are
    enlarged and added.
    """
    total = np.zeros((window.height, window.width, 3), np.float32)
    for divisor, quads in overlay.quads_by_level(gaussians, window, look).items():
        size = -(-window.height // divisor), -(-window.width // divisor)
        level = np.zeros((*size, 3), np.float32)
        x, y = np.arange(size[1]) + 0.5, np.arange(size[0])[:, None] + 0.5
        for first in range(0, len(quads.place), 4):
            corner, across, up = quads.place[first], quads.place[first + 1], quads.place[first + 3]
            affine = np.linalg.inv(np.stack([across - corner, up - corner], -1).astype(np.float64))
            u = affine[0, 0] * (x - corner[0]) + affine[0, 1] * (y - corner[1])
            v = affine[1, 0] * (x - corner[0]) + affine[1, 1] * (y - corner[1])
            reach = quads.local[first + 1, 0]
            p, q = (2 * u - 1) * reach, (2 * v - 1) * reach
            (r0, w, _), (along, aside, log_peak) = quads.ring[first], quads.arc[first]
            profile = np.exp(along * p + aside * q - log_peak
                             - 0.5 * ((np.maximum(np.hypot(p, q), 1e-6) - r0) / w) ** 2)
            inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1) & (profile >= 1 / 4096)
            level += np.where(inside, profile, 0)[..., None] * quads.light[first]
        total += enlarged(level, divisor, window)
    return np.maximum(total, 0)


def enlarged(level, divisor, window):
    """Enlarge a level bilinearly by `divisor` to the size of the window; rows are counted from the top."""
    def places(length, most):
        where = (np.arange(length) + 0.5) / divisor - 0.5
        low = np.floor(where).astype(int)
        return np.clip(low, 0, most - 1), np.clip(low + 1, 0, most - 1), where - low

    top, bottom, down = places(window.height, level.shape[0])
    left, right, across = places(window.width, level.shape[1])
    down, across = down[:, None, None], across[None, :, None]
    upper = level[top][:, left] * (1 - across) + level[top][:, right] * across
    lower = level[bottom][:, left] * (1 - across) + level[bottom][:, right] * across
    return upper * (1 - down) + lower * down
