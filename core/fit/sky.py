# SPDX-License-Identifier: GPL-3.0-or-later
"""Points far away, for what structure from motion finds none in: a sky, a plain wall behind everything.

Where flare-free frames teach the scene it grows over such places by itself. Where nothing but parallax tells it from a
flare, a flare would be there first: it costs nothing to paint a sky with one that follows the light.
"""
from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ..capture import Capture, View
from ..capture.colmap import PointCloud
from ..colour.srgb_torch import exposed
from ..thinning import thinned
from .frames import Frames, colours_at

COUNT = 2000
FAR = 3.0
"""Radius of the sphere, in those of the capture's points about the cameras' middle (all but the farthest few)."""
VIEWS = 40
"""About as many views are asked for the colours."""
FROM_BELOW = 0.25
"""Which quantile of the views' colours is a point's: flares only ever add."""


def with_sky(capture: Capture, views: tuple[View, ...], frames: Frames) -> PointCloud:
    """The capture's points, and on a sphere about them those that some view sees, in the colours of the frames."""
    points = capture.points
    middle = np.mean([view.camera.position for view in views], 0)
    radius = FAR * float(np.quantile(np.linalg.norm(points.xyz - middle, axis=1), 0.95))
    xyz = middle + radius * _directions(COUNT)
    asked = thinned(views, VIEWS)
    seen = np.full((len(asked), COUNT, 3), np.nan, np.float32)
    for row, view in zip(seen, asked, strict=True):
        camera, frame, _ = frames.targets(view)
        inside, shown = colours_at(xyz, camera, frame)
        row[inside] = exposed(torch.from_numpy(shown), 1 / camera.exposure).numpy()
    found = np.isfinite(seen[..., 0]).any(0)
    colours = np.nanquantile(seen[:, found], FROM_BELOW, axis=0)
    rgb = np.concatenate([points.rgb, (colours.clip(0, 1) * 255 + 0.5).astype(np.uint8)])
    return PointCloud(np.concatenate([points.xyz, xyz[found].astype(np.float32)]), rgb,
                      np.concatenate([points.error, np.zeros(int(found.sum()), np.float32)]))


def _directions(count: int) -> NDArray[np.float64]:
    """Unit vectors (count, 3), evenly spread: a Fibonacci lattice (Swinbank and Purser 2006)."""
    number = np.arange(count) + 0.5
    z, turn = 1 - 2 * number / count, number * np.pi * (3 - np.sqrt(5))
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)
