# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws ghosts of moulded aspheres, as telephones and small cameras show them: strongly coloured, bent, textured.

A ghost is the stop's light, spread over the sensor by a map that is linear for traced ghosts (`ghosts.draw_traced`) and
here has aberrations of third and fifth order too (Welford 1986, "Aberrations of Optical Systems", chapter 7): where the
map folds, light piles up in rims, crescents and cusps. It differs by channel, which colours the rims. Within a ghost,
what lies in the light's path shows: rings that the turning of the mould left, dust, smears, and the fringes of the
edge.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .canvas import Array, Point, Random, canvas_grid, log_uniform, random_tint

TEXTURE_SIZE = 256
"""Samples across the stop's texture."""
CHANNEL_OFFSETS = np.array([-1.0, 0.0, 1.0])
"""Offsets of red, green and blue from the mean wavelength, in even steps, for aberrations that depend on it."""
STOP_SAMPLES = (64, 640)
"""Smallest and largest number of samples across the stop; between them, two per pixel of the ghost."""
MAX_CAUSTIC = 6.0
"""Largest brightness of a caustic relative to an evenly lit ghost; real lights have an extent."""


class Aberrations(NamedTuple):
    """The map from points of the stop, in radii of the stop, to the sensor, in radii of the ghost. The first axis
    points away from the middle of the frame.

    scale: size of the ghost by channel, (3,). third: spherical aberration of third order by channel, (3,). fifth:
    spherical aberration of fifth order.
    """

    scale: Array
    third: Array
    fifth: float
    coma: float
    astigmatism: float

    def to_sensor(self, channel: int, u: Array, v: Array) -> tuple[Array, Array]:
        """Return (x, y) on the sensor, in radii of the ghost, of the stop's points (u, v), for red (0), green or blue.
        """
        r2 = u * u + v * v
        even = self.scale[channel] * (1 + self.third[channel] * r2 + self.fifth * r2 * r2)
        return (u * (even + self.astigmatism) + self.coma * (3 * u * u + v * v),
                v * (even - self.astigmatism) + self.coma * 2 * u * v)


def draw_ghosts(seed: Sequence[int], lights: Sequence[Point], size: int) -> Array:
    """Return (size, size, 3), linear light >= 0: the ghosts of all lights through one lens. The seed determines the
    lens and how bright its ghosts are."""
    layer = sum((draw_light_ghosts(np.random.default_rng(seed), light, size) for light in lights),
                np.zeros((size, size, 3), np.float32))
    return layer * np.float32(log_uniform(np.random.default_rng((*seed, 1)), 0.03, 1.0))


def draw_light_ghosts(random: Random, light: Point, size: int) -> Array:
    """Return (size, size, 3), the ghosts of one light; evenly lit ones have a brightness of 0.1 to 1.

    random: draws the lens; all lights of a picture get a generator of the same seed, so that they share one lens.
    """
    layer = np.zeros((size, size, 3), np.float32)
    texture = _draw_texture(random)
    contrast = log_uniform(random, 0.1, 1.0)  # contrast of the texture in most ghosts
    for _ in range(int(random.integers(1, 6))):
        # On the line through the light (1) and the middle (0): most ghosts lie opposite to the light.
        line_position = -random.uniform(0.1, 1.4) if random.random() < 0.75 else random.uniform(0.2, 1.2)
        centre = np.array(light) * line_position + random.normal(0, 0.02, 2)
        radius = log_uniform(random, 0.015, 0.5)
        transmission = 1 + min(contrast * log_uniform(random, 0.3, 3), 1.0) * (texture - 1)
        brightness = log_uniform(random, 0.1, 1.0)
        colour = _draw_coating_colour(random) * brightness
        layer += _draw_ghost(random, centre, radius, np.maximum(transmission, 0), size) * colour
    return layer


def _draw_ghost(random: Random, centre: Array, radius: float, texture: Array, size: int) -> Array:
    """Return (size, size, 3), one ghost with random aberrations: samples of the stop, splatted where they map to. An
    evenly lit ghost is 1.

    centre, radius: centre and radius of the ghost, in canvas coordinates. texture: transmission of the stop.
    """
    import cv2

    aberrations = _draw_aberrations(random)
    count = int(np.clip(2 * radius * size, *STOP_SAMPLES))
    u, v = canvas_grid(count)
    pupil = cv2.resize(texture, (count, count), interpolation=cv2.INTER_AREA) * _draw_pupil(random, u, v)
    azimuth = math.atan2(centre[1], centre[0])
    light = np.zeros((size, size, 3), np.float32)
    for channel in range(3):
        x, y = aberrations.to_sensor(channel, u, v)
        rotated = np.stack([x * math.cos(azimuth) - y * math.sin(azimuth),
                            x * math.sin(azimuth) + y * math.cos(azimuth)])
        positions = (rotated * radius + centre[:, None, None] + 1) * size / 2 - 0.5
        # times the pixels that one sample covers without aberrations, so that an evenly lit ghost is 1
        light[..., channel] = _splat(positions, pupil, size) * (radius * size / count) ** 2
    blur = max(0.6, radius * size * log_uniform(random, 0.003, 0.06))
    return np.asarray(np.minimum(cv2.GaussianBlur(light, (0, 0), blur), MAX_CAUSTIC), np.float32)


def _draw_aberrations(random: Random) -> Aberrations:
    """Draw a ghost's aberrations."""
    strength = random.random() ** 2 * 1.2  # many ghosts are nearly free of aberrations
    spread, spread_of_rim = random.normal(0, 0.04), random.normal(0, 0.1)
    return Aberrations(scale=1 + spread * CHANNEL_OFFSETS,
                       third=strength * random.normal(0, 0.5) + spread_of_rim * CHANNEL_OFFSETS,
                       fifth=strength * random.normal(0, 0.4), coma=strength * random.normal(0, 0.25),
                       astigmatism=strength * random.normal(0, 0.3))


def _draw_pupil(random: Random, u: Array, v: Array) -> Array:
    """Return the transmission, 0..1, of the stop at u and v, radii of the stop; all of one shape.

    It is a circle, in a third of the ghosts cut by the rim of another lens, in a fifth with a darker middle.
    """
    edge = 60.0 if random.random() < 0.7 else log_uniform(random, 4, 40)  # steepness: sharp, or soft in three of ten

    def within(distance: Array, limit: float) -> Array:
        """Return 1 where a distance is below the limit, 0 beyond it, with a soft edge."""
        return np.asarray(1 / (1 + np.exp(np.clip((distance - limit) * edge, -60, 60))), np.float32)

    pupil = within(np.hypot(u, v), 0.97)
    if random.random() < 0.33:
        x, y = random.normal(0, 0.5, 2)
        pupil *= within(np.hypot(u - x, v - y), random.uniform(0.8, 1.3))
    if random.random() < 0.2:
        pupil *= 1 - random.uniform(0.3, 1) * within(np.hypot(u, v), random.uniform(0.3, 0.85))
    return pupil


def _splat(positions: Array, weights: Array, size: int) -> Array:
    """Bilinear splat: return the picture (size, size) of weights (n, n) at positions (2, n, n) in pixels, each weight
    shared by the four nearest pixels."""
    low = np.floor(positions)
    fraction, low = positions - low, low.astype(np.int64)
    total = np.zeros(size * size)
    for right in (0, 1):
        for down in (0, 1):
            x, y = low[0] + right, low[1] + down
            pixel_weight = weights * np.abs(1 - right - fraction[0]) * np.abs(1 - down - fraction[1])
            inside = (x >= 0) & (x < size) & (y >= 0) & (y < size)
            total += np.bincount((y * size + x)[inside], pixel_weight[inside], size * size)
    return total.reshape(size, size).astype(np.float32)


def _draw_texture(random: Random) -> Array:
    """Return the transmission of a lens's stop, (TEXTURE_SIZE, TEXTURE_SIZE), mean about 1: the rings, smears, dust and
    fringes that show in all ghosts of the lens."""
    import cv2

    u, v = canvas_grid(TEXTURE_SIZE)
    r = np.hypot(u, v)
    texture = np.ones_like(r)
    if random.random() < 0.6:  # rings
        radial_noise = cv2.GaussianBlur(random.normal(0, 1, (1, 512)), (0, 0), log_uniform(random, 1, 12))[0]
        texture += random.uniform(0.05, 0.4) * np.interp(r, np.linspace(0, 1.5, 512), radial_noise / radial_noise.std())
    if random.random() < 0.6:  # smears
        smear = cv2.GaussianBlur(random.normal(0, 1, r.shape), (0, 0), log_uniform(random, 2, 40))
        texture += random.uniform(0.05, 0.4) * smear / smear.std()
    if random.random() < 0.5:  # dust, out of focus
        specks = np.zeros_like(r)
        for _ in range(int(random.integers(3, 80))):
            centre = tuple(int(part) for part in random.uniform(0, TEXTURE_SIZE, 2))
            cv2.circle(specks, centre, int(log_uniform(random, 1, 14)), (random.uniform(-0.8, 0.4),), -1, cv2.LINE_AA)
        texture += cv2.GaussianBlur(specks, (0, 0), log_uniform(random, 0.5, 4))
    if random.random() < 0.5:  # fringes, which fade from the edge inwards
        inward = np.maximum(0.97 - r, 0)
        texture += random.uniform(0.1, 0.6) * np.cos(log_uniform(random, 20, 120) * np.sqrt(inward + 0.01)) \
            * np.exp(-inward / random.uniform(0.05, 0.4))
    return np.maximum(texture, 0).astype(np.float32)


def _draw_coating_colour(random: Random) -> Array:
    """Return (3,), mean 1: the colour that coatings reflect, often purple."""
    colour = random_tint(random, 1.0)
    if random.random() < 0.5:
        colour[1] *= random.uniform(0.05, 0.6)
    return colour / colour.mean()
