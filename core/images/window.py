# SPDX-License-Identifier: GPL-3.0-or-later
"""Data and display windows: where the stored pixels of a file lie on its frame."""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..colour.srgb import Pixels

TRANSPOSED = 5
"""First Exif orientation whose sides change places."""


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
        """Return whether the stored pixels are exactly the frame."""
        return self.size == self.frame and self.origin == (0, 0)

    @property
    def holds_frame(self) -> bool:
        """Return whether all of the frame is stored."""
        return all(origin <= 0 and origin + size >= frame
                   for origin, size, frame in zip(self.origin, self.size, self.frame, strict=True))

    def oriented(self, orientation: int) -> DataWindow:
        """Return the window of a picture as viewers show it, by its Exif orientation.

        Formats with an orientation store the whole frame, so that swapped sides are all that changes.
        """
        if orientation < TRANSPOSED:
            return self
        return replace(self, size=self.size[::-1], origin=self.origin[::-1], frame=self.frame[::-1],
                       aspect=1 / self.aspect)

    def header(self) -> dict[str, Any]:
        """Return the EXR attributes of these windows, for a frame that begins at 0."""
        (x, y), (width, height) = self.origin, self.size
        boxes = {"dataWindow": ((x, y), (x + width - 1, y + height - 1)),
                 "displayWindow": ((0, 0), (self.frame[0] - 1, self.frame[1] - 1))}
        return {name: tuple(np.array(corner, np.int32) for corner in box) for name, box in boxes.items()}


def union_window(windows: Iterable[DataWindow]) -> DataWindow:
    """Return the window that holds the frame and all `windows`, which are of one frame."""
    all_windows = list(windows)
    width, height = all_windows[0].frame
    left, top = (min(0, *(window.origin[axis] for window in all_windows)) for axis in (0, 1))
    right, bottom = (max((width, height)[axis], *(window.origin[axis] + window.size[axis] for window in all_windows))
                     for axis in (0, 1))
    return DataWindow((right - left, bottom - top), (left, top), (width, height), all_windows[0].aspect)


def move_to_window(pixels: Pixels, source: DataWindow, target: DataWindow) -> Pixels:
    """Move pixels (height, width, ...) from the data window `source` to the data window `target` of the same frame:
    crop, and fill with 0 where `source` has none."""
    if (source.size, source.origin) == (target.size, target.origin):
        return pixels
    left, top = (source.origin[axis] - target.origin[axis] for axis in (0, 1))
    return crop_to_display_window(pixels, DataWindow(source.size, (left, top), target.size))


def crop_to_display_window(pixels: Pixels, window: DataWindow) -> Pixels:
    """Crop pixels (height, width, ...) of the data window to the frame (display window); 0 where there are none."""
    if window.is_frame:
        return pixels
    (width, height), (x, y) = window.frame, window.origin
    frame = np.zeros((height, width, *pixels.shape[2:]), np.float32)
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + window.size[0], width), min(y + window.size[1], height)
    if right > left and bottom > top:
        frame[top:bottom, left:right] = pixels[top - y:bottom - y, left - x:right - x]
    return frame
