# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws light spread about the light itself: starburst, glow, rings, streaks.

Starburst: far-field diffraction at the stop is the power of its Fourier transform, wider for longer wavelengths in
proportion. Glow: scatter in glass and on the sensor, two broad lobes. Ring: the diffraction of fine concentric grooves
(a lens polished or moulded on a lathe), at an angle in proportion to the wavelength. Streak: the image of a point by a
cylindrical lens.
"""
from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from .aperture import Aperture, transmission
from .spectrum import responses, wavelengths

Pixels = NDArray[np.float32]

TEXTURE_SIZE = 1024
"""Side of the starburst's texture, pixels."""
REFERENCE_WAVELENGTH = 0.55
"""Wavelength at which sizes of starburst and ring are given, micrometres."""
BANDS = 25
"""Number of wavelengths that a starburst is summed over."""
MIRROR_POSITION = -0.7
"""Position that a streak's mirror image passes through, relative to the light's."""


@dataclass(frozen=True)
class Starburst:
    """A starburst. gain: factor of its light. extent: tan of the angle that half the pattern spans at 0.55 micrometres.
    core: radius (tan) of the blur that softens the centre. peak: light at which the centre saturates."""

    gain: float = 1.0
    extent: float = 0.6
    core: float = 0.0022
    peak: float = 12.0


@dataclass(frozen=True)
class Glow:
    """A glow: two lobes gain / (1 + (r / radius)^2)^power, where r is the tangent of the angle from the light, and a
    constant floor."""

    gain: float = 0.25
    radius: float = 0.035
    power: float = 1.1
    wide_gain: float = 0.03
    wide_radius: float = 0.35
    floor: float = 0.002


@dataclass(frozen=True)
class Ring:
    """A ring. radius: tan at 0.55 micrometres. width: width of one wavelength's ring, relative to the radius. follow:
    position of the centre on the line from the principal point (0) to the light (1). lean: how much darker the side in
    the direction from the principal point to the light is, and how much brighter the other. grow: additional radius per
    tan of the field angle. dispersion: 1 for the colours of grooves, 0 for a white ring."""

    gain: float = 0.05
    radius: float = 0.3
    width: float = 0.03
    follow: float = 1.0
    lean: float = 0.4
    grow: float = 0.0
    dispersion: float = 1.0


@dataclass(frozen=True)
class Streak:
    """A streak: a line through the light at `turn` degrees, gain / (1 + (along / length)^2)^power along it, a Gaussian
    of standard deviation `width` (tan) across it. colour: linear RGB. mirror: brightness of a second
    streak, relative to the first; it passes through MIRROR_POSITION times the light's position."""

    gain: float = 0.6
    length: float = 0.12
    power: float = 0.9
    width: float = 0.004
    turn: float = 0.0
    colour: tuple[float, float, float] = (0.25, 0.5, 1.0)
    mirror: float = 0.1


@lru_cache(maxsize=8)
def starburst_texture(aperture: Aperture, settings: Starburst) -> Pixels:
    """Return the starburst's texture (TEXTURE_SIZE, TEXTURE_SIZE, 3), spanning -extent..extent (tan) on both axes.

    It is the Fraunhofer diffraction of the stop, the squared magnitude of its Fourier transform, scaled by wavelength
    and summed over the spectrum; then blurred, faded at the edge and softly limited to `settings.peak`.
    """
    stop = transmission(aperture, TEXTURE_SIZE, 0.25)  # the margin makes the pattern's samples finer
    power = np.abs(np.fft.fftshift(np.fft.fft2(np.fft.ifftshift(stop)))) ** 2
    power = (power / stop.sum() ** 2).astype(np.float32)
    texture = np.zeros((TEXTURE_SIZE, TEXTURE_SIZE, 3), np.float32)
    centre = TEXTURE_SIZE // 2
    rows, columns = np.mgrid[:TEXTURE_SIZE, :TEXTURE_SIZE].astype(np.float32) - centre
    for wavelength, share in zip(wavelengths(BANDS), responses(BANDS), strict=True):
        scale = np.float32(REFERENCE_WAVELENGTH / wavelength)
        # A pattern that is wider by 1 / scale is fainter by scale^2: its light stays the same.
        scaled_power = cv2.remap(power, columns * scale + centre, rows * scale + centre, cv2.INTER_LINEAR)
        texture += (scaled_power * scale**2)[..., None] * share.astype(np.float32)
    sigma = settings.core / settings.extent * centre
    texture = cv2.GaussianBlur(texture, (0, 0), sigma).astype(np.float32)
    radius = np.hypot(rows, columns) / centre
    fade = np.clip((1 - radius) / 0.25, 0, 1)  # over the outer quarter, so that no edge shows
    texture *= (settings.gain * fade * fade * (3 - 2 * fade))[..., None]
    return texture / (1 + texture.max(axis=2, keepdims=True) / settings.peak)


def draw_starburst(aperture: Aperture, settings: Starburst, x: Pixels, y: Pixels) -> Pixels:
    """Return the pattern (height, width, 3) at offsets (x, y) from the light (tan), each (height, width)."""
    texture = starburst_texture(aperture, settings)
    centre = TEXTURE_SIZE // 2
    scale = centre / settings.extent
    columns, rows = (x * scale + centre).astype(np.float32), (y * scale + centre).astype(np.float32)
    pattern = cv2.remap(texture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0,))
    return pattern.astype(np.float32)


def draw_glow(settings: Glow, x: Pixels, y: Pixels) -> Pixels:
    """Return the white glow at offsets (x, y) from the light, (height, width, 3)."""
    squared_distance = x * x + y * y
    glow = settings.gain / (1 + squared_distance / settings.radius**2) ** settings.power
    glow += settings.wide_gain / (1 + squared_distance / settings.wide_radius**2) ** 2 + settings.floor
    return np.repeat(glow[..., None], 3, axis=2).astype(np.float32)


def draw_ring(settings: Ring, light: tuple[float, float], x: Pixels, y: Pixels) -> Pixels:
    """Return a ring's light (height, width, 3), summed over the spectrum, at image coordinates (x, y).

    x, y (height, width each) and light: tangents from the principal point.
    """
    u, v = x - settings.follow * light[0], y - settings.follow * light[1]
    distance = np.hypot(u, v)
    field_tan = math.hypot(*light)
    # Cosine of the angle to the direction from the principal point to the light. A light near that point has no
    # direction, so the value fades towards it: to 0.7 of itself at a field angle of tan 0.22.
    light_cosine = (u * light[0] + v * light[1]) / np.maximum(distance, 1e-6) / math.sqrt(field_tan**2 + 0.05)
    brightness = settings.gain * np.maximum(1 - settings.lean * light_cosine, 0)
    ring = np.zeros((*x.shape, 3), np.float32)
    for wavelength, rgb in zip(wavelengths(BANDS), responses(BANDS), strict=True):
        stretch = 1 + settings.dispersion * (wavelength / REFERENCE_WAVELENGTH - 1)
        radius = (settings.radius + settings.grow * field_tan) * stretch
        profile = np.exp(-0.5 * ((distance - radius) / (settings.width * radius)) ** 2) / stretch
        ring += (brightness * profile)[..., None] * rgb.astype(np.float32)
    return ring


def draw_streak(settings: Streak, light: tuple[float, float], x: Pixels, y: Pixels) -> Pixels:
    """Return the light (height, width, 3), at image coordinates (x, y), of a streak and its fainter mirror image.

    x, y (height, width each) and light: tangents from the principal point.
    """
    cosine, sine = math.cos(math.radians(settings.turn)), math.sin(math.radians(settings.turn))
    total = np.zeros(x.shape, np.float32)
    for position_factor, streak_gain in ((1.0, 1.0), (MIRROR_POSITION, settings.mirror)):
        u, v = x - position_factor * light[0], y - position_factor * light[1]
        along, across = cosine * u + sine * v, cosine * v - sine * u
        profile = np.exp(-0.5 * (across / settings.width) ** 2)
        total += streak_gain * settings.gain * profile / (1 + (along / settings.length) ** 2) ** settings.power
    return total[..., None] * np.array(settings.colour, np.float32)
