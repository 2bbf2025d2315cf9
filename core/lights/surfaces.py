# SPDX-License-Identifier: GPL-3.0-or-later
"""Separates lamps from bright surfaces: windows, lit walls and boards, by all views together. `find` calls it.

A lamp has one shape, which recurs in the views that nothing hides it from. A part of a bright surface has the shape of
the gap in what stands before it, which changes from view to view. In some views nothing cuts it out: the surface is as
bright there, but the detector finds no compact spot. A large part ends at something dark, such as a frame.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..capture.camera import Camera, Floats
from .detection import Detection
from .found_light import FoundLight
from .surroundings import map_index

GRID = 48
"""Samples across a shape."""
REACH = 2.0
"""Half the width of a shape, radii of the light."""
MIN_SHAPES, MIN_SHAPE_RADIUS = 3, 2.5
"""Number of detections, whole within their frames, and radius of a light, pixels, from which shapes are compared: those
of smaller discs differ by where the pixels fall."""
CONSISTENCY_QUANTILE = 2 / 3
"""Quantile of the overlaps: a lamp shows its whole shape in the rest of its detections, at least a third."""
MIN_CONSISTENCY = 0.55
"""Recurrence of a light's shapes below which it is part of a surface."""
MIN_DETECTION_RATE = 0.4
"""Share of detections among the views that show a light's place bright, below which it is part of a surface."""
LARGE_RADIUS, MIN_LARGE_CONFIDENCE = 0.018, 0.75
"""Radius of a light, frame diagonals, from which it is large, and the least product of its consistency and its
detection rate: little hides much of it, and most large bright regions are surfaces."""
MIN_LAMP_SURROUND = 0.2
"""Median surround of a large light's detections, linear light, from which it is a lamp all the same: its glow or the
wall that it lights is bright on all sides."""


def split_surfaces(lights: Sequence[FoundLight], cameras: Mapping[str, Camera],
                   maps: Mapping[str, NDArray[np.bool_]]) -> tuple[list[FoundLight], list[FoundLight]]:
    """Return the lamps among the lights, and the parts of bright surfaces.

    A far light is not tested: the sun's place may be anywhere in a clipped sky. cameras, maps: camera of each view, and
    mask (h, w) of its bright areas (`surroundings.brightness_map`), by name.
    """
    lamps: list[FoundLight] = []
    surfaces: list[FoundLight] = []
    for light in lights:
        (surfaces if not light.far and _is_surface(light, cameras, maps) else lamps).append(light)
    return lamps, surfaces


def shape_consistency(light: FoundLight, cameras: Mapping[str, Camera]) -> float | None:
    """Return how well the shapes of a light's detections recur, 0..1.

    The overlap of two shapes is their intersection over their union. The consistency of one shape is the quantile
    CONSISTENCY_QUANTILE of its overlaps with the others; that of the light is the same quantile over its shapes, since
    something may hide a part of a lamp in most views. Detections that the frame's edge cuts have no shape. None if
    fewer than MIN_SHAPES have one, or if the light is smaller than MIN_SHAPE_RADIUS.
    """
    whole = [(cameras[name], detection) for name, detection in light.detections if not detection.is_cut]
    if len(whole) < MIN_SHAPES or light.radius < MIN_SHAPE_RADIUS:
        return None
    scales = [camera.fx / _depth(light, camera) for camera, _ in whole]
    radius = float(np.median([detection.radius / scale for (_, detection), scale in zip(whole, scales, strict=True)]))
    shapes = np.stack([_sample_shape(detection, camera.project(light.xyz[None])[0][0], radius * scale).ravel()
                       for (camera, detection), scale in zip(whole, scales, strict=True)]).astype(np.float64)
    areas, intersections = shapes.sum(axis=1), shapes @ shapes.T
    overlaps = intersections / np.maximum(areas[:, None] + areas - intersections, 1)
    others = overlaps[~np.eye(len(whole), dtype=bool)].reshape(len(whole), -1)
    return float(np.quantile(np.quantile(others, CONSISTENCY_QUANTILE, axis=1), CONSISTENCY_QUANTILE))


def detection_rate(light: FoundLight, cameras: Mapping[str, Camera], maps: Mapping[str, NDArray[np.bool_]]) -> float:
    """Return the share of detections, 0..1, among the views that detect a light or show its place bright.

    cameras, maps: as for `split_surfaces`.
    """
    bright = 0
    for name, camera in cameras.items():
        pixels, depth = camera.project(light.xyz[None])
        if name not in light.support and camera.contains(pixels, depth)[0]:
            bright += bool(maps[name][map_index(maps[name], pixels[0], camera)])
    return len(light.support) / max(len(light.support) + bright, 1)


def _is_surface(light: FoundLight, cameras: Mapping[str, Camera], maps: Mapping[str, NDArray[np.bool_]]) -> bool:
    diagonal = float(np.median([np.hypot(*camera.size) for camera in cameras.values()]))
    is_large = light.radius >= LARGE_RADIUS * diagonal
    consistency, rate = shape_consistency(light, cameras), detection_rate(light, cameras, maps)
    if is_large and np.median([detection.surround for _, detection in light.detections]) < MIN_LAMP_SURROUND:
        return consistency is None or consistency * rate < MIN_LARGE_CONFIDENCE  # None: no view shows it whole
    return rate < MIN_DETECTION_RATE or (consistency is not None and consistency < MIN_CONSISTENCY)


def _depth(light: FoundLight, camera: Camera) -> float:
    """Return the depth of a light along a camera's axis, world units."""
    return max(float(camera.project(light.xyz[None])[1][0]), 1e-9)


def _sample_shape(detection: Detection, centre: Floats, radius: float) -> NDArray[np.bool_]:
    """Return the mask of a detection on a grid (GRID, GRID) about `centre` (2,), pixels.

    The grid reaches REACH times `radius`, pixels, on each side.
    """
    offsets = ((np.arange(GRID) + 0.5) / GRID * 2 - 1) * REACH * radius
    columns = np.floor(centre[0] + offsets).astype(int) - detection.corner[0]
    rows = np.floor(centre[1] + offsets).astype(int) - detection.corner[1]
    height, width = detection.mask.shape
    inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
    return np.asarray(inside & detection.mask[rows.clip(0, height - 1)][:, columns.clip(0, width - 1)])
