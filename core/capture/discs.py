# SPDX-License-Identifier: GPL-3.0-or-later
"""Light discs: the clipped pixels of the lights themselves in a frame. Fits and snapping leave them out of the flare.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .camera import Camera

DISC_RADIUS = 0.02
"""Distance from a light, in frame widths, within which a clipped pixel belongs to its disc."""
CLIP_LEVEL = 0.93
"""Display value from which a pixel of a disc counts as clipped: JPEG and noise leave white a little lower."""


def light_disc_mask(display: NDArray[np.float32], camera: Camera, lights: ArrayLike) -> NDArray[np.bool_]:
    """Return the mask (height, width) of the lights' discs in a picture of the camera, display values (height, width,
    3).

    A pixel belongs to a disc if it is clipped and close to the projection of one of the lights (n, 3), world
    coordinates.
    """
    mask = squared_light_distances(camera, lights) < DISC_RADIUS**2
    mask[mask] = (display[mask] >= CLIP_LEVEL).all(-1)
    return mask


def squared_light_distances(camera: Camera, lights: ArrayLike) -> NDArray[np.float32]:
    """Return (height, width) squared distances of pixels to the nearest projection of lights (n, 3), in frame widths.

    Infinite where no light is in front of the camera.
    """
    pixels, depth = camera.project(lights)
    across = np.arange(camera.width, dtype=np.float32) + np.float32(0.5)
    down = np.arange(camera.height, dtype=np.float32)[:, None] + np.float32(0.5)
    squared = np.full((camera.height, camera.width), np.inf, np.float32)
    for (x, y), z in zip(pixels.astype(np.float32), depth, strict=True):
        if z > 0:
            squared = np.minimum(squared, (across - x) ** 2 + (down - y) ** 2)
    return squared / np.float32(camera.width**2)
