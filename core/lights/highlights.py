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
from ..conventions.smoothstep import smoothstep

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

    threshold: luminance above which pixels count, 1 is white. gain: factor on the light.
    """
    height, width = linear.shape[:2]
    luminance = linear @ LUMINANCE.astype(np.float32)
    rows, columns = np.nonzero(np.isfinite(luminance) & (luminance > threshold))
    if not len(rows):
        return Highlights(np.zeros((0, 2)), np.zeros((0, 3)))
    # Weights rise smoothly above the threshold, so that no pixel appears suddenly.
    weights = smoothstep(luminance[rows, columns].astype(np.float64) / threshold - 1, 0, SOFTNESS)
    colours = np.maximum(linear[rows, columns], 0).astype(np.float64) * weights[:, None]
    xy = np.stack([columns + 0.5, rows + 0.5], -1)
    light, places, strengths = _share_among_nodes(xy, colours, width, height)
    # Faint nodes fade out in the same way.
    shares = strengths / strengths.sum() if strengths.any() else strengths
    node_weights = smoothstep(shares, *FAINTEST)
    chosen = np.flatnonzero(node_weights > 0)
    scale = gain * node_weights[chosen, None] / (REFERENCE_AREA * width * height)
    return Highlights(places[chosen] / strengths[chosen, None], light[chosen] * scale)


def _share_among_nodes(xy: Floats, colours: Floats, width: int, height: int) -> tuple[Floats, Floats, Floats]:
    """Share the light of pixels at `xy` (n, 2), with these colours (n, 3), among a grid's nodes by a bilinear splat.

    Returns for each node the light (nodes, 3), the sum of the pixels' places times their strength (nodes, 2), and the
    sum of their strengths (nodes,). A strength is the sum of a light's channels. width, height: size of the picture,
    pixels.
    """
    spacing = max(width, height) / (NODES - 1)
    # Nodes across and down, numbered by row.
    across, down = int(width / spacing) + 2, int(height / spacing) + 2
    grid_xy = xy / spacing
    upper_left = np.floor(grid_xy).astype(int)
    light, places, strengths = np.zeros((across * down, 3)), np.zeros((across * down, 2)), np.zeros(across * down)
    for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
        # Bilinear: 1 at the node, 0 at its neighbours.
        share = np.prod(np.where(corner, grid_xy - upper_left, 1 - (grid_xy - upper_left)), axis=1)
        node = (upper_left[:, 1] + corner[1]) * across + upper_left[:, 0] + corner[0]
        shared = colours * share[:, None]
        strength = shared.sum(1)
        for column in range(3):
            light[:, column] += np.bincount(node, shared[:, column], len(light))
        for column in range(2):
            places[:, column] += np.bincount(node, strength * xy[:, column], len(light))
        strengths += np.bincount(node, strength, len(light))
    return light, places, strengths
