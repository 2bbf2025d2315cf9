# SPDX-License-Identifier: GPL-3.0-or-later
"""The grid of pixels that Gaussians were learned on, and what shows them the same on another.

A rasterizer adds `DILATION` to what a Gaussian covers of the picture (3DGS's low-pass), so a fit makes its Gaussians
that much thinner than what they show. Seen on a finer grid with the same low-pass they are too thin, on a coarser one
too thick: a scene then breaks up or swells, and a flare loses light or gains some (Yu et al. 2024, "Mip-Splatting",
section 3, whose filters have to be learned with). The low-pass of a fit's own grid, which is larger or smaller in
pixels of the other, shows what the fit's own picture does.
"""
from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

DILATION = 0.3
"""Added to the diagonal of projected covariances, px²: nothing is thinner than about half a pixel."""
PIXEL = 1 / 12
"""px², the variance of a pixel's own square: with less than that, thin Gaussians fall between the pixels' middles."""
SAME = 1e-3
"""Grids whose sizes differ by less than this share are one."""
NEARLY = 0.95
"""As fine as a grid has to be for what was learned on it to be rendered once, as it is."""
MOST_PIXELS = 1 << 23
"""Of a picture that is rendered larger than it was asked for."""


@dataclass(frozen=True)
class Sampling:
    """least, most: focal lengths, px, of the frames that something was fitted to, at the size at which they were; they
    differ where a lens was zoomed. ValueError where they are no such lengths."""

    least: float
    most: float

    def __post_init__(self) -> None:
        if not 0 < self.least <= self.most < math.inf:
            raise ValueError(f"no focal lengths are from {self.least} to {self.most} pixels")

    @classmethod
    def of(cls, focal_lengths: Iterable[float]) -> Sampling:
        """Of frames of these focal lengths, px."""
        known = list(focal_lengths)
        return cls(min(known), max(known))

    @classmethod
    def read(cls, entry: Mapping[str, Any] | None) -> Sampling | None:
        """From the entry of a file; None where it has none. TypeError, KeyError, ValueError where it makes no sense."""
        return None if entry is None else cls(float(entry["least"]), float(entry["most"]))

    def fineness(self, focal_length: float) -> float:
        """How many pixels of a picture of this focal length, px, lie along one of the frames' pixels."""
        ratio = focal_length / min(max(focal_length, self.least), self.most)
        return 1.0 if abs(ratio - 1) < SAME else ratio

    def samples(self, focal_length: float, width: int, height: int) -> int:
        """How many times as large a scene is rendered for a picture of this size that is coarser than the frames, to be
        averaged: so many that nothing falls between its pixels, and as many as `MOST_PIXELS` leave."""
        fineness = self.fineness(focal_length)
        if fineness >= NEARLY:
            return 1
        return max(min(math.ceil(1 / fineness), math.isqrt(MOST_PIXELS // (width * height))), 1)


def dilation(sampling: Sampling | None, focal_length: float) -> float:
    """The low-pass, px², for a picture of this focal length, px, of what was fitted on this grid; None: not known."""
    return DILATION if sampling is None else max(DILATION * sampling.fineness(focal_length) ** 2, PIXEL)
