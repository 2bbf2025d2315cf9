# SPDX-License-Identifier: GPL-3.0-or-later
"""A picture in memory: float32 pixels, height x width x 3, row 0 on top, with their encoding.

The encoding is "srgb" for 8 and 16 bit files (display values 0..1, IEC 61966-2-1) and "linear" for EXR (scene-linear
Rec. 709, any value). OpenCV is imported where it is used, because Blender's own Python has none.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..colour.srgb import Pixels, linear_from_srgb, srgb_from_linear

Encoding = Literal["srgb", "linear"]


@dataclass(frozen=True)
class Picture:
    """Pixels (height, width, 3) float32 and how they are encoded."""

    pixels: Pixels
    encoding: Encoding

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def display(self, white: float = 1.0) -> Pixels:
        """Return sRGB display values, clipped to 0..white; a screen clips at 1."""
        pixels = srgb_from_linear(self.pixels) if self.encoding == "linear" else self.pixels
        return np.clip(pixels, 0.0, white)

    def linear(self) -> Pixels:
        """Scene-linear Rec. 709 values."""
        return linear_from_srgb(self.pixels) if self.encoding == "srgb" else self.pixels

    def resized(self, width: int, height: int) -> Picture:
        """Return the picture at another size: shrunk by area averages of light, as a coarser sensor sees it, or grown
        bicubically."""
        if (width, height) == self.size:
            return self
        import cv2

        if width > self.size[0] or height > self.size[1]:
            grown = cv2.resize(self.pixels, (width, height), interpolation=cv2.INTER_CUBIC)
            return Picture(np.asarray(grown, np.float32), self.encoding)
        light = np.asarray(cv2.resize(self.linear(), (width, height), interpolation=cv2.INTER_AREA), np.float32)
        return Picture(srgb_from_linear(light) if self.encoding == "srgb" else light, self.encoding)


def same_aspect(size: tuple[int, int], other_size: tuple[int, int]) -> bool:
    """Return whether one size (width, height) is the other, scaled and rounded to whole pixels.

    Each side of the smaller size, scaled to the larger, may differ from it by one pixel of the smaller (`scale`).
    """
    small, large = sorted((size, other_size))
    scale = max(large[0] / small[0], large[1] / small[1])
    return (abs(large[0] - small[0] * scale) <= max(scale, 1.0) + 1e-9
            and abs(large[1] - small[1] * scale) <= max(scale, 1.0) + 1e-9)
