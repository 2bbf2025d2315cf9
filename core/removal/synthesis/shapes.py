# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws streaks, smears, halos and rings, and the lights themselves."""
from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from .canvas import GREEN_WAVELENGTH, Array, Point, Random, log_uniform, random_tint, spectral_colour


def draw_streak(random: Random, light: Point, x: Array, y: Array) -> Array:
    """Draw the long horizontal streak of an anamorphic lens, or a few close to each other: (size, size, 3), maximum 1.

    x, y: `canvas_grid`.
    """
    layer = np.zeros((*x.shape, 3), np.float32)
    blue = np.array([0.25, 0.6, 1.6], np.float32)
    for number in range(1 if random.random() < 0.6 else int(random.integers(2, 5))):
        angle, offset = random.normal(0, 0.02), random.normal(0, 0.01) if number else 0.0
        dx, dy = x - light[0], y - light[1]
        along = dx * math.cos(angle) + dy * math.sin(angle)
        across = dy * math.cos(angle) - dx * math.sin(angle) - offset
        length, width = log_uniform(random, 0.1, 2.5), log_uniform(random, 0.003, 0.05)
        profile = np.exp(-(across / width) ** 2) if random.random() < 0.5 else 1 / (1 + (across / width) ** 2) ** 1.5
        falloff = np.exp(-np.abs(along) / length) if random.random() < 0.5 else 1 / (1 + (along / length * 2) ** 2)
        if random.random() < 0.3:  # uneven along its length
            falloff *= 1 + 0.4 * np.sin(along * random.uniform(4, 60) + random.uniform(0, 7))
        colour = blue * random_tint(random, 0.2) if random.random() < 0.6 else random_tint(random, 0.6)
        core = np.exp(-np.abs(along) / (0.3 * length))[..., None]  # whiter than the rest
        layer += (profile * falloff * width ** -0.2 * random.uniform(0.3, 1))[..., None] * (
            colour * (1 - 0.6 * core) + 0.6 * core).astype(np.float32)
    return layer / max(float(layer.max()), 1e-9)


def draw_smear(random: Random, light: Point, x: Array, y: Array) -> Array:
    """Draw the beams that wiped grease on the front glass causes, as on most telephones at night: (size, size, 3).

    They lie at right angles to the wiping marks. Each widens outwards, is smooth or made of fine rays, and lies on one
    or both sides of the light. The first beam has a brightness of about 1 at a distance of 0.25 from the light, so the
    layer exceeds 1 nearer to it. x, y: `canvas_grid`.
    """
    dx, dy = x - light[0], y - light[1]
    r, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
    layer = np.zeros((*x.shape, 3), np.float32)
    for number in range(1 if random.random() < 0.5 else int(random.integers(2, 6))):
        layer += _draw_beam(random, r, angle, fainter=number > 0)
    return layer


def _draw_beam(random: Random, r: Array, angle: Array, *, fainter: bool) -> Array:
    """Draw one beam of a smear, (size, size, 3).

    r, angle: each pixel's polar coordinates about the light. fainter: draw the beam's brightness from 0.1 to 1; else it
    is 1.
    """
    direction = random.uniform(-math.pi, math.pi)
    bend = random.normal(0, 0.12) if random.random() < 0.3 else 0.0
    width, opening = log_uniform(random, 0.002, 0.04), log_uniform(random, 0.003, 0.15)
    reach, power, end = log_uniform(random, 0.03, 1.5), random.uniform(0.7, 3), log_uniform(random, 0.25, 4)
    # Brightness of the beam on the other side of the light: the same, or in equal parts less or none.
    other_side = 1.0 if random.random() < 0.6 else random.random() * (random.random() < 0.5)
    profile_draw, level = random.random(), log_uniform(random, 0.1, 1) if fainter else 1.0
    rays = _draw_ray_profile(random) if random.random() < 0.5 else None
    colour = random_tint(random, 0.15) + (random_tint(random, 0.5) - 1) * np.clip(r / end, 0, 1)[..., None]
    # The first factor is 1 at r = 0.25; the last ends the beam.
    falloff = (1 + (0.25 / reach) ** power) / (1 + (r / reach) ** power) * np.exp(-((r / end) ** 2))
    spread = np.sqrt(width**2 + (opening * r) ** 2)  # half width of the beam at r
    light = np.zeros_like(r)
    for rotation, strength in ((0.0, level), (math.pi, level * other_side)):
        deviation = angle - direction - rotation - bend * r
        deviation = np.arctan2(np.sin(deviation), np.cos(deviation))
        u = np.minimum(np.abs(deviation), 1.5) * r / spread  # distance from the axis, in half widths
        profile = (np.exp(-(u**2)) if profile_draw < 0.4 else 1 / (1 + u**2) ** 1.5 if profile_draw < 0.7 else
                   np.exp(-(u**4)))
        if rays is not None:
            profile = profile * rays(deviation / max(opening, 0.01))
        light += np.minimum(strength * profile * falloff, 30)  # steep falloffs are huge at the light itself
    return np.asarray(light[..., None] * np.maximum(colour, 0.05), np.float32)


def _draw_ray_profile(random: Random) -> Callable[[Array], Array]:
    """Return a function that gives the brightness of random rays, mean about 1, by their direction from the beam's
    axis in units of its opening, -2.5..2.5; beyond, it is constant."""
    count = int(random.integers(6, 60))
    angles, values = np.linspace(-2.5, 2.5, count), random.exponential(1, count) + random.uniform(0, 1)
    values /= values.mean()
    return lambda direction: np.interp(direction, angles, values).astype(np.float32)


def draw_halo(random: Random, light: Point, x: Array, y: Array) -> Array:
    """Draw one or two rings, whole or partial: (size, size, 3), maximum 1.

    They have one random tint or the colours of diffraction. They are centred on the light, in three of ten flares on
    another point of the line through the light and the middle. x, y: `canvas_grid`.
    """
    centre = np.array(light) * (random.uniform(-0.5, 1) if random.random() < 0.3 else 1)
    dx, dy = x - centre[0], y - centre[1]
    r, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
    layer = np.zeros((*x.shape, 3), np.float32)
    for _ in range(1 if random.random() < 0.7 else 2):
        radius, width = log_uniform(random, 0.08, 1.4), log_uniform(random, 0.005, 0.2)
        level = log_uniform(random, 0.2, 1)
        wavelengths = np.linspace(0.42, 0.68, 9)
        colours = spectral_colour(wavelengths)
        colours = colours / colours.sum(0)
        # Relative change of the radius per micrometre; below 0, red is inside.
        dispersion = random.uniform(-1, 1) if random.random() < 0.7 else 0.0
        ring = np.zeros_like(layer)
        for wavelength, colour in zip(wavelengths, colours.astype(np.float32), strict=True):
            wave_radius = radius * (1 + dispersion * (wavelength - GREEN_WAVELENGTH))
            # The inner flank is up to 30 % narrower or wider, differently for each wavelength.
            width_ratio = np.where(r < wave_radius, random.uniform(0.7, 1.3), 1.0)
            ring += np.exp(-((r - wave_radius) / (width * width_ratio)) ** 2)[..., None] * colour
        if random.random() < 0.4:  # partial
            direction, opening_angle = random.uniform(-math.pi, math.pi), random.uniform(0.3, 2)
            angle_offset = np.arctan2(np.sin(angle - direction), np.cos(angle - direction))
            ring *= np.exp(-((angle_offset / opening_angle) ** 2))[..., None]
        if random.random() < 0.3:  # of fine rays
            ray_pattern = sum(random.normal(0, 0.3) * np.cos(k * angle + random.uniform(0, 7))
                              for k in random.integers(8, 120, 6))
            ring *= np.exp(np.asarray(ray_pattern, np.float32))[..., None]
        layer += level * ring * (random_tint(random, 0.5) if dispersion == 0 else random_tint(random, 0.15))
    return layer / max(float(layer.max()), 1e-9)


def draw_rings(random: Random, x: Array, y: Array) -> Array:
    """Return the procedural rings of Yenamandra et al., display values (size, size, 3): one to three with random
    centre, radius and colour, and opacity below 0.7, times a mask that is 0 at the middle of the frame. x, y:
    `canvas_grid`."""
    layer = np.zeros((*x.shape, 3), np.float32)
    for _ in range(int(random.integers(1, 4))):
        centre, radius = random.uniform(-1, 1, 2), random.uniform(0.1, 1.2)
        width = log_uniform(random, 0.004, 0.12)
        r = np.hypot(x - centre[0], y - centre[1])
        ring = np.exp(-((r - radius) / width) ** 2)
        layer += (random.uniform(0.05, 0.7) * ring)[..., None] * (random.random(3) ** 0.7).astype(np.float32)
    fade = np.clip(np.hypot(x, y) / random.uniform(0.3, 1.2), 0, 1)
    return layer * fade[..., None].astype(np.float32)


def draw_light(random: Random, light: Point, x: Array, y: Array) -> Array:
    """Return the light itself, which belongs to the scene: a disc, tube, window or cluster, brighter than white.

    Linear light (size, size, 3), 0 elsewhere. x, y: `canvas_grid`.
    """
    layer = np.zeros((*x.shape, 3), np.float32)
    # kind_draw: below 0.65 concentric discs; up to 0.85 concentric rectangles (tubes, windows); above scattered ones.
    kind_draw, colour = random.random(), random_tint(random, 0.15)
    level = log_uniform(random, 1.2, 12)
    edge = 2.0 / x.shape[0]  # one pixel
    for _ in range(1 if random.random() < 0.85 else int(random.integers(2, 6))):
        dx, dy = x - light[0], y - light[1]
        if kind_draw > 0.85:
            dx, dy = dx + random.normal(0, 0.03), dy + random.normal(0, 0.03)
        radius = log_uniform(random, 0.006, 0.07)
        if kind_draw < 0.65:
            signed_distance = np.hypot(dx, dy) - radius
        else:
            angle, ratio = random.choice([0.0, random.uniform(0, math.pi)]), log_uniform(random, 1, 6)
            along = np.abs(dx * math.cos(angle) + dy * math.sin(angle)) - radius * ratio ** 0.5
            across = np.abs(dy * math.cos(angle) - dx * math.sin(angle)) - radius / ratio ** 0.5
            signed_distance = np.maximum(along, across)
        layer += np.clip(0.5 - signed_distance / (2 * edge), 0, 1)[..., None] * colour * level
    return layer
