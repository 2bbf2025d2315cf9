# SPDX-License-Identifier: GPL-3.0-or-later
"""Contact sheets of a search for lights: every view small, with its detections and the projections of the lights."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture
from ..images.write import write_png
from ..system.files import remove_file
from .detection import Detection
from .found_light import FoundLight

COLUMNS, ROWS, TILE_WIDTH = 4, 5, 360
PALETTE = ((1.0, 0.35, 0.2), (0.25, 0.75, 1.0), (1.0, 0.85, 0.1), (0.9, 0.35, 1.0), (0.35, 1.0, 0.6))
RING_COLOUR = (0.4, 1.0, 0.3)


def write_overlay_sheets(folder: Path, capture: Capture, detections: Sequence[Sequence[Detection]],
                         lights: Sequence[tuple[str, FoundLight]]) -> list[Path]:
    """Write sheet1.png, sheet2.png, ... of all views into `folder`, in place of older ones; return their paths.

    A green ring is a detection; a cross with a name is a light's projection, thick where the view supports it. An arrow
    at the edge points to a light out of frame.
    """
    return write_sheets(folder, len(capture.views),
                        lambda number: _draw_tile(capture, number, detections[number], lights))


def write_sheets(folder: Path, count: int, draw_tile: Callable[[int], NDArray[np.float32]]) -> list[Path]:
    """Write sheet1.png, sheet2.png, ... of `count` tiles into `folder`, in place of older ones; return their paths.

    draw_tile: returns the tile with a given number, display values (height, TILE_WIDTH, 3); heights may differ.
    """
    for old in folder.glob("sheet*.png"):
        remove_file(old)
    tiles_per_sheet = COLUMNS * ROWS
    paths = []
    for start in range(0, count, tiles_per_sheet):
        tiles = [draw_tile(number) for number in range(start, min(start + tiles_per_sheet, count))]
        height = max(tile.shape[0] for tile in tiles)
        tiles = [np.pad(tile, ((0, height - tile.shape[0]), (0, 0), (0, 0))) for tile in tiles]
        tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMNS)
        rows = [np.concatenate(tiles[i:i + COLUMNS], axis=1) for i in range(0, len(tiles), COLUMNS)]
        path = folder / f"sheet{start // tiles_per_sheet + 1}.png"
        write_png(path, np.concatenate(rows, axis=0))
        paths.append(path)
    return paths


def _draw_tile(capture: Capture, number: int, detections: Sequence[Detection],
               lights: Sequence[tuple[str, FoundLight]]) -> NDArray[np.float32]:
    """Return a small picture of view `number`, with its detections as rings, and the lights as crosses in frame or as
    arrows to them at the edge."""
    import cv2

    view = capture.views[number]
    scale = TILE_WIDTH / view.camera.width
    size = (TILE_WIDTH, round(view.camera.height * scale))
    tile = np.ascontiguousarray(capture.frame(view).resized(*size).display())
    for detection in detections:
        centre = tuple(int(x) for x in detection.xy * scale)
        cv2.circle(tile, centre, max(4, round(detection.radius * scale) + 3), RING_COLOUR, 1, cv2.LINE_AA)
    for i, (name, light) in enumerate(lights):
        colour = PALETTE[i % len(PALETTE)]
        pixels, depth = view.camera.project(light.xyz[None])
        if depth[0] > 0:
            _draw_light(tile, pixels[0] * scale, name, colour, thickness=2 if view.name in light.support else 1)
    cv2.putText(tile, view.name, (4, size[1] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (1.0, 1.0, 1.0), 1, cv2.LINE_AA)
    return np.asarray(tile, np.float32)


def _draw_light(tile: NDArray[np.float32], place: NDArray[np.float64], name: str, colour: tuple[float, float, float],
                thickness: int) -> None:
    """Draw a light into the tile: a cross with its name, or, if it lies outside, an arrow to it at the edge.

    place: (2,), pixels of the tile. thickness: line width of the cross, pixels.
    """
    import cv2

    height, width = tile.shape[:2]
    x, y = place
    if 0 <= x < width and 0 <= y < height:
        cv2.drawMarker(tile, (int(x), int(y)), colour, cv2.MARKER_CROSS, 14, thickness, cv2.LINE_AA)
        cv2.putText(tile, name, (int(x) + 9, int(y) - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
        return
    middle = np.array([width, height]) / 2
    offset = np.array([x, y]) - middle
    tip = middle + offset * min((middle - 6) / np.maximum(np.abs(offset), 1e-9))
    tail = tip - 16 * offset / np.linalg.norm(offset)
    cv2.arrowedLine(tile, tuple(map(int, tail)), tuple(map(int, tip)), colour, 1, cv2.LINE_AA, tipLength=0.4)
