# SPDX-License-Identifier: GPL-3.0-or-later
"""The lights themselves in a picture: discs that the camera clipped."""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .camera import Camera

SOURCE = 0.02
"""Radius about a light, of the frame's width, in which what is white is taken for the light itself."""
WHITE = 0.93
"""Display value from which a pixel of a light's disc counts as clipped: JPEG and noise leave white a little less."""


def clipped_discs(display: NDArray[np.float32], camera: Camera, lights: ArrayLike) -> NDArray[np.bool_]:
    """(height, width): which pixels of the camera's picture, display values (height, width, 3), are clipped and so near
    to where one of the lights (n, 3), world coordinates, is seen that they are the light's own."""
    near = squared_distances(camera, lights) < SOURCE**2
    return np.asarray(near & (display >= WHITE).all(-1))


def squared_distances(camera: Camera, lights: ArrayLike) -> NDArray[np.float32]:
    """(height, width): each pixel's distance to the nearest place where one of the lights (n, 3), world coordinates,
    is seen, in widths of the frame, squared; infinite where none is in front of the camera."""
    pixels, depth = camera.project(lights)
    across = np.arange(camera.width, dtype=np.float32) + np.float32(0.5)
    down = np.arange(camera.height, dtype=np.float32)[:, None] + np.float32(0.5)
    squared = np.full((camera.height, camera.width), np.inf, np.float32)
    for (x, y), z in zip(pixels.astype(np.float32), depth, strict=True):
        if z > 0:
            squared = np.minimum(squared, (across - x) ** 2 + (down - y) ** 2)
    return squared / np.float32(camera.width**2)
