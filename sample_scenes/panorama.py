# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws a far surrounding for all directions, in linear light; the scene `hill` stands before it."""
from __future__ import annotations

import cv2
import numpy as np

from .patterns import MOSS, PLUM, STONE, WARM, Texture, gradient_map, noise, random_colour


def panorama(rng: np.random.Generator, height: int, sun: tuple[float, float]) -> Texture:
    """Draw a far surrounding in linear light, (height, 2 height, 3), for all directions: clouds, hills, a town, trees
    and fields.

    Rows go from the zenith to the nadir, columns from Blender's -x through +y, +x and -y, as its worlds map pictures.
    sun: azimuth from +y towards +x and elevation, radians; the sky is brightest about it, up to several times white.
    """
    width = 2 * height
    pixel = np.pi / height
    azimuth = ((np.arange(width, dtype=np.float32) + 0.5) * pixel - np.pi)[None]
    elevation = (np.pi / 2 - (np.arange(height, dtype=np.float32) + 0.5) * pixel)[:, None]
    cosine = np.sin(elevation) * np.sin(sun[1]) + np.cos(elevation) * np.cos(sun[1]) * np.cos(azimuth - sun[0])
    angle = np.arccos(cosine.clip(-1, 1)).astype(np.float32)[..., None]
    picture = _linear_sky(rng, height, elevation, angle)
    # Two ridges of hills, the farther first: elevations (radians), noise cell (pixels), share of haze. Palettes are
    # display values, which ** 2.2 makes linear.
    for low, high, cell, haze in ((0.02, 0.13, 420, 0.75), (0.0, 0.075, 260, 0.45)):
        ridge = low + (high - low) * _ridge_noise(rng, width, cell)
        wood = gradient_map(noise(rng, height, width, 26, 4), ((30, 44, 34), (72, 92, 58), (124, 120, 84))) ** 2.2
        hill = wood * (1 - haze) + np.array((0.46, 0.40, 0.36), np.float32) * haze
        picture = np.where((elevation < ridge)[..., None], hill, picture)
    field = _linear_fields(rng, azimuth, elevation)
    picture = np.where((elevation < 0)[..., None], field, picture)
    _draw_skyline(rng, picture, pixel)
    _draw_trees(rng, picture, pixel)
    return np.roll(picture, -width // 4, 1).astype(np.float32)  # until here +y is in the middle


def _linear_sky(rng: np.random.Generator, height: int, elevation: Texture, angle: Texture) -> Texture:
    """Return linear light (height, 2 height, 3) of a clouded evening sky.

    elevation: (height, 1), radians. angle: (height, 2 height, 1), of each direction to the sun, radians.
    """
    # 0 at the horizon, 1 at the zenith.
    rise = (elevation.clip(0, None) / (np.pi / 2))[..., None] ** 0.5
    clear = np.array((0.62, 0.44, 0.30), np.float32) * (1 - rise) + np.array((0.06, 0.13, 0.34), np.float32) * rise
    warm = np.array((1.0, 0.72, 0.42), np.float32)
    halo = 1.6 * np.exp(-angle / 0.10) + 0.5 * np.exp(-angle / 0.45)
    streaks = noise(rng, height, 2 * height, height / 9, 6, stretch=3.0)
    billows = noise(rng, height, 2 * height, height / 22, 5, stretch=1.6)
    cover = np.clip(2.6 * (0.65 * streaks + 0.35 * billows) - 1.05, 0, 1)[..., None]
    shade = (0.25 + 0.95 * billows[..., None]) * (0.55 + 1.5 * np.exp(-angle / 0.5))
    cloud = shade * np.array((0.62, 0.52, 0.48), np.float32)
    return (clear + warm * halo) * (1 - 0.85 * cover) + cloud * cover * 0.9


def _ridge_noise(rng: np.random.Generator, width: int, cell: float) -> Texture:
    """Return (width,) noise 0..1 along a ridge: two stretches of noise, cross-faded. cell: pixels."""
    line = noise(rng, 4, 2 * width, cell, 6)[1]
    ramp = np.linspace(0, 1, width, dtype=np.float32)
    return line[:width] * (1 - ramp) + line[width:] * ramp


def _linear_fields(rng: np.random.Generator, azimuth: Texture, elevation: Texture) -> Texture:
    """Return linear light (height, width, 3) of flat land in perspective: patches with furrows.

    Only the part below the horizon is meaningful. azimuth: (1, width), elevation: (height, 1), radians.
    """
    # In heights of the eye above the land; bounded, since it is infinite at the horizon.
    distance = 1 / np.tan(np.maximum(-elevation, 0.012))
    x, y = distance * np.sin(azimuth), distance * np.cos(azimuth)
    side = 512
    crops = gradient_map(noise(rng, side, side, 40, 4), MOSS) ** 2.2
    plots = rng.random((64, 64, 3), np.float32) * 0.5 + 0.6
    columns, rows = np.floor(x * 1.7).astype(int) % 64, np.floor(y * 1.1).astype(int) % 64
    u, v = (x * 60).astype(int) % side, (y * 60).astype(int) % side
    furrows = 1 + 0.25 * np.sin(x * 40 + 6 * plots[rows, columns, 0]) * np.exp(-distance / 6)
    land = crops[v, u] * plots[rows, columns] * furrows[..., None] * 0.8
    haze = (1 - np.exp(-distance / 30))[..., None]
    return land * (1 - haze) + np.array((0.40, 0.36, 0.31), np.float32) * haze


def _draw_skyline(rng: np.random.Generator, picture: Texture, pixel: float) -> None:
    """Draw houses and towers with windows along the horizon into a panorama; pixel: its size, radians."""
    height, width = picture.shape[:2]
    ground = height // 2 + int(0.008 / pixel)
    left = 0
    while left < width:
        columns = int(rng.uniform(0.025, 0.07) / pixel)
        if rng.random() < 0.4:
            left += int(rng.uniform(0.01, 0.06) / pixel)
            continue
        rows = int(rng.uniform(0.035, 0.085) * (1.9 if rng.random() < 0.15 else 1) / pixel)
        plaster = np.array(random_colour(rng, (WARM, STONE, PLUM)[rng.integers(3)]), np.float32) / 255
        wall = plaster**2.2 * 0.55 + 0.06
        front = picture[ground - rows:ground, left:left + columns]
        front[:] = wall * (0.8 + 0.4 * noise(rng, rows, columns, 12, 2)[: front.shape[0], : front.shape[1], None])
        spacing = max(int(0.012 / pixel), 4)
        for y in range(spacing // 2, rows - spacing // 2, spacing):
            for x in range(spacing // 3, columns - spacing // 2, spacing):
                is_lit = rng.random() < 0.12
                front[y:y + spacing // 2, x:x + spacing // 2] = (0.9, 0.62, 0.3) if is_lit else wall * 0.3
        front[: max(2, spacing // 4)] *= 0.5
        left += columns


def _draw_trees(rng: np.random.Generator, picture: Texture, pixel: float) -> None:
    """Draw trees of different sizes before and below the horizon into a panorama; pixel: its size, radians."""
    height, width = picture.shape[:2]
    leaves = gradient_map(noise(rng, height // 4, width, 9, 3), ((14, 26, 14), (52, 80, 34), (128, 140, 70))) ** 2.2
    for _ in range(90):
        depth = rng.random()  # 0 far, 1 near: nearer trees are larger and stand lower
        size = (0.016 + 0.075 * depth**2) / pixel
        x, foot = int(rng.integers(width)), height / 2 + (0.012 + 0.12 * depth**2) / pixel
        mask = np.zeros((height // 4, width), np.uint8)
        band_top = height // 2 - height // 8  # first row of the band that trees are drawn into
        foot -= band_top
        trunk = int(max(size * 0.12, 2))
        for _ in range(12):
            centre = (int(x + rng.normal() * size * 0.35), int(foot - size * (1.1 + rng.normal() * 0.32)))
            cv2.circle(mask, centre, max(int(size * rng.uniform(0.15, 0.38)), 2), 255, -1, cv2.LINE_AA)
        cv2.rectangle(mask, (x - trunk // 2, int(foot - size)), (x + trunk // 2, int(foot)), 255, -1)
        cover = (mask.astype(np.float32) / 255)[..., None]
        band = picture[band_top:band_top + height // 4]
        shift = int(rng.integers(width))
        band[:] = band * (1 - cover) + np.roll(leaves, shift, 1) * (0.6 + 0.5 * rng.random()) * cover
