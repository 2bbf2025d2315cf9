# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's cameras and the core's: intrinsics and poses, either way.

Blender looks along -z with y up, the core along +z with y down. Pixel aspect and resolution are the scene's.
"""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.capture import Camera
from ..core.errors import CaptureError
from .objects import matrix_of

Floats = NDArray[np.float64]

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def pixel_aspect(fx: float, fy: float) -> tuple[float, float]:
    """The scene's pixel aspect (x, y) for these focal lengths in pixels; neither may be below 1."""
    return (1.0, fx / fy) if fx >= fy else (fy / fx, 1.0)


def lens_of(camera: Camera, sensor_width: float, aspect: tuple[float, float]) -> tuple[float, float, float]:
    """(focal length in mm, shift_x, shift_y) of a Blender camera with sensor_fit HORIZONTAL."""
    lens = camera.fx * sensor_width / camera.width
    shift_x = (camera.width / 2 - camera.cx) / camera.width
    shift_y = (camera.cy - camera.height / 2) / camera.width * (aspect[1] / aspect[0])
    return lens, shift_x, shift_y


def render_size(render: Any) -> tuple[int, int]:
    """(width, height) of the picture that is rendered, in pixels."""
    percentage = render.resolution_percentage  # in whole numbers, as Blender rounds
    return max(render.resolution_x * percentage // 100, 1), max(render.resolution_y * percentage // 100, 1)


def intrinsics_of(data: Any, render: Any) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels of the render, of a perspective camera's data.

    Raises CaptureError for an orthographic or panoramic camera, and for data of another object than a camera.
    """
    if getattr(data, "sensor_fit", None) is None:
        raise CaptureError("The scene's active camera is an object of another kind; choose a camera in the scene's "
                           "properties.")
    if data.type != "PERSP":
        raise CaptureError(f"The camera {data.name!r} is not a perspective camera; a flare needs one.")
    width, height = render_size(render)
    tall = render.pixel_aspect_y / render.pixel_aspect_x
    fit = data.sensor_fit
    if fit == "AUTO":
        fit = "HORIZONTAL" if width * render.pixel_aspect_x >= height * render.pixel_aspect_y else "VERTICAL"
        sensor = data.sensor_width
    else:
        sensor = data.sensor_width if fit == "HORIZONTAL" else data.sensor_height
    reach = width if fit == "HORIZONTAL" else height * tall
    fx = data.lens * reach / sensor
    return fx, fx / tall, width / 2 - data.shift_x * reach, height / 2 + data.shift_y * reach / tall


def camera_to_world(matrix: Any) -> Floats:
    """(4, 4) of the core, world units, from an object's matrix_world; the scale of parents is taken out."""
    values = np.array([list(row) for row in matrix], np.float64)
    lengths = np.linalg.norm(values[:3, :3], axis=0)
    lengths[lengths == 0] = 1.0
    values[:3, :3] /= lengths
    return values @ FLIP


def core_camera(data: Any, matrix: Any, render: Any) -> Camera:
    """The core's camera of a Blender camera (its evaluated data and matrix_world), in Blender's world. Raises
    CaptureError as `intrinsics_of` does, and for one that is scaled to nothing or whose place is no number."""
    fx, fy, cx, cy = intrinsics_of(data, render)
    width, height = render_size(render)
    pose = camera_to_world(matrix)
    if not np.isfinite(pose).all() or np.linalg.matrix_rank(pose[:3, :3]) < 3:
        raise CaptureError(f"The camera {data.name!r} is scaled to nothing, or its place is not finite; mend its "
                           "transform, and the drivers and parents that move it.")
    return Camera(width, height, fx, fy, cx, cy, np.linalg.inv(pose))


def to_capture(root: Any, depsgraph: Any) -> Floats:
    """(4, 4) from Blender's world to the capture's, as the root that carries it stands now; one where it is None.
    Raises CaptureError as `matrix_of` does."""
    if root is None:
        return np.eye(4)
    matrix = np.array([list(row) for row in matrix_of(root, depsgraph)], np.float64)
    return np.linalg.inv(matrix) if abs(np.linalg.det(matrix[:3, :3])) > 1e-18 else np.eye(4)


def point_in_capture(point: Any, root: Any, depsgraph: Any) -> Floats:
    """(3,) in the capture's coordinates of a point (3,) of Blender's world. Raises CaptureError."""
    return (to_capture(root, depsgraph) @ np.array([*point, 1.0]))[:3]


def pose_in_capture(matrix: Any, root: Any, depsgraph: Any) -> Floats:
    """world_to_camera (4, 4) in the capture's coordinates of a camera with this matrix_world. Raises CaptureError."""
    placed = to_capture(root, depsgraph) @ camera_to_world(matrix)
    placed[:3, :3] /= np.linalg.norm(placed[:3, :3], axis=0)
    return np.linalg.inv(placed)
