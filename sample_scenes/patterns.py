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


def gradient_map(values: Texture, palette: Palette) -> Texture:
    """Map values (...), 0..1, to colours (..., 3), 0..1, along the palette."""
    colours = np.array(palette, np.float32) / 255
    positions = np.clip(values, 0, 1) * (len(colours) - 1)
    low = np.minimum(positions.astype(int), len(colours) - 2)
    fraction = (positions - low)[..., None]
    return colours[low] * (1 - fraction) + colours[low + 1] * fraction


def random_colour(rng: np.random.Generator, palette: Palette) -> tuple[int, int, int]:
    red, green, blue = palette[rng.integers(len(palette))]
    return int(red), int(green), int(blue)


def poster(rng: np.random.Generator, height: int, width: int, palette: Palette, shapes: int = 60) -> Texture:
    """Draw `shapes` overlapping discs, rings, polygons, bars and lines, the largest first and so behind."""
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
            ink: tuple[int, int, int], spacing: int = 26) -> Texture:
    """Draw a sheet with a heading bar and rows of marks as long as words. spacing: of the rows, pixels."""
    picture = np.full((height, width, 3), paper, np.uint8)
    heading_bottom = int(1.2 * spacing)
    cv2.rectangle(picture, (spacing, spacing // 2), (int(width * 0.6), heading_bottom), ink, -1)
    y = heading_bottom + spacing
    while y < height - spacing:
        x = spacing
        while x < width - 2 * spacing:
            length = int(rng.integers(spacing // 2, 3 * spacing))
            if rng.random() < 0.85:
                cv2.line(picture, (x, y), (min(x + length, width - spacing), y), ink, max(2, spacing // 4), cv2.LINE_AA)
            x += length + spacing // 2
        y += spacing
    return picture.astype(np.float32) / 255


def planks(rng: np.random.Generator, height: int, width: int, palette: Palette, rows: int = 6) -> Texture:
    """Draw `rows` boards along x with grain, growth rings, spots and dark gaps."""
    picture = np.zeros((height, width, 3), np.float32)
    edges = np.linspace(0, height, rows + 1).astype(int)
    for top, bottom in pairwise(edges):
        board_height = bottom - top
        grain = noise(rng, board_height, width, board_height / 3, 4, stretch=9.0)
        rings = 0.5 + 0.5 * np.sin(grain * 26 + rng.uniform(0, 6))
        spots = noise(rng, board_height, width, board_height / 1.5, 3)
        tone = 0.45 * grain + 0.25 * rings + 0.3 * spots
        board = gradient_map(np.clip(tone * 0.8 + rng.uniform(-0.1, 0.25), 0, 1), palette)
        joint = int(rng.integers(width))
        board[:, joint:joint + max(3, width // 300)] *= 0.35
        board[: max(3, height // 260)] *= 0.35
        picture[top:bottom] = board
    return picture


def marble(rng: np.random.Generator, height: int, width: int, palette: Palette) -> Texture:
    """Draw veined stone: dark veins along the zeros of a warped sine."""
    warp = noise(rng, height, width, height / 3, 5)
    veins = 1 - np.abs(np.sin(warp * 14 + noise(rng, height, width, height / 6, 4) * 5))
    return gradient_map(np.clip(0.25 + 0.75 * warp - 0.6 * veins**4, 0, 1), palette)


def map_of_islands(rng: np.random.Generator, height: int, width: int) -> Texture:
    """Draw land, sea and mountains with a grid of meridians and parallels."""
    field = noise(rng, height, 2 * width, height / 4, 6)
    ramp = np.linspace(0, 1, width, dtype=np.float32)  # cross-fades the two halves
    field = field[:, :width] * (1 - ramp) + field[:, width:] * ramp
    field = (field - field.min()) / (field.max() - field.min())
    sea = gradient_map(field / 0.5, ((8, 40, 80), (20, 84, 130), (70, 150, 180)))
    land = gradient_map((field - 0.5) / 0.5, ((214, 190, 120), (110, 150, 70), (120, 90, 50), (240, 236, 228)))
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
    row_height, column_width = height / rows, width / columns
    gap = max(2, int(0.04 * row_height))
    for row in range(rows):
        for column in range(-1 if offset else 0, columns):  # -1: the half tile at the left of a shifted row
            shift = 0.5 * (row % 2) if offset else 0.0
            y0, y1 = int(row * row_height) + gap, int((row + 1) * row_height)
            x0 = max(int((column + shift) * column_width) + gap, 0)
            x1 = min(int((column + shift + 1) * column_width), width)
            if x1 <= x0:
                continue
            tone = np.array(random_colour(rng, palette), np.float32) / 255
            picture[y0:y1, x0:x1] = tone * (0.55 + 0.6 * grain[y0:y1, x0:x1, None])
            if rng.random() < 0.45:
                centre = (int((x0 + x1) / 2), int((y0 + y1) / 2))
                mark = tuple(value / 255 for value in random_colour(rng, palette))
                cv2.circle(picture, centre, int(0.22 * min(row_height, column_width)), mark, -1, cv2.LINE_AA)
    return np.clip(picture, 0, 1)


def weave(rng: np.random.Generator, height: int, width: int, palette: Palette) -> Texture:
    """Draw a woven rug: nested borders, lozenges and stripes, a little worn."""
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
            half = step // 2 - 2  # of a lozenge
            corners = np.array([(x - half, y), (x, y - half), (x + half, y), (x, y + half)], np.int32)
            cv2.fillPoly(picture, [corners], random_colour(rng, palette), cv2.LINE_AA)
            cv2.circle(picture, (x, y), half // 3, random_colour(rng, palette), -1, cv2.LINE_AA)
    wear = 0.75 + 0.35 * noise(rng, height, width, border, 3)[..., None]
    return np.clip(picture.astype(np.float32) / 255 * wear, 0, 1)


def facade(rng: np.random.Generator, height: int, width: int, palette: Palette, floors: int, bays: int) -> Texture:
    """Draw the front of a house: plaster, windows with shutters, some doors, a cornice. bays: windows in a row."""
    plaster = np.array(random_colour(rng, palette), np.float32) / 255
    picture = plaster * (0.75 + 0.35 * noise(rng, height, width, height / 5, 4)[..., None])
    floor_height, bay_width = height / floors, width / bays
    shutter = np.array(random_colour(rng, palette), np.float32) / 255 * 0.8
    for floor in range(floors):
        for bay in range(bays):
            top, left = int((floor + 0.22) * floor_height), int((bay + 0.3) * bay_width)
            # On the ground floor some windows reach down as doors.
            bottom = int((floor + (1.0 if floor == floors - 1 and rng.random() < 0.4 else 0.78)) * floor_height)
            right = int((bay + 0.7) * bay_width)
            edge = max(3, int(0.06 * bay_width))  # width of a window frame
            picture[top - edge:bottom + edge, left - edge:right + edge] = (0.82, 0.78, 0.7)
            picture[top:bottom, left:right] = np.array((0.10, 0.13, 0.17)) * rng.uniform(0.6, 2.4)
            picture[top:bottom, (left + right) // 2 - 2:(left + right) // 2 + 2] = (0.75, 0.72, 0.66)
            picture[(top + bottom) // 2 - 2:(top + bottom) // 2 + 2, left:right] = (0.75, 0.72, 0.66)
            if rng.random() < 0.7:
                picture[top:bottom, left - 4 * edge:left - edge] = shutter
                picture[top:bottom, right + edge:right + 4 * edge] = shutter
    picture[:int(0.05 * height)] = plaster * 0.6
    for floor in range(1, floors):
        picture[int(floor * floor_height) - 4:int(floor * floor_height) + 4] = plaster * 0.7
    return np.clip(picture, 0, 1).astype(np.float32)


def sky(rng: np.random.Generator, height: int, width: int, horizon: tuple[int, int, int], zenith: tuple[int, int, int],
        cloud: tuple[int, int, int]) -> Texture:
    """Draw an evening sky for the inside of a dome, with streaks of cloud.

    horizon, zenith, cloud: their colours, R G B 0..255. The horizon is the picture's middle row.
    """
    height_share = np.clip(1 - 2 * (np.arange(height, dtype=np.float32) + 0.5) / height, 0, 1)[:, None, None] ** 0.6
    colours = [np.array(colour, np.float32) / 255 for colour in (horizon, zenith, cloud)]
    clouds = noise(rng, height, width, height / 5, 5, stretch=5.0)
    clouds = np.clip((clouds - 0.5) * 2.2, 0, 0.8)[..., None]
    clear = colours[0] * (1 - height_share) + colours[1] * height_share
    return (clear * (1 - clouds) + colours[2] * clouds).astype(np.float32)
