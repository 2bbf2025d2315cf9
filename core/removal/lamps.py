# SPDX-License-Identifier: GPL-3.0-or-later
"""The lamps that a scene has of its own: each of them flares alike, and a telephone's picture shows all of them once
more, mirrored about its middle.

Dai et al. 2023, "Nighttime Smartphone Reflective Flare Removal Using Optical Center Symmetry Prior": light that goes
back from the sensor to the glass before it comes down again as a picture of the lamps, turned by 180 degrees, in which
is seen what the lamps' own picture is too bright for.
"""
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..pictures import Pixels
from .synthesis.canvas import uniform_log

Random = np.random.Generator
BRIGHT, MOST = 0.8, 0.03
"""In parts of the scene's brightest value, what is lamp; a scene that has more of that, in parts of the frame, is lit
from elsewhere."""
LEAST_PIXELS, MOST_LAMPS = 3, 8


class Lamp(NamedTuple):
    """place: (x, y) in pixels. brightness: (3,), beside the largest lamp's."""

    place: NDArray[np.float64]
    brightness: NDArray[np.float32]


class Lamps(NamedTuple):
    """light: (height, width, 3) what the scene's lamps are brighter than it shows them."""

    light: Pixels
    each: list[Lamp]


def lamps_of(random: Random, scene: Pixels) -> Lamps | None:
    """Of a scene (height, width, 3) in linear light, the largest; None where it has none."""
    import cv2

    grey = scene.max(-1)
    top = float(grey.max())
    lit = grey > BRIGHT * top
    if top <= 0 or lit.mean() > MOST:
        return None
    count, _, about, places = cv2.connectedComponentsWithStats(lit.astype(np.uint8))
    areas = about[:, cv2.CC_STAT_AREA]
    largest = sorted(range(1, count), key=lambda number: -int(areas[number]))[:MOST_LAMPS]
    each = []
    for number in largest:
        if areas[number] < LEAST_PIXELS:
            break
        x, y = places[number]
        colour = scene[round(y), round(x)] / max(float(scene[round(y), round(x)].max()), 1e-6)
        faint = math.sqrt(areas[number] / areas[largest[0]]) * random.uniform(0.3, 1)
        each.append(Lamp(np.array([x + 0.5, y + 0.5]), (colour * np.float32(faint)).astype(np.float32)))
    if not each:
        return None
    soft = cv2.GaussianBlur(lit.astype(np.float32), (0, 0), 0.7)[..., None]
    return Lamps(scene * soft * np.float32(max(random.uniform(1, 4) / top - 1, 0)), each)


def mirrored(random: Random, scene: Pixels) -> Pixels:
    """(height, width, 3): what comes down once more of a scene whose lamps are as bright as they are."""
    import cv2

    height, width = scene.shape[:2]
    half = math.hypot(width, height) / 2
    bright = np.maximum(scene - np.float32(0.7), 0)
    bright = bright / np.float32(max(float(bright.max()), 1e-6))
    size = -np.float64(random.normal(1, 0.03))
    middle = np.array([width, height]) / 2 + random.normal(0, 0.01 * half, 2)
    matrix = np.array([[size, 0, middle[0] - size * width / 2], [0, size, middle[1] - size * height / 2]])
    ghost = cv2.warpAffine(bright, matrix, (width, height), flags=cv2.INTER_LINEAR)
    ghost = cv2.GaussianBlur(ghost, (0, 0), half * uniform_log(random, 0.002, 0.03))
    ghost = ghost / np.float32(max(float(ghost.max()), 1e-6))
    if random.random() < 0.5:  # filaments, the grid of a lamp of many
        grain = random.uniform(0.2, 1, (height // int(random.integers(2, 8)) + 1, width // 4 + 1)).astype(np.float32)
        ghost = ghost * cv2.resize(grain, (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
    colour = np.exp(random.normal(0, 0.8, 3))
    return np.asarray(ghost * (colour / colour.max() * uniform_log(random, 0.01, 0.5)).astype(np.float32), np.float32)
