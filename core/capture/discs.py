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
    """(height, width): which pixels of a picture of display values (height, width, 3) are clipped and so near to where
    one of the lights (n, 3), world coordinates, is seen that they are the light's own."""
    height, width = display.shape[:2]
    pixels, depth = camera.project(lights)
    across, down = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
    near = np.zeros((height, width), bool)
    for (x, y), z in zip(pixels, depth, strict=True):
        if z > 0:
            near |= (across - x) ** 2 + (down - y) ** 2 < (SOURCE * width) ** 2
    return np.asarray(near & (display >= WHITE).all(-1))
