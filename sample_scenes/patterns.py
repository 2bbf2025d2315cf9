# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws textures from a seed: posters, paper with writing, wood, marble, maps, tiles.

Textures are sRGB (height, width, 3), 0..1; sizes are pixels.

Structure from motion needs corners and blobs at several scales, a fit of Gaussians needs textures that are not finer
than a pixel; every pattern here is between the two.
"""
from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

Texture = NDArray[np.float32]
Palette = tuple[tuple[int, int, int], ...]

WARM: Palette = ((233, 216, 166), (238, 155, 0), (202, 103, 2), (187, 62, 3), (155, 34, 38), (94, 48, 35))
SEA: Palette = ((0, 18, 25), (0, 95, 115), (10, 147, 150), (148, 210, 189), (233, 216, 166), (38, 70, 83))
PLUM: Palette = ((53, 80, 112), (109, 89, 122), (181, 101, 118), (229, 107, 111), (234, 172, 139), (45, 30, 47))
MOSS: Palette = ((88, 129, 87), (58, 90, 64), (163, 177, 138), (218, 215, 205), (52, 78, 65), (188, 108, 37))
STONE: Palette = ((120, 113, 108), (168, 162, 158), (87, 83, 78), (214, 211, 209), (68, 64, 60), (146, 64, 14))


def noise(rng: np.random.Generator, height: int, width: int, cell: float, octaves: int = 4,
          stretch: float = 1.0) -> Texture:
    """Return smooth noise (height, width), 0..1: a sum of `octaves` interpolated random grids.

    cell: pixels between the points of the coarsest grid; each further one is twice as fine and half as strong.
    stretch: factor on the cells' width. The darkest and the brightest hundredth are clipped.
    """
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        size = cell / 2**octave
        rows, columns = int(height / size) + 3, int(width / (size * stretch)) + 3
        grid = rng.random((rows, columns), np.float32)
        total += cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC) / 2**octave
    low, high = np.percentile(total, [1, 99])
    return np.clip((total - low) / (high - low), 0, 1).astype(np.float32)


def gradient(values: Texture, palette: Palette) -> Texture:
    """Map values (...), 0..1, to colours (..., 3), 0..1, along the palette."""
    colours = np.array(palette, np.float32) / 255
    positions = np.clip(values, 0, 1) * (len(colours) - 1)
    low = np.minimum(positions.astype(int), len(colours) - 2)
    part = (positions - low)[..., None]
    return colours[low] * (1 - part) + colours[low + 1] * part


def random_colour(rng: np.random.Generator, palette: Palette) -> tuple[int, int, int]:
    red, green, blue = palette[rng.integers(len(palette))]
    return int(red), int(green), int(blue)


def poster(rng: np.random.Generator, height: int, width: int, palette: Palette, shapes: int = 60) -> Texture:
    """Draw overlapping discs, rings, polygons, bars and lines, the largest first and so behind."""
    picture = np.full((height, width, 3), random_colour(rng, palette), np.uint8)
    size = min(height, width)
    for index in range(shapes):
        scale = size * (0.30 * (1 - index / shapes) ** 1.5 + 0.04)
        x, y = int(rng.integers(width)), int(rng.integers(height))
        radius = int(scale * rng.uniform(0.5, 1.0)) + 2
        colour = random_colour(rng, palette)
        kind = rng.integers(5)
        if kind == 0:
            cv2.circle(picture, (x, y), radius, colour, -1, cv2.LINE_AA)
        elif kind == 1:
            cv2.circle(picture, (x, y), radius, colour, max(2, radius // 4), cv2.LINE_AA)
        elif kind == 2:
            angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
            corners = np.stack([x + radius * np.cos(angles), y + radius * np.sin(angles)], -1)
            cv2.fillPoly(picture, [corners.astype(np.int32)], colour, cv2.LINE_AA)
        elif kind == 3:
            box = cv2.boxPoints(((x, y), (2.4 * radius, 0.6 * radius), float(rng.uniform(0, 180))))
            cv2.fillPoly(picture, [box.astype(np.int32)], colour, cv2.LINE_AA)
        else:
            end = (int(x + rng.normal() * scale * 2), int(y + rng.normal() * scale * 2))
            cv2.line(picture, (x, y), end, colour, max(2, int(size * 0.012)), cv2.LINE_AA)
    return picture.astype(np.float32) / 255


def framed(picture: Texture, border: float = 0.07, colour: tuple[int, int, int] = (235, 230, 220)) -> Texture:
    """Return a picture whose rim is a plain margin. border: its width, relative to the shorter side."""
    margin = int(border * min(picture.shape[:2]))
    result = picture.copy()
    for edge in (np.s_[:margin], np.s_[-margin:], np.s_[:, :margin], np.s_[:, -margin:]):
        result[edge] = np.array(colour, np.float32) / 255
    return result


def writing(rng: np.random.Generator, height: int, width: int, paper: tuple[int, int, int],
            ink: tuple[int, int, int], line: int = 26) -> Texture:
    """Draw a sheet with a heading bar and rows of marks of word length. line: height of a row, pixels."""
    picture = np.full((height, width, 3), paper, np.uint8)
    top = int(1.2 * line)
    cv2.rectangle(picture, (line, line // 2), (int(width * 0.6), top), ink, -1)
    y = top + line
    while y < height - line:
        x = line
        while x < width - 2 * line:
            word = int(rng.integers(line // 2, 3 * line))
            if rng.random() < 0.85:
                cv2.line(picture, (x, y), (min(x + word, width - line), y), ink, max(2, line // 4), cv2.LINE_AA)
            x += word + line // 2
        y += line
    return picture.astype(np.float32) / 255


def planks(rng: np.random.Generator, height: int, width: int, palette: Palette, rows: int = 6) -> Texture:
    """Draw `rows` boards along x with grain, growth rings, spots and dark gaps."""
    picture = np.zeros((height, width, 3), np.float32)
    edges = np.linspace(0, height, rows + 1).astype(int)
    for low, high in pairwise(edges):
        tall = high - low
        grain = noise(rng, tall, width, tall / 3, 4, stretch=9.0)
        rings = 0.5 + 0.5 * np.sin(grain * 26 + rng.uniform(0, 6))
        spots = noise(rng, tall, width, tall / 1.5, 3)
        tone = 0.45 * grain + 0.25 * rings + 0.3 * spots
        board = gradient(np.clip(tone * 0.8 + rng.uniform(-0.1, 0.25), 0, 1), palette)
        joint = int(rng.integers(width))
        board[:, joint:joint + max(3, width // 300)] *= 0.35
        board[: max(3, height // 260)] *= 0.35
        picture[low:high] = board
    return picture


def marble(rng: np.random.Generator, height: int, width: int, palette: Palette) -> Texture:
    """Draw veined stone."""
    warp = noise(rng, height, width, height / 3, 5)
    veins = 1 - np.abs(np.sin(warp * 14 + noise(rng, height, width, height / 6, 4) * 5))
    return gradient(np.clip(0.25 + 0.75 * warp - 0.6 * veins**4, 0, 1), palette)


def map_of_islands(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw land, sea and mountains with a grid of meridians and parallels."""
    field = noise(rng, height, 2 * width, height / 4, 6)
    ramp = np.linspace(0, 1, width, dtype=np.float32)  # cross-fades the two halves
    field = field[:, :width] * (1 - ramp) + field[:, width:] * ramp
    field = (field - field.min()) / (field.max() - field.min())
    sea = gradient(field / 0.5, ((8, 40, 80), (20, 84, 130), (70, 150, 180)))
    land = gradient((field - 0.5) / 0.5, ((214, 190, 120), (110, 150, 70), (120, 90, 50), (240, 236, 228)))
    picture = np.where((field > 0.5)[..., None], land, sea).astype(np.float32)
    for index in range(12):
        x = int((index + 0.5) * width / 12)
        picture[:, x:x + 3] *= 0.6
    for index in range(1, 6):
        y = int(index * height / 6)
        picture[y:y + 3] *= 0.6
    return picture


def tiles(rng: np.random.Generator, height: int, width: int, palette: Palette, rows: int, columns: int,
          joint: tuple[int, int, int] = (60, 56, 52), offset: bool = False) -> Texture:
    """Draw tiles of different tones, some with a round mark. joint: colour between them. offset: lay them as bricks."""
    picture = np.full((height, width, 3), joint, np.float32) / 255
    grain = noise(rng, height, width, height / rows / 2, 4)
    tall, wide = height / rows, width / columns
    gap = max(2, int(0.04 * tall))
    for row in range(rows):
        for column in range(-1 if offset else 0, columns):  # -1: the half tile at the left of a shifted row
            shift = 0.5 * (row % 2) if offset else 0.0
            y0, y1 = int(row * tall) + gap, int((row + 1) * tall)
            x0, x1 = max(int((column + shift) * wide) + gap, 0), min(int((column + shift + 1) * wide), width)
            if x1 <= x0:
                continue
            tone = np.array(random_colour(rng, palette), np.float32) / 255
            picture[y0:y1, x0:x1] = tone * (0.55 + 0.6 * grain[y0:y1, x0:x1, None])
            if rng.random() < 0.45:
                centre = (int((x0 + x1) / 2), int((y0 + y1) / 2))
                mark = tuple(value / 255 for value in random_colour(rng, palette))
                cv2.circle(picture, centre, int(0.22 * min(tall, wide)), mark, -1, cv2.LINE_AA)
    return np.clip(picture, 0, 1)


def weave(rng: np.random.Generator, height: int, width: int, palette: Palette) -> Texture:
    """Draw a rug: nested borders, lozenges and stripes, a little worn."""
    picture = np.zeros((height, width, 3), np.uint8)
    border = min(height, width) // 14
    for ring in range(4):
        inset = ring * border
        cv2.rectangle(picture, (inset, inset), (width - inset - 1, height - inset - 1), random_colour(rng, palette), -1)
        for x in range(inset + border, width - inset - border, 2 * border):
            colour = random_colour(rng, palette)
            for y in (inset + border // 2, height - inset - border // 2):
                cv2.circle(picture, (x, y), border // 3, colour, -1, cv2.LINE_AA)
    step = int(2.6 * border)
    for row, y in enumerate(range(5 * border, height - 4 * border, step)):
        for x in range(5 * border + (row % 2) * step // 2, width - 4 * border, step):
            reach = step // 2 - 2
            corners = np.array([(x - reach, y), (x, y - reach), (x + reach, y), (x, y + reach)], np.int32)
            cv2.fillPoly(picture, [corners], random_colour(rng, palette), cv2.LINE_AA)
            cv2.circle(picture, (x, y), reach // 3, random_colour(rng, palette), -1, cv2.LINE_AA)
    worn = 0.75 + 0.35 * noise(rng, height, width, border, 3)[..., None]
    return np.clip(picture.astype(np.float32) / 255 * worn, 0, 1)


def facade(rng: np.random.Generator, height: int, width: int, palette: Palette, floors: int, bays: int) -> Texture:
    """Draw the front of a house: plaster, windows with shutters, some doors, a cornice. bays: windows in a row."""
    plaster = np.array(random_colour(rng, palette), np.float32) / 255
    picture = plaster * (0.75 + 0.35 * noise(rng, height, width, height / 5, 4)[..., None])
    tall, wide = height / floors, width / bays
    shutter = np.array(random_colour(rng, palette), np.float32) / 255 * 0.8
    for floor in range(floors):
        for bay in range(bays):
            top, left = int((floor + 0.22) * tall), int((bay + 0.3) * wide)
            # On the ground floor some windows reach down as doors.
            down = int((floor + (1.0 if floor == floors - 1 and rng.random() < 0.4 else 0.78)) * tall)
            right = int((bay + 0.7) * wide)
            edge = max(3, int(0.06 * wide))
            picture[top - edge:down + edge, left - edge:right + edge] = (0.82, 0.78, 0.7)
            picture[top:down, left:right] = np.array((0.10, 0.13, 0.17)) * rng.uniform(0.6, 2.4)
            picture[top:down, (left + right) // 2 - 2:(left + right) // 2 + 2] = (0.75, 0.72, 0.66)
            picture[(top + down) // 2 - 2:(top + down) // 2 + 2, left:right] = (0.75, 0.72, 0.66)
            if rng.random() < 0.7:
                picture[top:down, left - 4 * edge:left - edge] = shutter
                picture[top:down, right + edge:right + 4 * edge] = shutter
    picture[:int(0.05 * height)] = plaster * 0.6
    for floor in range(1, floors):
        picture[int(floor * tall) - 4:int(floor * tall) + 4] = plaster * 0.7
    return np.clip(picture, 0, 1).astype(np.float32)


def sky(rng: np.random.Generator, height: int, width: int, low: tuple[int, int, int], high: tuple[int, int, int],
        cloud: tuple[int, int, int]) -> Texture:
    """Draw an evening sky for the inside of a dome, with streaks of cloud.

    low, high: colours at the horizon, which is the picture's middle row, and at the zenith; cloud: of the clouds.
    """
    up = np.clip(1 - 2 * (np.arange(height, dtype=np.float32) + 0.5) / height, 0, 1)[:, None, None] ** 0.6
    colours = [np.array(colour, np.float32) / 255 for colour in (low, high, cloud)]
    clouds = noise(rng, height, width, height / 5, 5, stretch=5.0)
    clouds = np.clip((clouds - 0.5) * 2.2, 0, 0.8)[..., None]
    clear = colours[0] * (1 - up) + colours[1] * up
    return (clear * (1 - clouds) + colours[2] * clouds).astype(np.float32)
