# SPDX-License-Identifier: GPL-3.0-or-later
"""Synthetic light sources over photographs, with exact masks, for the detection benchmark.

Each source is a disc, an ellipse or a rounded bar of radiance 3 to 200 times white, seen through a lens: a
core blur, a glare that falls off with a power of the distance, and a starburst. All of it is added to the
photograph in linear light, clipped and stored as 8 bit JPEG, as a camera would.
"""
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from core.colour.srgb import Pixels, linear_from_srgb, srgb_from_linear
from core.images.picture import Picture


@dataclass(frozen=True, eq=False)
class Composed:
    """A picture with lights: `masks` (n, h, w) of the emitting shapes, `clipped` (h, w) where the lights' own light,
    glare included, reaches white in every channel, `centres` (n, 2) in pixels."""

    picture: Picture
    masks: NDArray[np.bool_]
    clipped: NDArray[np.bool_]
    centres: NDArray[np.float64]


def compose(photo: Picture, rng: np.random.Generator, number: int) -> Composed:
    """Put `number` lights, none on another, over a photograph (display values, h x w x 3)."""
    height, width = photo.pixels.shape[:2]
    side = max(width, height)
    light = np.zeros_like(photo.pixels)
    masks, centres, radii = [], [], []
    for _ in range(200):
        if len(masks) == number:
            break
        radius = side * np.exp(rng.uniform(np.log(0.004), np.log(0.03)))
        centre = rng.uniform(radius, (width - radius, height - radius))
        apart = [np.linalg.norm(centre - other) / (radius + reach) for other, reach in zip(centres, radii, strict=True)]
        if min(apart, default=9.0) < 4:
            continue
        shape = _shape((height, width), centre, radius, rng)
        if shape.max() < 0.5:
            continue
        light += _seen(shape, radius, rng)
        masks.append(shape >= 0.5)
        inside = np.argwhere(shape >= 0.5)[:, ::-1] + 0.5
        centres.append(inside.mean(axis=0))
        radii.append(radius)
    display = np.clip(srgb_from_linear(linear_from_srgb(photo.pixels) + light), 0, 1)
    _, jpeg = cv2.imencode(".jpg", (display[..., ::-1] * 255 + 0.5).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92])
    stored = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)[..., ::-1].astype(np.float32) / np.float32(255)
    return Composed(Picture(stored, "srgb"), np.array(masks).reshape(-1, height, width), light.min(axis=2) >= 1,
                    np.array(centres).reshape(-1, 2))


def _shape(size: tuple[int, int], centre: NDArray[np.float64], radius: float, rng: np.random.Generator) -> Pixels:
    """Coverage (h, w) of the emitting shape, with a soft edge of a pixel."""
    v, u = np.mgrid[:size[0], :size[1]].astype(np.float32) + 0.5
    turn = rng.uniform(0, np.pi)
    x = (u - centre[0]) * np.cos(turn) + (v - centre[1]) * np.sin(turn)
    y = (v - centre[1]) * np.cos(turn) - (u - centre[0]) * np.sin(turn)
    kind, flat = rng.uniform(), rng.uniform(0.4, 0.9)
    if kind < 0.55:
        inside = radius - np.hypot(x, y)
    elif kind < 0.8:
        inside = (1 - np.hypot(x / radius, y / (flat * radius))) * flat * radius
    else:
        long, thick = radius * rng.uniform(1.5, 3), radius * 0.5
        inside = thick - np.hypot(np.maximum(np.abs(x) - long + thick, 0), y)
    return np.clip(inside + 0.5, 0, 1).astype(np.float32)


def _seen(shape: Pixels, radius: float, rng: np.random.Generator) -> Pixels:
    """The source as a lens shows it, linear (h, w, 3)."""
    warm = rng.uniform(0, 1)
    colour = np.array([1, 0.55 + 0.45 * warm, 0.25 + 0.75 * warm]) if rng.uniform() < 0.7 else \
        np.array([0.45 + 0.4 * warm, 0.7 + 0.3 * warm, 1])
    radiance = np.exp(rng.uniform(np.log(3), np.log(200)))
    core = cv2.GaussianBlur(shape, (0, 0), rng.uniform(0.5, 1.2))
    # A glare kernel sampled on a coarse grid is enough: it is smooth where it is far from the source.
    height, width = shape.shape
    v, u = np.mgrid[-height:height, -width:width].astype(np.float32)
    r2 = u * u + v * v
    halo = (r2 + (1.0 + 0.5 * radius) ** 2) ** np.float32(-rng.uniform(1.2, 1.6))
    blades, turn = int(rng.integers(5, 10)), rng.uniform(0, np.pi)
    angle = np.arctan2(v, u)
    spikes = np.cos((angle - turn) * blades / 2) ** 2
    star = spikes ** 200 / (1 + np.sqrt(r2)) ** np.float32(1.5)
    kernel = rng.uniform(0.003, 0.03) * halo / halo.sum() + rng.uniform(0.0005, 0.004) * star / star.sum()
    spectrum = np.fft.rfft2(np.fft.ifftshift(kernel)) * np.fft.rfft2(np.pad(shape, ((0, height), (0, width))))
    glare = np.fft.irfft2(spectrum, s=kernel.shape)[:height, :width]
    return np.asarray(radiance * (core + glare)[..., None] * colour, np.float32)
