# SPDX-License-Identifier: GPL-3.0-or-later
"""The pixel grid that Gaussians were fitted at, and the low-pass filter that renders them alike on another grid.

A rasterizer adds `DILATION` to a Gaussian's projected covariance (3DGS's low-pass filter), so a fit makes its Gaussians
thinner by that amount. On a finer grid with the same filter they are too thin, on a coarser one too thick: a scene
breaks up or swells, and a flare loses or gains light (Yu et al. 2024, "Mip-Splatting", section 3, whose filters need
training with them). The filter of the fit's grid, converted to pixels of the rendered picture, reproduces the fit.
Scenes and looks carry a `PixelGrid`; `core/gaussians` and `core/look` use `dilation`.
"""
from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

DILATION = 0.3
"""Added to the diagonal of projected covariances, px²: nothing is thinner than about half a pixel."""
PIXEL_VARIANCE = 1 / 12
"""Variance of a pixel's square, px²: with a smaller filter, thin Gaussians fall between the pixel centres."""
SIZE_TOLERANCE = 1e-3
"""Relative difference of size below which two grids count as equal."""
MIN_PIXEL_RATIO = 0.95
"""Pixel ratio from which a scene is rendered without supersampling."""
MAX_PIXELS = 1 << 23
"""Largest supersampled picture."""


@dataclass(frozen=True)
class PixelGrid:
    """The smallest and greatest focal length, px, of the frames of a fit, at the size at which the fit used them.

    They differ if a lens was zoomed. Raises ValueError where they are no focal lengths.
    """

    min_focal_length: float
    max_focal_length: float

    def __post_init__(self) -> None:
        if not 0 < self.min_focal_length <= self.max_focal_length < math.inf:
            raise ValueError(f"no focal lengths are from {self.min_focal_length} to {self.max_focal_length} pixels")

    @classmethod
    def from_focal_lengths(cls, focal_lengths: Iterable[float]) -> PixelGrid:
        """Return the grid of frames with these focal lengths, px."""
        lengths = list(focal_lengths)
        return cls(min(lengths), max(lengths))

    @classmethod
    def read(cls, entry: Mapping[str, Any] | None) -> PixelGrid | None:
        """Read the entry of a file; None where it has none. Raises TypeError, KeyError or ValueError if invalid."""
        return None if entry is None else cls(float(entry["least"]), float(entry["most"]))

    def to_entry(self) -> dict[str, float]:
        """Return the entry that `read` reads."""
        return {"least": self.min_focal_length, "most": self.max_focal_length}

    def pixel_ratio(self, focal_length: float) -> float:
        """Pixels of a picture per pixel of the fit's frames, along one axis; 1 for a focal length inside the range.

        focal_length: that of the picture, px.
        """
        ratio = focal_length / min(max(focal_length, self.min_focal_length), self.max_focal_length)
        return 1.0 if abs(ratio - 1) < SIZE_TOLERANCE else ratio

    def supersampling_factor(self, focal_length: float, width: int, height: int) -> int:
        """Return the factor by which to render a picture larger, to be averaged down: large enough that no Gaussian
        falls between the pixels, limited by `MAX_PIXELS`; 1 if the picture is as fine as the frames."""
        ratio = self.pixel_ratio(focal_length)
        if ratio >= MIN_PIXEL_RATIO:
            return 1
        return max(min(math.ceil(1 / ratio), math.isqrt(MAX_PIXELS // (width * height))), 1)


def dilation(pixel_grid: PixelGrid | None, focal_length: float) -> float:
    """Low-pass filter, px², for a picture of this focal length, px; `DILATION` where the grid is unknown (None)."""
    if pixel_grid is None:
        return DILATION
    return max(DILATION * pixel_grid.pixel_ratio(focal_length) ** 2, PIXEL_VARIANCE)
