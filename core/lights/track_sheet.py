# SPDX-License-Identifier: GPL-3.0-or-later
"""Contact sheets of lights that were followed: every frame small, with the path of each light round that frame."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture, LightState
from ..capture.lights import DOUBTFUL
from .overlay import PALETTE, RING_COLOUR, TILE_WIDTH, write_sheets
from .sources import Source

TAIL = 6
"""Frames of the path that are drawn before and after a frame."""
MARGIN = 0.07
"""Border round each frame, in widths, on which lights out of the frame are drawn."""


def write_track_sheets(folder: Path, capture: Capture, sources: Sequence[Sequence[Source]]) -> list[Path]:
    """Write sheet1.png, sheet2.png, ... of all frames with the capture's lights into `folder`; return their paths.

    A thin green ring is a bright spot. A cross with a name is a light, with the share of its brightness in per cent; a
    dashed circle is a place that is doubtful. The line is the light's path through the frames before and after.
    """
    states = [[capture.light_state(light, view) for light in capture.lights] for view in capture.views]
    return write_sheets(folder, len(capture.views), lambda index: _draw_tile(capture, index, sources[index], states))


def _draw_tile(capture: Capture, index: int, sources: Sequence[Source], states: Sequence[Sequence[LightState]]
               ) -> NDArray[np.float32]:
    """Return a small picture of view `index` with its sources, the lights, and the lights' paths.

    states: the state of each light in each view, by view, then by light.
    """
    import cv2

    view = capture.views[index]
    margin = round(TILE_WIDTH * MARGIN)
    scale = (TILE_WIDTH - 2 * margin) / view.camera.width
    size = (TILE_WIDTH - 2 * margin, round(view.camera.height * scale))
    frame = np.asarray(capture.frame(view).resized(*size).display())
    tile = np.ascontiguousarray(np.pad(frame, ((margin, margin), (margin, margin), (0, 0)), constant_values=0.12))
    for source in sources:
        centre = _on_tile(source.xy, scale, margin)
        cv2.circle(tile, centre, max(3, round(source.detection.radius * scale) + 2), RING_COLOUR, 1, cv2.LINE_AA)
    for number in range(len(states[index])):
        near = [in_view[number] for in_view in states[max(index - TAIL, 0):index + TAIL + 1]]
        path = [_on_tile(state.xy, scale, margin) for state in near if np.isfinite(state.xy).all()]
        _draw_light(tile, states[index][number], path, PALETTE[number % len(PALETTE)], scale, margin)
    cv2.putText(tile, view.name, (4, tile.shape[0] - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (1.0, 1.0, 1.0), 1,
                cv2.LINE_AA)
    return np.asarray(tile, np.float32)


def _draw_light(tile: NDArray[np.float32], state: LightState, path: Sequence[tuple[int, int]],
                colour: tuple[float, float, float], scale: float, margin: int) -> None:
    """Draw a light into the tile: its path, and a cross at its place, or a dashed circle if the place is doubtful.

    path: pixels of the tile. scale: pixels of the tile to one of the frame. margin: border round the frame on the tile,
    pixels.
    """
    import cv2

    if len(path) > 1:
        dim = (0.7 * colour[0], 0.7 * colour[1], 0.7 * colour[2])
        cv2.polylines(tile, [np.array(path, np.int32)], False, dim, 1, cv2.LINE_AA)
    if not np.isfinite(state.xy).all():
        return
    x, y = _on_tile(state.xy, scale, margin)
    if state.confidence < DOUBTFUL:
        for start in range(0, 360, 45):
            cv2.ellipse(tile, (x, y), (8, 8), 0, start, start + 22, colour, 1, cv2.LINE_AA)
    else:
        cv2.drawMarker(tile, (x, y), colour, cv2.MARKER_CROSS, 13, 1, cv2.LINE_AA)
    text = state.name if state.on is None else f"{state.name} {round(100 * state.on)}"
    cv2.putText(tile, text, (x + 9, y - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.36, colour, 1, cv2.LINE_AA)


def _on_tile(place: NDArray[np.float64], scale: float, margin: int) -> tuple[int, int]:
    """Return the pixel of the tile for a place (2,) in the frame, clipped to a range that cv2 can draw."""
    x, y = np.clip(place * scale + margin, -4 * TILE_WIDTH, 4 * TILE_WIDTH)
    return int(x), int(y)
