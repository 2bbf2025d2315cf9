# SPDX-License-Identifier: GPL-3.0-or-later
"""Highlights of a picture as lights: every clipped or bright spot, with its place and light; called by `transfer`.

Spots are not tracked, and nothing jumps from frame to frame. Each bright pixel shares its light among the four nearest
nodes of a coarse grid, by its distance to them; a node's place is the centre of the light that it received. A spot that
moves passes its light from node to node, while their places stay on it. Spots nearer than two nodes share one place.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..colour.srgb import LUMINANCE

Floats = NDArray[np.float64]

NODES = 20
"""Number of nodes along the longer side of the frame."""
SOFTNESS = 0.05
"""Part above the threshold over which a pixel's weight rises from 0 to 1."""
REFERENCE_AREA = 1 / 2000
"""Part of the frame that, at white, has a light of 1: a lamp's disc of about 2 % of the height."""
FAINTEST = 5e-4, 2e-3
"""Part of the whole light over which a node's weight rises from 0 to 1."""


@dataclass(frozen=True, eq=False)
class Highlights:
    """Lights (n): xy (n, 2), pixels, centres at +0.5; light (n, 3), linear RGB, 1 for REFERENCE_AREA of white."""

    xy: Floats
    light: Floats

    def __len__(self) -> int:
        return len(self.xy)


def find_highlights(linear: NDArray[np.float32], threshold: float = 0.95, gain: float = 1.0) -> Highlights:
    """Return the highlights of a picture (height, width, 3), scene-linear.

    threshold: luminance from which pixels count, 1 is white. gain: factor of the light.
    """
    height, width = linear.shape[:2]
    luminance = linear @ LUMINANCE.astype(np.float32)
    rows, columns = np.nonzero(np.isfinite(luminance) & (luminance > threshold))
    if not len(rows):
        return Highlights(np.zeros((0, 2)), np.zeros((0, 3)))
    # Smoothstep of the part above the threshold, so that no pixel appears at once.
    t = np.clip((luminance[rows, columns].astype(np.float64) / threshold - 1) / SOFTNESS, 0, 1)
    colours = np.maximum(linear[rows, columns], 0).astype(np.float64) * (t * t * (3 - 2 * t))[:, None]
    xy = np.stack([columns + 0.5, rows + 0.5], -1)
    spacing = max(width, height) / (NODES - 1)
    # Nodes across and down, numbered by row. `low` is the node above and left of each pixel.
    shape = np.array([int(width / spacing) + 2, int(height / spacing) + 2])
    at = xy / spacing
    low = np.floor(at).astype(int)
    light, places, strengths = (np.zeros((int(shape.prod()), size)) for size in (3, 2, 1))
    for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
        # Bilinear: 1 at the node, 0 at its neighbours.
        share = np.prod(np.where(corner, at - low, 1 - (at - low)), axis=1)
        node = (low[:, 1] + corner[1]) * shape[0] + low[:, 0] + corner[0]
        lit = colours * share[:, None]
        strength = lit.sum(1)
        for column in range(3):
            light[:, column] += np.bincount(node, lit[:, column], len(light))
        for column in range(2):
            places[:, column] += np.bincount(node, strength * xy[:, column], len(light))
        strengths[:, 0] += np.bincount(node, strength, len(light))
    # Faint nodes fade out in the same way.
    part = strengths[:, 0] / strengths.sum() if strengths.any() else strengths[:, 0]
    t = np.clip((part - FAINTEST[0]) / (FAINTEST[1] - FAINTEST[0]), 0, 1)
    chosen = np.flatnonzero(t > 0)
    scale = gain * (t * t * (3 - 2 * t))[chosen, None] / (REFERENCE_AREA * width * height)
    return Highlights(places[chosen] / strengths[chosen], light[chosen] * scale)
