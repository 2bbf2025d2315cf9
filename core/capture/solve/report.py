# SPDX-License-Identifier: GPL-3.0-or-later
"""The result of a solve as figures (JSON), and a picture of cameras and points from above and from the front."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...images.write import write_png
from ..camera import Floats
from .mapping import Solved
from .source_frames import SourceFrame

PANEL = 720
"""Side of each of the two views, pixels."""
INK, PATH, PAPER = (0.15, 0.15, 0.15), (0.85, 0.2, 0.1), 1.0


def make_report(sources: Sequence[SourceFrame], solved: Solved, left_out: list[str], request: dict[str, Any],
                seconds: float) -> dict[str, Any]:
    """Return the figures of a camera solve as JSON values; errors in pixels of the pictures that were matched.

    sources: all frames of the footage; `solved` has those that the solve registered. left_out: sentences about frames
    that were not used. request: source and settings of the solve; a later run compares them with its own.
    seconds: duration of the solve.
    """
    registered = {frame.index for frame in solved.frames}
    model = solved.model
    lenses = list(dict.fromkeys(frame.lens for frame in solved.frames))
    return {
        "frames": len(sources), "registered": len(registered), "models": solved.sizes,
        "unregistered": [Path(sources[i].file).name for i in range(len(sources)) if i not in registered],
        "left_out": left_out, "matching": solved.matching, "pairs": solved.pairs,
        "points": len(model.xyz), "observations": int(model.tracks.sum()),
        "reprojection_error_px": round(float(model.error.mean()), 4),
        "track_length": round(float(model.tracks.mean()), 3),
        "cameras": [{"model": lens.model, "size": [lens.width, lens.height],
                     "params": dict(zip(lens.parameters, map(float, lens.params), strict=True))} for lens in lenses],
        "seconds": round(seconds, 1), "request": request,
    }


def draw_model(solved: Solved, path: Path) -> None:
    """Write a picture of points in their colours, cameras as dots with a line ahead, and their path, from above and
    from the front.

    The world is aligned: x to the right, y ahead, z up.
    """
    import cv2

    model = solved.model
    positions = np.array([-frame.world_to_camera[:3, :3].T @ frame.world_to_camera[:3, 3] for frame in solved.frames])
    ahead = np.array([frame.world_to_camera[2, :3] for frame in solved.frames])
    # Points in two views only are inaccurate; a few points are all drawn.
    is_reliable = model.tracks >= 3 if (model.tracks >= 3).sum() > 50 else np.ones(len(model.xyz), bool)
    xyz, rgb = model.xyz[is_reliable], model.rgb[is_reliable]
    # The pictures hold all cameras and most points, with a margin of a tenth.
    low, high = np.percentile(xyz, (2, 98), axis=0)
    low, high = np.minimum(low, positions.min(axis=0)), np.maximum(high, positions.max(axis=0))
    centre, half_extent = (low + high) / 2, 0.55 * float((high - low).max())
    sheet = np.full((PANEL, 2 * PANEL + 8, 3), PAPER, np.float32)
    for left, axes, title in ((0, (0, 1), "from above"), (PANEL + 8, (0, 2), "from the front")):
        panel = np.full((PANEL, PANEL, 3), PAPER, np.float32)

        def to_pixels(points: Floats, axes: tuple[int, int] = axes) -> Any:
            """Return the pixels (n, 2) of points (n, 3) on the panel."""
            flat = (points[:, axes] - centre[list(axes)]) / half_extent * (1, -1)
            return (0.5 * PANEL * (1 + flat)).round().astype(int)

        pixels = to_pixels(xyz)
        is_inside = ((pixels >= 1) & (pixels < PANEL - 1)).all(axis=1)
        for (x, y), colour in zip(pixels[is_inside], rgb[is_inside] / 255.0, strict=True):
            panel[y - 1:y + 1, x - 1:x + 1] = colour
        camera_pixels = to_pixels(positions)
        if len(camera_pixels) > 1:
            cv2.polylines(panel, [camera_pixels.reshape(-1, 1, 2)], False, PATH, 1, cv2.LINE_AA)
        for pixel, tip in zip(camera_pixels, to_pixels(positions + 0.06 * half_extent * ahead), strict=True):
            cv2.line(panel, tuple(map(int, pixel)), tuple(map(int, tip)), INK, 1, cv2.LINE_AA)
            cv2.circle(panel, tuple(map(int, pixel)), 3, INK, -1, cv2.LINE_AA)
        cv2.putText(panel, title, (12, 26), cv2.FONT_HERSHEY_SIMPLEX, 0.6, INK, 1, cv2.LINE_AA)
        sheet[:, left:left + PANEL] = panel
    write_png(path, sheet)
