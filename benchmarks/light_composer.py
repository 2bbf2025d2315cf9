# SPDX-License-Identifier: GPL-3.0-or-later
"""Synthesises lights over photographs, with exact masks, for the benchmark of light detection (`detection.py`).

Each light is a disc, an ellipse or a rounded bar with a radiance of 3 to 200 times white, through a lens: blurred, with
a glow that falls off with a power of the distance, and a starburst. It is added to the photograph in linear light,
clipped, and stored as an 8 bit JPEG, as a camera does.
"""
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from core.colour.srgb import Pixels, linear_from_srgb, srgb_from_linear
from core.images.picture import Picture

MAX_ATTEMPTS = 200
"""Places that are tried for the lights of a picture."""
MIN_SEPARATION = 4
"""Least distance of the centres of two lights, relative to the sum of their radii."""


@dataclass(frozen=True, eq=False)
class LitPicture:
    """A picture with n lights.

    masks: the emitting shapes, (n, h, w). clipped: where the light of the lights, with its glow, reaches white in every
    channel, (h, w). centres: of the shapes, (n, 2), pixels.
    """

    picture: Picture
    masks: NDArray[np.bool_]
    clipped: NDArray[np.bool_]
    centres: NDArray[np.float64]


def compose_lights(photo: Picture, rng: np.random.Generator, count: int) -> LitPicture:
    """Draw `count` lights that do not overlap over a photograph (display values, h x w x 3); fewer where
    MAX_ATTEMPTS find no room.

    Radii are 0.4 to 3 % of the longer side.
    """
    height, width = photo.pixels.shape[:2]
    side = max(width, height)
    light = np.zeros_like(photo.pixels)
    masks, centres, radii = [], [], []
    for _ in range(MAX_ATTEMPTS):
        if len(masks) == count:
            break
        radius = side * np.exp(rng.uniform(np.log(0.004), np.log(0.03)))
        centre = rng.uniform(radius, (width - radius, height - radius))
        separations = [np.linalg.norm(centre - other) / (radius + other_radius)
                       for other, other_radius in zip(centres, radii, strict=True)]
        if min(separations, default=np.inf) < MIN_SEPARATION:
            continue
        shape = _draw_shape((height, width), centre, radius, rng)
        if shape.max() < 0.5:
            continue
        light += _render_light(shape, radius, rng)
        masks.append(shape >= 0.5)
        inside = np.argwhere(shape >= 0.5)[:, ::-1] + 0.5
        centres.append(inside.mean(axis=0))
        radii.append(radius)
    display = np.clip(srgb_from_linear(linear_from_srgb(photo.pixels) + light), 0, 1)
    _, jpeg = cv2.imencode(".jpg", (display[..., ::-1] * 255 + 0.5).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92])
    stored = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)[..., ::-1].astype(np.float32) / np.float32(255)
    return LitPicture(Picture(stored, "srgb"), np.array(masks).reshape(-1, height, width), light.min(axis=2) >= 1,
                      np.array(centres).reshape(-1, 2))


def _draw_shape(size: tuple[int, int], centre: NDArray[np.float64], radius: float, rng: np.random.Generator) -> Pixels:
    """Draw the coverage (h, w), 0..1, of a random emitting shape, with a soft edge of one pixel.

    size: (h, w). centre and radius: pixels.
    """
    v, u = np.mgrid[:size[0], :size[1]].astype(np.float32) + 0.5
    angle = rng.uniform(0, np.pi)
    x = (u - centre[0]) * np.cos(angle) + (v - centre[1]) * np.sin(angle)
    y = (v - centre[1]) * np.cos(angle) - (u - centre[0]) * np.sin(angle)
    kind, aspect = rng.uniform(), rng.uniform(0.4, 0.9)
    # inside: pixels from the edge, negative outside. A disc, an ellipse or a rounded bar.
    if kind < 0.55:
        inside = radius - np.hypot(x, y)
    elif kind < 0.8:
        inside = (1 - np.hypot(x / radius, y / (aspect * radius))) * aspect * radius
    else:
        half_length, half_width = radius * rng.uniform(1.5, 3), radius * 0.5
        inside = half_width - np.hypot(np.maximum(np.abs(x) - half_length + half_width, 0), y)
    return np.clip(inside + 0.5, 0, 1).astype(np.float32)


def _render_light(shape: Pixels, radius: float, rng: np.random.Generator) -> Pixels:
    """Render a light as a lens images it, linear (h, w, 3): its shape, blurred, and scattered into a glow and a star.

    shape: coverage (h, w), 0..1. radius: pixels.
    """
    tint = rng.uniform(0, 1)
    colour = np.array([1, 0.55 + 0.45 * tint, 0.25 + 0.75 * tint]) if rng.uniform() < 0.7 else \
        np.array([0.45 + 0.4 * tint, 0.7 + 0.3 * tint, 1])
    radiance = np.exp(rng.uniform(np.log(3), np.log(200)))
    core = cv2.GaussianBlur(shape, (0, 0), rng.uniform(0.5, 1.2))
    # The scattered light is the shape convolved, by FFT, with a point spread function of glow and starburst. Samples
    # at the pixels are enough: the function is smooth where it is far from the light.
    height, width = shape.shape
    v, u = np.mgrid[-height:height, -width:width].astype(np.float32)
    r2 = u * u + v * v
    glow = (r2 + (1.0 + 0.5 * radius) ** 2) ** np.float32(-rng.uniform(1.2, 1.6))
    blades, rotation = int(rng.integers(5, 10)), rng.uniform(0, np.pi)
    angle = np.arctan2(v, u)
    spikes = np.cos((angle - rotation) * blades / 2) ** 2
    star = spikes ** 200 / (1 + np.sqrt(r2)) ** np.float32(1.5)
    psf = rng.uniform(0.003, 0.03) * glow / glow.sum() + rng.uniform(0.0005, 0.004) * star / star.sum()
    # Padding to twice the size keeps the convolution from wrapping around.
    spectrum = np.fft.rfft2(np.fft.ifftshift(psf)) * np.fft.rfft2(np.pad(shape, ((0, height), (0, width))))
    scattered = np.fft.irfft2(spectrum, s=psf.shape)[:height, :width]
    return np.asarray(radiance * (core + scattered)[..., None] * colour, np.float32)
