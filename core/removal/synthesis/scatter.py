# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws scattering flares: what a dirty stop, and dust, grease and scratches on the front glass, do to a light.

A point's image is the power of the Fourier transform of the stop (Wu et al. 2021, "How to Train Neural Networks for
Flare Removal"): blades give spikes, dust gives shimmer, scratches give streaks, defocus opens the core to the stop's
own shape. It grows in proportion to the wavelength, which gives it its colours.
"""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .canvas import GREEN_WAVELENGTH, Array, Point, Random, log_uniform, spectral_colour

STOP_SAMPLES = 256
"""Samples across the plane of the stop, which fills about half of it."""


def draw_starburst(random: Random, light: Point, size: int) -> Array:
    """Return (size, size, 3), the light's diffraction image: greatest value 1, in the core, falling over several
    decades."""
    import cv2

    stop = _draw_stop(random, dirt=random.random() ** 2)
    phase = _draw_phase(random)
    # Padded to twice the size, which samples the image twice as finely.
    amplitude = np.fft.fftshift(np.fft.fft2(stop * np.exp(1j * phase), (2 * STOP_SAMPLES, 2 * STOP_SAMPLES)))
    intensity = (np.abs(amplitude) ** 2).astype(np.float32)
    blur = log_uniform(random, 0.5, 2.0)  # lights have an extent, and no camera resolves the fringes
    blurred = np.asarray(cv2.GaussianBlur(intensity / intensity.max(), (0, 0), blur), np.float32)
    blurred /= blurred.max()
    relative_size = log_uniform(random, 0.5, 4.0)  # side of the whole image relative to the canvas
    layer = np.zeros((size, size, 3), np.float32)
    wavelengths = np.linspace(0.41, 0.69, 10)
    colours = spectral_colour(wavelengths)
    colours /= colours.sum(0)
    spread = random.uniform(0.3, 1.0)  # of the colours; sensors mix wavelengths
    for wavelength, colour in zip(wavelengths, colours.astype(np.float32), strict=True):
        # An image grows with its wavelength, and its light spreads over zoom^2 as many pixels.
        zoom = relative_size * (1 + spread * (wavelength / GREEN_WAVELENGTH - 1)) * size / (2 * STOP_SAMPLES)
        x, y = (light[0] + 1) * size / 2, (light[1] + 1) * size / 2
        matrix = np.array([[zoom, 0, x - zoom * STOP_SAMPLES], [0, zoom, y - zoom * STOP_SAMPLES]])
        layer += cv2.warpAffine(blurred, matrix, (size, size))[..., None] * (colour / zoom**2)
    return layer / max(float(layer.max()), 1e-12)


def _draw_stop(random: Random, dirt: float) -> Array:
    """Return the transmission of the stop (STOP_SAMPLES, STOP_SAMPLES). dirt: 0 for a clean stop (spikes alone) to 1.
    """
    axis = np.linspace(-1, 1, STOP_SAMPLES)
    x, y = np.meshgrid(axis, axis)
    blades = int(random.integers(5, 10))
    if random.random() < 0.2:
        blades = 18  # nearly round
    rotation = random.uniform(0, 2 * math.pi)
    opening = np.ones((STOP_SAMPLES, STOP_SAMPLES))
    edge_steepness = 90.0
    for k in range(blades):
        angle = rotation + 2 * math.pi * (k + random.normal(0, 0.03)) / blades
        edge = 0.5 * (1 + random.normal(0, 0.02))  # distance from the centre; blades are never quite even
        bend = random.uniform(0, 0.25)  # blades are curved, which fans the spikes out
        along = x * math.cos(angle) + y * math.sin(angle)
        across = x * -math.sin(angle) + y * math.cos(angle)
        opening *= 1 / (1 + np.exp(np.clip((along + bend * across**2 - edge) * edge_steepness, -60, 60)))
    return _add_dirt(random, opening.astype(np.float32), dirt)


def _add_dirt(random: Random, stop: Array, dirt: float) -> Array:
    """Return a stop (STOP_SAMPLES, STOP_SAMPLES) with dust and scratches. dirt: amount, 0 (clean) to 1."""
    import cv2

    mask = stop.copy()
    for _ in range(int(random.poisson(60 * dirt))):  # dust
        middle = (random.uniform(0.25, 0.75, 2) * STOP_SAMPLES).astype(int)
        spot = np.ones_like(mask)
        cv2.circle(spot, tuple(int(v) for v in middle), int(log_uniform(random, 1, 6)), (random.uniform(0, 0.9),), -1,
                   cv2.LINE_AA)
        mask *= spot
    wiping_angle = random.uniform(0, math.pi)  # wiping leaves scratches in one direction
    spread = random.choice([0.03, 0.2, 2.0])
    for _ in range(int(random.poisson(40 * dirt))):
        middle, angle = random.uniform(0.2, 0.8, 2) * STOP_SAMPLES, wiping_angle + random.normal(0, spread)
        reach = log_uniform(random, 5, STOP_SAMPLES) / 2
        ends = [(int(middle[0] + sign * reach * math.cos(angle)), int(middle[1] + sign * reach * math.sin(angle)))
                for sign in (-1, 1)]
        line = np.ones_like(mask)
        cv2.line(line, ends[0], ends[1], (random.uniform(0.2, 0.95),), 1 if random.random() < 0.8 else 2, cv2.LINE_AA)
        mask *= line
    return mask


def _draw_phase(random: Random) -> Array:
    """Return the phase (STOP_SAMPLES, STOP_SAMPLES), radians, of defocus and of smooth grease; 0 without either."""
    import cv2

    axis = np.linspace(-1, 1, STOP_SAMPLES)
    x, y = np.meshgrid(axis, axis)
    phase = np.zeros((STOP_SAMPLES, STOP_SAMPLES))
    if random.random() < 0.5:
        phase += random.normal(0, 12) * (x**2 + y**2)
    if random.random() < 0.4:
        grease = cv2.GaussianBlur(random.normal(0, 1, (STOP_SAMPLES, STOP_SAMPLES)), (0, 0), log_uniform(random, 4, 30))
        phase += grease / grease.std() * log_uniform(random, 0.1, 2.0)
    return phase.astype(np.float32)


def draw_shimmer(random: Random, light: Point, x: Array, y: Array) -> Array:
    """Draw many fine rays around the light, of uneven strength and length: (size, size, 3).

    Their brightness is arbitrary; the caller normalises it. x, y: `canvas_grid`.
    """
    dx, dy = x - light[0], y - light[1]
    r, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
    direction_count = 2048  # over the whole circle
    strength = _draw_ray_strengths(random, direction_count)
    # Strong rays are long too; the random shift by a few directions loosens that relation.
    reach = log_uniform(random, 0.08, 0.8) * (0.5 + 0.5 * np.roll(strength, int(random.integers(20))))
    position = ((angle / (2 * math.pi)) % 1) * direction_count
    low = position.astype(int) % direction_count  # each pixel lies between directions low and low + 1
    fraction = (position - np.floor(position)).astype(np.float32)
    pixel_strength = strength[low] * (1 - fraction) + strength[(low + 1) % direction_count] * fraction
    pixel_reach = reach[low] * (1 - fraction) + reach[(low + 1) % direction_count] * fraction
    inner = random.uniform(0, 0.15)  # radius of the middle, even or without rays
    layer = pixel_strength * (np.exp(-np.maximum(r - inner, 0) / pixel_reach) if random.random() < 0.5
                              else 1 / (1 + (r / pixel_reach * 2) ** 2.5))
    if random.random() < 0.5:
        layer = layer * (1 - np.exp(-(r / max(inner, 1e-3)) ** 2))
    hue = _radial_tint(random, r)
    return (layer[..., None] * hue).astype(np.float32)


def _draw_ray_strengths(random: Random, direction_count: int) -> NDArray[np.float64]:
    """Return the strength of light in each direction, (direction_count,), of a few broad rays or a curtain of fine
    ones; the maximum is between 1 and 1.3."""
    strength = np.zeros(direction_count)
    if random.random() < 0.4:
        ray_count, ray_width = int(random.integers(4, 30)), log_uniform(random, 0.002, 0.03)
    else:
        ray_count, ray_width = int(random.integers(40, 300)), log_uniform(random, 0.001, 0.01)
    positions = np.arange(direction_count) / direction_count
    for _ in range(ray_count):
        gap = np.abs(positions - random.random())
        strength += random.exponential(1) * np.exp(
            -(np.minimum(gap, 1 - gap) / (ray_width * random.uniform(0.5, 2))) ** 2)
    return np.asarray(strength / strength.max() + random.uniform(0, 0.3))


def _radial_tint(random: Random, r: Array) -> Array:
    """Return (..., 3), a colour of mean about 1 that changes from one to another with the distance r from the light."""
    turns = random.normal(0, 0.35, (2, 3))
    share = np.clip(r / log_uniform(random, 0.2, 1.5), 0, 1)[..., None]
    return np.exp(turns[0] * (1 - share) + turns[1] * share).astype(np.float32)


def draw_glow(random: Random, light: Point, x: Array, y: Array) -> Array:
    """Draw the glow around a light, (size, size, 3), maximum 1: one to three lobes that fall off as a power or as a
    Gaussian, each of a colour that changes outwards. x, y: `canvas_grid`."""
    dx, dy = x - light[0], y - light[1]
    if random.random() < 0.25:  # stretched, as a smear is
        angle, ratio = random.uniform(0, math.pi), log_uniform(random, 1.1, 4)
        dx, dy = dx * math.cos(angle) + dy * math.sin(angle), (dy * math.cos(angle) - dx * math.sin(angle)) * ratio
    r = np.hypot(dx, dy)
    layer = np.zeros((*r.shape, 3), np.float32)
    for _ in range(int(random.integers(1, 4))):
        width, power = log_uniform(random, 0.015, 0.5), random.uniform(1.6, 4)
        lobe: Array = 1 / (1 + (r / width) ** power) if random.random() < 0.7 else np.exp(-((r / width) ** 2))
        # Narrow lobes are brighter.
        layer += (lobe * log_uniform(random, 0.05, 1) * (0.05 / width) ** 0.5)[..., None] * _radial_tint(random, r)
    if random.random() < 0.3:  # uneven round the circle
        direction = np.arctan2(dy, dx)
        waves = [random.normal(0, 0.3) * np.cos(k * direction + random.uniform(0, 7)) for k in range(1, 5)]
        layer *= np.exp(np.sum(waves, axis=0, dtype=np.float32))[..., None]
    return layer / max(float(layer.max()), 1e-9)


def draw_veil(random: Random, light: Point, x: Array, y: Array) -> Array:
    """Return a veil, (size, size, 3), at most about 1: light over the whole frame, more on the light's side, without
    any edge. x, y: `canvas_grid`."""
    distance = np.hypot(x - light[0], y - light[1])
    layer = 1 / (1 + (distance / log_uniform(random, 0.3, 2.5)) ** random.uniform(1, 3)) + random.uniform(0, 0.6)
    return (layer / layer.max())[..., None].astype(np.float32) * _radial_tint(random, distance)
