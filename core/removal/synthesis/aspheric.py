# SPDX-License-Identifier: GPL-3.0-or-later
"""Ghosts of moulded aspheres, as telephones and small cameras show them: strongly coloured, bent, with a texture.

A ghost is the stop's light, spread over the sensor by a map that is linear for the traced ghosts (`ghosts.traced`) and
here has the aberrations of third and fifth order too (Welford 1986, "Aberrations of Optical Systems", chapter 7): where
the map folds, light piles up in rims, crescents and cusps. It differs by channel, which gives rims colours of their
own. What lies on the way shows within: rings that the mould's turning left, dust, smears, and the fringes of the edge.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .canvas import Array, Point, Random, grid, tint, uniform_log

TEXTURE = 256
"""Samples across the stop's texture."""
CHANNELS = np.array([-1.0, 0.0, 1.0])
"""What is of a wavelength differs by it about evenly: red, green, blue."""
SAMPLES = (64, 640)
"""Across the stop at least and at most; between those, two to a pixel of the ghost."""
BRIGHTEST = 6.0
"""Of an evenly lit ghost's brightness, what a caustic has at most: lights are no points."""


class Aberrations(NamedTuple):
    """The map from the stop (1 its edge) to the sensor, in parts of the ghost's radius; the first axis away from the
    middle of the frame. scale and third, of red, green and blue (3,); third, fifth: spherical aberration."""

    scale: Array
    third: Array
    fifth: float
    coma: float
    astigmatism: float

    def on_sensor(self, channel: int, u: Array, v: Array) -> tuple[Array, Array]:
        """Where the stop's points (u, v) come to lie."""
        r2 = u * u + v * v
        even = self.scale[channel] * (1 + self.third[channel] * r2 + self.fifth * r2 * r2)
        return (u * (even + self.astigmatism) + self.coma * (3 * u * u + v * v),
                v * (even - self.astigmatism) + self.coma * 2 * u * v)


def ghosts(seed: Sequence[int], lights: Sequence[Point], size: int) -> Array:
    """(size, size, 3), linear light >= 0: the ghosts of all lights through the lens of a seed, at its brightness."""
    of_all = sum((of_light(np.random.default_rng(seed), light, size) for light in lights),
                 np.zeros((size, size, 3), np.float32))
    return of_all * np.float32(uniform_log(np.random.default_rng((*seed, 1)), 0.03, 1.0))


def of_light(random: Random, light: Point, size: int) -> Array:
    """(size, size, 3) ghosts of one light, evenly lit ones of a brightness of 0.1 to 1."""
    layer = np.zeros((size, size, 3), np.float32)
    texture = _texture(random)
    strong = uniform_log(random, 0.1, 1.0)  # how much of it is to be seen, about
    for _ in range(int(random.integers(1, 6))):
        along = -random.uniform(0.1, 1.4) if random.random() < 0.75 else random.uniform(0.2, 1.2)
        centre = np.array(light) * along + random.normal(0, 0.02, 2)
        radius = uniform_log(random, 0.015, 0.5)
        shown = 1 + min(strong * uniform_log(random, 0.3, 3), 1.0) * (texture - 1)
        level = uniform_log(random, 0.1, 1.0)
        colour = _coating(random) * level
        layer += _ghost(random, centre, radius, np.maximum(shown, 0), size) * colour
    return layer


def _ghost(random: Random, centre: Array, radius: float, texture: Array, size: int) -> Array:
    """(size, size, 3) one ghost, 1 where it is evenly lit, of a stop with that texture."""
    import cv2

    aberrations = _aberrations(random)
    count = int(np.clip(2 * radius * size, *SAMPLES))
    u, v = grid(count)
    passing = cv2.resize(texture, (count, count), interpolation=cv2.INTER_AREA) * _opening(random, u, v)
    away = math.atan2(centre[1], centre[0])
    light = np.zeros((size, size, 3), np.float32)
    for channel in range(3):
        x, y = aberrations.on_sensor(channel, u, v)
        at = (np.stack([x * math.cos(away) - y * math.sin(away), x * math.sin(away) + y * math.cos(away)])
              * radius + centre[:, None, None] + 1) * size / 2 - 0.5
        light[..., channel] = _splatted(at, passing, size) * (radius * size / count) ** 2
    soft = max(0.6, radius * size * uniform_log(random, 0.003, 0.06))
    return np.asarray(np.minimum(cv2.GaussianBlur(light, (0, 0), soft), BRIGHTEST), np.float32)


def _aberrations(random: Random) -> Aberrations:
    strength = random.random() ** 2 * 1.2  # many are nearly flat
    spread, spread_of_rim = random.normal(0, 0.04), random.normal(0, 0.1)
    return Aberrations(1 + spread * CHANNELS, strength * random.normal(0, 0.5) + spread_of_rim * CHANNELS,
                       strength * random.normal(0, 0.4), strength * random.normal(0, 0.25),
                       strength * random.normal(0, 0.3))


def _opening(random: Random, u: Array, v: Array) -> Array:
    """What passes: a circle, in a third of ghosts cut by the rim of another lens, in a fifth with a hole."""
    edge = 60.0 if random.random() < 0.7 else uniform_log(random, 4, 40)

    def within(distance: Array, limit: float) -> Array:
        return np.asarray(1 / (1 + np.exp(np.clip((distance - limit) * edge, -60, 60))), np.float32)

    passing = within(np.hypot(u, v), 0.97)
    if random.random() < 0.33:
        x, y = random.normal(0, 0.5, 2)
        passing *= within(np.hypot(u - x, v - y), random.uniform(0.8, 1.3))
    if random.random() < 0.2:
        passing *= 1 - random.uniform(0.3, 1) * within(np.hypot(u, v), random.uniform(0.3, 0.85))
    return passing


def _splatted(at: Array, weights: Array, size: int) -> Array:
    """(size, size): the weights at places (2, n, n) in pixels, each shared among the four pixels about it."""
    low = np.floor(at)
    part, low = at - low, low.astype(np.int64)
    total = np.zeros(size * size)
    for right in (0, 1):
        for down in (0, 1):
            x, y = low[0] + right, low[1] + down
            share = weights * np.abs(1 - right - part[0]) * np.abs(1 - down - part[1])
            inside = (x >= 0) & (x < size) & (y >= 0) & (y < size)
            total += np.bincount((y * size + x)[inside], share[inside], size * size)
    return total.reshape(size, size).astype(np.float32)


def _texture(random: Random) -> Array:
    """(TEXTURE, TEXTURE) about 1: what lies on the way of all of a lens' ghosts."""
    import cv2

    u, v = grid(TEXTURE)
    r = np.hypot(u, v)
    texture = np.ones_like(r)
    if random.random() < 0.6:  # rings
        across = cv2.GaussianBlur(random.normal(0, 1, (1, 512)), (0, 0), uniform_log(random, 1, 12))[0]
        texture += random.uniform(0.05, 0.4) * np.interp(r, np.linspace(0, 1.5, 512), across / across.std())
    if random.random() < 0.6:  # smears
        smear = cv2.GaussianBlur(random.normal(0, 1, r.shape), (0, 0), uniform_log(random, 2, 40))
        texture += random.uniform(0.05, 0.4) * smear / smear.std()
    if random.random() < 0.5:  # dust, out of focus
        specks = np.zeros_like(r)
        for _ in range(int(random.integers(3, 80))):
            place = tuple(int(part) for part in random.uniform(0, TEXTURE, 2))
            cv2.circle(specks, place, int(uniform_log(random, 1, 14)), (random.uniform(-0.8, 0.4),), -1, cv2.LINE_AA)
        texture += cv2.GaussianBlur(specks, (0, 0), uniform_log(random, 0.5, 4))
    if random.random() < 0.5:  # fringes
        inward = np.maximum(0.97 - r, 0)
        texture += random.uniform(0.1, 0.6) * np.cos(uniform_log(random, 20, 120) * np.sqrt(inward + 0.01)) \
            * np.exp(-inward / random.uniform(0.05, 0.4))
    return np.maximum(texture, 0).astype(np.float32)


def _coating(random: Random) -> Array:
    """(3,), mean 1: what coatings leave, which is purple more often than not."""
    colour = tint(random, 1.0)
    if random.random() < 0.5:
        colour[1] *= random.uniform(0.05, 0.6)
    return colour / colour.mean()
