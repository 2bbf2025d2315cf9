# SPDX-License-Identifier: GPL-3.0-or-later
"""Data and display windows: where the stored pixels of a file lie on its frame."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..colour.srgb import Pixels


@dataclass(frozen=True)
class DataWindow:
    """The place of a file's stored pixels on the frame.

    size: (width, height) of what is stored; origin: (x, y) of its first pixel on the frame, negative with overscan;
    frame: (width, height); aspect: pixel aspect ratio (width / height).
    """

    size: tuple[int, int]
    origin: tuple[int, int]
    frame: tuple[int, int]
    aspect: float = 1.0

    @property
    def is_frame(self) -> bool:
        """True if the stored pixels are exactly the frame."""
        return self.size == self.frame and self.origin == (0, 0)

    def header(self) -> dict[str, Any]:
        """Return the EXR attributes of these windows, for a frame that begins at 0."""
        (x, y), (width, height) = self.origin, self.size
        boxes = {"dataWindow": ((x, y), (x + width - 1, y + height - 1)),
                 "displayWindow": ((0, 0), (self.frame[0] - 1, self.frame[1] - 1))}
        return {name: tuple(np.array(corner, np.int32) for corner in box) for name, box in boxes.items()}


def crop_to_display_window(pixels: Pixels, window: DataWindow) -> Pixels:
    """Return the frame of pixels (height, width, ...) that lie in a data window, 0 where there are none."""
    if window.is_frame:
        return pixels
    (width, height), (x, y) = window.frame, window.origin
    whole = np.zeros((height, width, *pixels.shape[2:]), np.float32)
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + window.size[0], width), min(y + window.size[1], height)
    if right > left and bottom > top:
        whole[top:bottom, left:right] = pixels[top - y:bottom - y, left - x:right - x]
    return whole
