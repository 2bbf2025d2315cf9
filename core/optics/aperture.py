# SPDX-License-Identifier: GPL-3.0-or-later
"""The aperture stop: a polygon of slightly uneven, slightly curved blades."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
    """Return the distance of the edge from the centre, relative to the radius, for `sectors` directions from +x round
    to +y."""
    rng = np.random.default_rng(aperture.seed)
    angles = np.arange(sectors) / sectors * 2 * np.pi
    normals = np.radians(aperture.turn) + (np.arange(aperture.blades) + 0.5) / aperture.blades * 2 * np.pi
    apothem = np.cos(np.pi / aperture.blades) * (1 + aperture.uneven * rng.standard_normal(aperture.blades))
    # A blade is a straight line at its apothem; it bounds the directions that it faces, within 87 degrees.
    facing = np.cos(angles[:, None] - normals)
    straight = np.where(facing > 0.05, apothem / np.maximum(facing, 0.05), np.inf).min(axis=1)
    return (1 - aperture.curved) * straight + aperture.curved


def transmission(aperture: Aperture, size: int, fill: float) -> Array:
    """Return the stop as a picture (size, size), 0..1, its radius `fill` of half the side.

    Dust and scratches on the glass let a tenth of the light through."""
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(axis / fill, axis / fill)
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    table = edge_radius(aperture, 1440)  # in steps of a quarter of a degree
    edge = np.interp(angle % (2 * np.pi), np.arange(1441) / 1440 * 2 * np.pi, np.append(table, table[0]))
    mask = np.clip((edge - radius) * fill * size / 2 + 0.5, 0, 1)  # distances in pixels: an edge is one pixel wide
    rng = np.random.default_rng(aperture.seed + 1)
    for _ in range(aperture.dust):
        far, azimuth, speck = np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi), rng.uniform(0.004, 0.02)
        distance = np.hypot(x - far * np.cos(azimuth), y - far * np.sin(azimuth))
        mask *= 1 - 0.9 * np.clip((speck - distance) * fill * size / 2 + 0.5, 0, 1)
    for _ in range(aperture.scratches):
        rotation, offset, width = rng.uniform(0, np.pi), rng.uniform(-0.9, 0.9), rng.uniform(0.002, 0.006)
        middle, half = rng.uniform(-0.6, 0.6), rng.uniform(0.1, 0.8)
        along, across = x * np.cos(rotation) + y * np.sin(rotation), y * np.cos(rotation) - x * np.sin(rotation)
        distance = np.maximum(np.abs(across - offset) - width, np.abs(along - middle) - half)
        mask *= 1 - 0.9 * np.clip(0.5 - distance * fill * size / 2, 0, 1)
    return mask
