# SPDX-License-Identifier: GPL-3.0-or-later
"""The small views in which `far_layer` and `even_sky` look for what is far, and the directions that these see."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..capture import Camera, View
from ..colour.srgb_torch import expose
from ..images.picture import Picture
from .frames import Frames
from .sky import fibonacci_directions

SWEEP_WIDTH = 120
"""Width of the views, pixels."""
FARTHEST_QUANTILE = 0.99
PAIRS_AT_ONCE = 1 << 24
"""Pairs of directions that are compared at a time; bounds the memory."""

Floats = NDArray[np.float64]
Values = NDArray[np.float32]
Booleans = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SweepView:
    """A view of the sweep.

    camera: small. picture: (height, width, 3), display values. mask: (height, width), true for pixels that count; None
    for all.
    """

    camera: Camera
    picture: Values
    mask: Booleans | None


def make_sweep_view(view: View, frames: Frames) -> SweepView:
    """Return a view for the sweep, small and at the usual exposure: its clean frame if the fit has one, else its
    frame."""
    camera, frame, clean = frames.targets(view)
    small = camera.scaled(min(SWEEP_WIDTH, camera.width))
    picture = expose(frame if clean is None else clean, 1 / camera.exposure).numpy()
    values = Picture(picture, "srgb").resized(*small.size).display()
    mask, small_mask = frames.mask(view), None
    if mask is not None:
        share = Picture(mask.numpy().astype(np.float32), "linear").resized(*small.size).pixels
        small_mask = np.asarray(share > 0.99)  # a small pixel counts only if all pixels that it averages do
    return SweepView(small, values, small_mask)


def visible_directions(cameras: list[Camera], pitch: float) -> Floats:
    """Return unit vectors (n, 3) that some camera sees, about `pitch` radians from each other.

    The directions are those of a Fibonacci lattice (Swinbank and Purser 2006), which covers the sphere evenly, about
    the mean viewing direction.
    """
    forwards = np.array([camera.forward for camera in cameras])
    axis = forwards.mean(0)
    # Where cameras look all around, their mean direction means nothing, and any axis will do.
    axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 0.1 else forwards[0]
    reach = [np.arccos((forward @ axis).clip(-1, 1)) + np.arctan(camera.corner_radius)
             for forward, camera in zip(forwards, cameras, strict=True)]
    lowest = float(np.cos(min(max(reach), np.pi)))
    count = max(int(2 * np.pi * (1 - lowest) / (pitch * pitch)), 1)  # area of the cap over that of one direction
    helper = np.eye(3)[int(np.abs(axis).argmin())]
    right = np.cross(helper, axis)
    right /= np.linalg.norm(right)
    directions = fibonacci_directions(count, lowest) @ np.stack([right, np.cross(axis, right), axis])
    visible = np.zeros(count, bool)
    for camera in cameras:
        visible |= project_sphere(camera, camera.position, directions, 0.0)[0]
    return directions[visible]


def nearest_indices(directions: Floats, others: Floats) -> NDArray[np.int64]:
    """Return for each of the unit vectors `directions` (n, 3) the index (n,) of the nearest of `others` (m, 3)."""
    indices = np.zeros(len(directions), np.int64)
    columns = torch.from_numpy(others.T.astype(np.float32))
    rows = max(PAIRS_AT_ONCE // max(len(others), 1), 1)
    for start in range(0, len(directions), rows):
        block = slice(start, start + rows)
        cosines = torch.from_numpy(directions[block].astype(np.float32)) @ columns
        indices[block] = cosines.argmax(1).numpy()
    return indices


def project_sphere(camera: Camera, centre: Floats, directions: Floats, inverse_radius: float
                    ) -> tuple[Booleans, Floats]:
    """Return which points (n,) of a sphere about `centre`, in directions (n, 3), lie on the camera's frame, and their
    places (m, 2), pixels. inverse_radius: 1 / radius of the sphere, 0 for an infinite one."""
    rotation = camera.world_to_camera[:3, :3]
    # The point relative to the camera, over the radius: (centre + radius * direction - position) / radius.
    local = (directions + inverse_radius * (centre - camera.position)) @ rotation.T
    in_front = local[:, 2] > 1e-6
    with np.errstate(divide="ignore", invalid="ignore"):
        places = local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside = in_front & camera.contains(np.where(in_front[:, None], places, -1))
    return inside, places[inside]


def bilinear(picture: Values, places: Floats) -> Values:
    """Return bilinear samples (n, 3) of a picture at places (n, 2), pixels."""
    height, width = picture.shape[:2]
    x, y = np.clip(places[:, 0] - 0.5, 0, width - 1), np.clip(places[:, 1] - 0.5, 0, height - 1)
    left, top = x.astype(int), y.astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u, v = (x - left).astype(np.float32)[:, None], (y - top).astype(np.float32)[:, None]
    upper = picture[top, left] * (1 - u) + picture[top, right] * u
    lower = picture[bottom, left] * (1 - u) + picture[bottom, right] * u
    return np.asarray(upper * (1 - v) + lower * v)


def camera_centre(cameras: list[Camera]) -> Floats:
    """Return (3,), the mean position of cameras."""
    return np.asarray(np.mean([camera.position for camera in cameras], axis=0))


def camera_spread(cameras: list[Camera]) -> float:
    """Return the largest distance of a camera from the mean position, world units."""
    return max(float(np.linalg.norm(camera.position - camera_centre(cameras))) for camera in cameras)


def farthest_distance(points: Values, cameras: list[Camera]) -> float:
    """Return the distance of the farthest of points (n, 3) from the cameras' mean position, without the farthest 1 %;
    world units."""
    return float(np.quantile(np.linalg.norm(points - camera_centre(cameras), axis=1), FARTHEST_QUANTILE))


def median_focal_length(cameras: list[Camera]) -> float:
    """Return the median focal length of cameras, pixels."""
    return float(np.median([camera.focal_length for camera in cameras]))


def pixel_indices(places: Floats, size: tuple[int, int]) -> NDArray[np.int64]:
    """Return x and y (2, n) of the pixels that hold places (n, 2), pixels, in a frame of this width and height, which
    contains its right and lower edge."""
    return np.minimum(places.astype(np.int64), np.array(size) - 1).T
