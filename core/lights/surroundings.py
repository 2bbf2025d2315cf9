# SPDX-License-Identifier: GPL-3.0-or-later
"""Separates lamps from gaps through which a bright far surrounding shows, by all views together. `find` calls it.

Detections in a gap between near things can agree on one place, that of the gap. But their light comes from far away:
other views see it in the same direction, unless something hides it there. They see a lamp in another direction.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..capture.camera import Camera, Floats
from ..images.picture import Picture
from .found_light import FoundLight

MAP_WIDTH = 160
"""Largest width of a brightness map, pixels."""
CLIPPED, MIN_CLIPPED_SHARE = 0.96, 0.5
"""Smallest value of the largest channel of a bright pixel, display values, and the smallest share of bright pixels in a
bright pixel of a map."""
MIN_AREA_SHARE = 0.01
"""Share of the frame from which a bright area is too large for the disc of a light."""
SEPARATION = 4.0
"""Smallest distance in a view between a light's place and a detection's direction, in radii of the light, at which the
view decides."""
MIN_SEPARATION = 0.02
"""Lower bound of that distance, as a share of the frame's width."""
MIN_TESTS = 6
"""Number of pairs of a detection and another view below which nothing is decided."""
MIN_EXPLAINED, MIN_EXCESS = 0.4, 0.15
"""A light is a gap if the surrounding is bright in at least this share of the tests, and if that share exceeds the
bright share of the frames by so much: in over-exposed frames, every direction is bright."""


def brightness_map(picture: Picture) -> NDArray[np.bool_]:
    """Return a small map (height, width), at most MAP_WIDTH wide, true where at least half the picture is clipped."""
    width = min(MAP_WIDTH, picture.size[0])
    height = max(round(picture.size[1] * width / picture.size[0]), 1)
    bright = (picture.display().max(axis=2, keepdims=True) >= CLIPPED).astype(np.float32)
    shares = Picture(np.repeat(bright, 3, axis=2), "linear").resized(width, height).pixels[..., 0]
    return np.asarray(shares >= MIN_CLIPPED_SHARE)


def clipped_area(bright: NDArray[np.bool_], camera: Camera, lights: Sequence[FoundLight]) -> NDArray[np.bool_]:
    """Return the mask (height, width) of the large bright areas of a view in which none of the lights lies.

    bright: the view's map (`brightness_map`). An area is large from MIN_AREA_SHARE of the frame.
    """
    import cv2

    count, labels, boxes, _ = cv2.connectedComponentsWithStats(bright.astype(np.uint8), connectivity=8)
    large = np.asarray(boxes)[:, cv2.CC_STAT_AREA] >= MIN_AREA_SHARE * bright.size
    large[0] = False  # label 0 is what is not bright
    if lights and count > 1:
        pixels, depth = camera.project(np.stack([light.xyz for light in lights]))
        for pixel in pixels[camera.contains(pixels, depth)]:
            large[labels[map_index(bright, pixel, camera)]] = False
    return np.asarray(large[labels])


def map_index(mask: NDArray[np.bool_], pixel: Floats, camera: Camera) -> tuple[int, int]:
    """Return the row and the column, in a map (height, width) of a view, of a pixel (2,) that its camera contains."""
    height, width = mask.shape
    column, row = (pixel / camera.size * (width, height)).astype(int)
    return min(row, height - 1), min(column, width - 1)  # a camera contains the right and the lower edge of its frame


def explained_share(light: FoundLight, cameras: Mapping[str, Camera],
                    maps: Mapping[str, NDArray[np.bool_]]) -> float | None:
    """Return the share, 0..1, of the tests in which the far surrounding is bright where a light was detected.

    A test looks from another view in the direction of a detection, as if its light came from far away. cameras, maps:
    camera of each view, and mask (h, w) of its bright areas, by name. None if fewer than MIN_TESTS tests decide,
    because the light itself is far or nearly in the same direction from all views.
    """
    if light.far:
        return None
    is_bright = []
    for name, detection in light.detections:
        direction = cameras[name].rays(detection.xy[None])[0]
        for other_name, camera in cameras.items():
            if other_name == name:
                continue
            pixel = _project_direction(camera, direction)
            if pixel is None:
                continue
            place, depth = camera.project(light.xyz[None])
            clearance = max(SEPARATION * light.radius * camera.width / cameras[name].width,
                            MIN_SEPARATION * camera.width)
            # The light and the direction fall on one spot here, so the test could not tell a lamp from the surrounding.
            if depth[0] > 0 and np.linalg.norm(place[0] - pixel) < clearance:
                continue
            bright = maps[other_name]
            is_bright.append(bool(bright[map_index(bright, pixel, camera)]))
    return float(np.mean(is_bright)) if len(is_bright) >= MIN_TESTS else None


def split_gaps(lights: Sequence[FoundLight], cameras: Mapping[str, Camera],
               maps: Mapping[str, NDArray[np.bool_]]) -> tuple[list[FoundLight], list[FoundLight]]:
    """Return the lamps among the lights, and the gaps, whose light comes from a bright far surrounding.

    cameras, maps: as for `explained_share`.
    """
    threshold = max(MIN_EXPLAINED, MIN_EXCESS + float(np.mean([bright.mean() for bright in maps.values()])))
    lamps: list[FoundLight] = []
    gaps: list[FoundLight] = []
    for light in lights:
        share = explained_share(light, cameras, maps)
        (gaps if share is not None and share >= threshold else lamps).append(light)
    return lamps, gaps


def _project_direction(camera: Camera, direction: Floats) -> Floats | None:
    """Return the pixel (2,) at which a camera sees a direction (3,); None outside its frame."""
    local = camera.world_to_camera[:3, :3] @ direction
    if local[2] <= 1e-6:
        return None
    pixel = local[:2] / local[2] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return np.asarray(pixel) if camera.contains(pixel[None])[0] else None
