# SPDX-License-Identifier: GPL-3.0-or-later
"""The canvas that flares are drawn on: its coordinates, spectral colours, random colours, and the rasterisation of one
ghost."""
from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float32]
Point = tuple[float, float]
Random = np.random.Generator

GREEN_WAVELENGTH = 0.55
"""Micrometres; colours separate about it."""


def canvas_grid(size: int) -> tuple[Array, Array]:
    """Return x and y of the pixel centres of a square canvas, each (size, size), -1..1, x to the right, y down."""
    coordinates = ((np.arange(size) + 0.5) / size * 2 - 1).astype(np.float32)
    x, y = np.meshgrid(coordinates, coordinates)
    return x, y


def spectral_colour(wavelength: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the approximate linear RGB (n, 3) of monochromatic light of wavelengths (n,), 0.4..0.7 micrometres.

    Gaussian lobes stand in for the eye's curves: smooth and never negative. Red has a second lobe in the violet.
    """
    def bell(centre: float, below: float, above: float) -> NDArray[np.float64]:
        """Return a bell whose standard deviation differs below and above its centre."""
        width = np.where(wavelength < centre, below, above)
        return np.exp(-0.5 * ((wavelength - centre) / width) ** 2)

    red = bell(0.605, 0.032, 0.045) + 0.16 * bell(0.425, 0.015, 0.02)
    return np.stack([red, bell(0.545, 0.036, 0.034), bell(0.455, 0.024, 0.028)], -1)


def random_tint(random: Random, strength: float = 0.5) -> Array:
    """Return (3,), a random colour of mean 1: in half of the cases warm or cool, else any.

    strength: standard deviation of the channels' logarithms; 0 for white.
    """
    colour = np.exp(random.normal(0, strength, 3))
    if random.random() < 0.5:  # along the axis of colour temperature, where lamps are
        warm = random.normal(0, strength)
        colour = np.array([math.exp(warm), 1.0, math.exp(-warm)])
    return (colour / colour.mean()).astype(np.float32)


def log_uniform(random: Random, low: float, high: float) -> float:
    """Return a number whose logarithm is uniformly distributed between those of the bounds."""
    return float(math.exp(random.uniform(math.log(low), math.log(high))))


@njit(fastmath=True)  # not cached: numba caches by module name, and the commands import this one under another
def draw_ghost(layer: Array, centre: Array, radius: Array, clip_centre: Array, clip_radius: Array,
               second_centre: Array, second_radius: Array, weight: Array, blades: int, rotation: float,
               roundness: float, softness: float, rim: float, rim_width: float, hollow: float, slope: float) -> None:
    """Add a ghost to `layer` (n, n, 3), channel by channel: the overlap of three images of the lens's apertures.

    Positions and lengths are in canvas coordinates; centres are (3, 2) and radii (3,), by channel. centre, radius:
    image of the stop. clip_centre, clip_radius: image of the entrance. second_centre, second_radius: image of the stop
    at the light's last passage through it. weight: brightness by channel, (3,). blades: number of the stop's blades,
    turned by `rotation` radians, from straight (roundness 0) to a circle (1). softness: width of the edge. rim:
    brightness added within rim_width (relative to the radius) of the edge. hollow: share removed from the middle.
    slope: by how much the side away from the canvas' middle is brighter.
    """
    size = layer.shape[0]
    sector = 2 * math.pi / blades
    apothem = math.cos(sector / 2)  # distance of a straight blade from the centre, where the corners are at 1
    for channel in range(3):
        ghost_radius = radius[channel]
        cx, cy = centre[channel, 0], centre[channel, 1]
        drawn_radius = ghost_radius * 1.02 + softness
        x0 = max(int((cx - drawn_radius + 1) * size / 2), 0)
        x1 = min(int((cx + drawn_radius + 1) * size / 2) + 2, size)
        y0 = max(int((cy - drawn_radius + 1) * size / 2), 0)
        y1 = min(int((cy + drawn_radius + 1) * size / 2) + 2, size)
        # Relative to the radius; 1.25 pixels or more, so that it is anti-aliased.
        edge = max(softness / ghost_radius, 2.5 / (size * ghost_radius))
        middle_distance = math.sqrt(cx * cx + cy * cy) + 1e-6
        away_x, away_y = cx / middle_distance, cy / middle_distance  # direction away from the canvas' middle
        for row in range(y0, y1):
            y = (row + 0.5) * 2 / size - 1
            for column in range(x0, x1):
                x = (column + 0.5) * 2 / size - 1
                dx, dy = (x - cx) / ghost_radius, (y - cy) / ghost_radius
                centre_distance = math.sqrt(dx * dx + dy * dy)
                if centre_distance > 1 + edge:
                    continue
                relative_radius = centre_distance  # 1 at the edge of the stop
                if roundness < 1:
                    angle = math.atan2(dy, dx) - rotation
                    angle -= sector * math.floor(angle / sector + 0.5)  # from the middle of the nearest blade
                    relative_radius = (roundness * centre_distance
                                       + (1 - roundness) * centre_distance * math.cos(angle) / apothem)
                second_x, second_y = (x - second_centre[channel, 0]) / second_radius[channel], \
                    (y - second_centre[channel, 1]) / second_radius[channel]
                relative_radius = max(relative_radius, math.sqrt(second_x * second_x + second_y * second_y))
                clip_x, clip_y = (x - clip_centre[channel, 0]) / clip_radius[channel], \
                    (y - clip_centre[channel, 1]) / clip_radius[channel]
                clip_distance = math.sqrt(clip_x * clip_x + clip_y * clip_y)
                # 1 inside all three images, 0 outside, smooth over the width of the edge
                coverage = min(max((1 - relative_radius) / edge + 0.5, 0.0), 1.0)
                coverage *= min(max((1 - clip_distance) * clip_radius[channel] / (edge * ghost_radius) + 0.5, 0.0), 1.0)
                if coverage <= 0:
                    continue
                coverage = coverage * coverage * (3 - 2 * coverage)
                value = 1 - hollow * (1 - min(relative_radius * relative_radius, 1.0))
                value += rim * math.exp(-((1 - relative_radius) / rim_width) ** 2)
                value *= max(1 + slope * (dx * away_x + dy * away_y), 0.0)
                layer[row, column, channel] += weight[channel] * coverage * value
