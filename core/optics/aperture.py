# SPDX-License-Identifier: GPL-3.0-or-later
"""The aperture stop: a polygon of slightly uneven, slightly curved blades."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EDGE_STEPS = 1440
"""Directions of the edge that `transmission` computes: steps of a quarter of a degree."""
MIN_FACING = 0.05
"""Cosine of 87 degrees: the largest angle between a direction and the normal of a blade that bounds it."""

ABSORPTION = 0.9
"""Share of the light that a speck of dust or a scratch takes."""


@dataclass(frozen=True)
class Aperture:
    """An aperture stop.

    radius: of the circle through the corners, mm. turn: of the first corner from +x, degrees. curved: 0 for straight
    blades, 1 for a circle. uneven: standard deviation of the blades' distances from the centre, relative to the radius.
    dust: number of specks. seed: of the unevenness, dust and scratches. scratches: number of fine straight lines.
    """

    radius: float
    blades: int
    turn: float = 0.0
    curved: float = 0.1
    uneven: float = 0.01
    dust: int = 30
    seed: int = 0
    scratches: int = 0


def edge_radius(aperture: Aperture, sectors: int) -> Array:
    """Return (sectors,), the distance of the stop's edge from its centre, relative to the radius, in `sectors` even
    directions from +x towards +y."""
    rng = np.random.default_rng(aperture.seed)
    angles = np.arange(sectors) / sectors * 2 * np.pi
    normals = np.radians(aperture.turn) + (np.arange(aperture.blades) + 0.5) / aperture.blades * 2 * np.pi
    apothem = np.cos(np.pi / aperture.blades) * (1 + aperture.uneven * rng.standard_normal(aperture.blades))
    # A blade is a straight line at its apothem; it bounds the directions that it faces.
    facing = np.cos(angles[:, None] - normals)
    straight = np.where(facing > MIN_FACING, apothem / np.maximum(facing, MIN_FACING), np.inf).min(axis=1)
    return (1 - aperture.curved) * straight + aperture.curved


def transmission(aperture: Aperture, size: int, fill: float) -> Array:
    """Return the stop's transmission as a picture (size, size), 0..1.

    Dust and scratches on the glass absorb ABSORPTION of the light. fill: radius of the stop over half the picture's
    side."""
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(axis / fill, axis / fill)
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    edge_table = edge_radius(aperture, EDGE_STEPS)
    table_angles = np.arange(EDGE_STEPS + 1) / EDGE_STEPS * 2 * np.pi
    edge = np.interp(angle % (2 * np.pi), table_angles, np.append(edge_table, edge_table[0]))
    mask = np.clip((edge - radius) * fill * size / 2 + 0.5, 0, 1)  # distances in pixels: an edge is one pixel wide
    rng = np.random.default_rng(aperture.seed + 1)
    for _ in range(aperture.dust):
        offset, azimuth, speck_radius = np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi), rng.uniform(0.004, 0.02)
        distance = np.hypot(x - offset * np.cos(azimuth), y - offset * np.sin(azimuth))
        mask *= 1 - ABSORPTION * np.clip((speck_radius - distance) * fill * size / 2 + 0.5, 0, 1)
    for _ in range(aperture.scratches):
        rotation, offset, width = rng.uniform(0, np.pi), rng.uniform(-0.9, 0.9), rng.uniform(0.002, 0.006)
        centre, half_length = rng.uniform(-0.6, 0.6), rng.uniform(0.1, 0.8)
        along, across = x * np.cos(rotation) + y * np.sin(rotation), y * np.cos(rotation) - x * np.sin(rotation)
        distance = np.maximum(np.abs(across - offset) - width, np.abs(along - centre) - half_length)
        mask *= 1 - ABSORPTION * np.clip(0.5 - distance * fill * size / 2, 0, 1)
    return mask
