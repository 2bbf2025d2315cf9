# SPDX-License-Identifier: GPL-3.0-or-later
"""Adds far points where structure from motion has none: a sky, a plain wall behind everything. `initialise` calls it.

With exact clean frames the scene grows over such places by itself. In a fit by parallax the flare would get there
first: it can paint a sky that follows the light at no cost.
"""
from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ..capture import Capture, View
from ..capture.colmap import PointCloud
from ..colour.srgb_torch import expose
from .frames import Frames, sample_colours, subsample

SKY_POINTS = 2000
RADIUS_FACTOR = 3.0
"""Radius of the sphere relative to that of the capture's points about the cameras' centre, without the farthest 5 %."""
SAMPLED_VIEWS = 40
"""Approximate number of views whose colours are used."""
COLOUR_QUANTILE = 0.25
"""Quantile of the views' colours that a point takes: flares only add light."""


def add_sky_points(capture: Capture, views: tuple[View, ...], frames: Frames) -> PointCloud:
    """Return the capture's points, plus points on a large sphere about the cameras that some view sees.

    A point on the sphere has a low quantile of the frames' colours there, at the usual exposure: flares only add light.
    """
    points = capture.points
    centre = np.mean([view.camera.position for view in views], 0)
    radius = RADIUS_FACTOR * float(np.quantile(np.linalg.norm(points.xyz - centre, axis=1), 0.95))
    xyz = centre + radius * fibonacci_directions(SKY_POINTS)
    sampled = subsample(views, SAMPLED_VIEWS)
    view_colours = np.full((len(sampled), SKY_POINTS, 3), np.nan, np.float32)
    for row, view in zip(view_colours, sampled, strict=True):
        camera, frame, _ = frames.targets(view)
        inside, observed = sample_colours(xyz, camera, frame)
        row[inside] = expose(torch.from_numpy(observed), 1 / camera.exposure).numpy()
        if (mask := frames.mask(view)) is not None:
            _, counts = sample_colours(xyz, camera, mask)
            row[np.flatnonzero(inside)[~counts]] = np.nan
    is_visible = np.isfinite(view_colours[..., 0]).any(0)
    colours = np.nanquantile(view_colours[:, is_visible], COLOUR_QUANTILE, axis=0)
    rgb = np.concatenate([points.rgb, (colours.clip(0, 1) * 255 + 0.5).astype(np.uint8)])
    return PointCloud(np.concatenate([points.xyz, xyz[is_visible].astype(np.float32)]), rgb,
                      np.concatenate([points.error, np.zeros(int(is_visible.sum()), np.float32)]))


def fibonacci_directions(count: int, lowest: float = -1) -> NDArray[np.float64]:
    """Return unit vectors (count, 3), evenly spread over the part z > lowest of the sphere: a Fibonacci lattice
    (Swinbank and Purser 2006), with steps of the golden angle."""
    number = np.arange(count) + 0.5
    z, azimuth = 1 - (1 - lowest) * number / count, number * np.pi * (3 - np.sqrt(5))
    flat = np.sqrt(np.maximum(1 - z * z, 0))
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], 1)
