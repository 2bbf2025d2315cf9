# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts between Blender's cameras and the core's: intrinsics and poses.

A Blender camera looks along -z with y up, one of the core along +z with y down. Pixel aspect and resolution belong to
the scene.
"""
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.capture import Camera
from ..core.errors import CaptureError
from .objects import world_matrix

Floats = NDArray[np.float64]

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
"""Matrix between the axes of Blender's cameras and the core's, in both directions."""


def pixel_aspect(fx: float, fy: float) -> tuple[float, float]:
    """Return the scene's pixel aspect (x, y) for focal lengths in pixels; Blender allows none below 1."""
    return (1.0, fx / fy) if fx >= fy else (fy / fx, 1.0)


def lens_of(camera: Camera, sensor_width: float, aspect: tuple[float, float]) -> tuple[float, float, float]:
    """Return focal length in mm, shift_x and shift_y for a Blender camera with sensor_fit HORIZONTAL.

    sensor_width: mm. aspect: the scene's pixel aspect, from `pixel_aspect`.
    """
    lens = camera.fx * sensor_width / camera.width
    shift_x = (camera.width / 2 - camera.cx) / camera.width
    shift_y = (camera.cy - camera.height / 2) / camera.width * (aspect[1] / aspect[0])
    return lens, shift_x, shift_y


def render_size(render: Any) -> tuple[int, int]:
    """Return the (width, height) of the render in pixels."""
    percentage = render.resolution_percentage  # integer division, as Blender rounds
    return max(render.resolution_x * percentage // 100, 1), max(render.resolution_y * percentage // 100, 1)


def intrinsics_of(data: Any, render: Any, eye_shift: float = 0.0) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a perspective camera's data, in pixels of the render.

    eye_shift: what stereo adds to shift_x, as part of the side that the sensor fits. Raises CaptureError for an
    orthographic or panoramic camera, and for data of an object that is not a camera.
    """
    if getattr(data, "sensor_fit", None) is None:
        raise CaptureError("The scene's active camera is not a camera object; choose a camera in the scene's "
                           "properties.")
    if data.type != "PERSP":
        raise CaptureError(f"The camera {data.name!r} is not a perspective camera; a flare needs one.")
    width, height = render_size(render)
    pixel_height = render.pixel_aspect_y / render.pixel_aspect_x  # in widths of a pixel
    sensor_fit = data.sensor_fit
    if sensor_fit == "AUTO":
        is_wide = width * render.pixel_aspect_x >= height * render.pixel_aspect_y
        sensor_fit = "HORIZONTAL" if is_wide else "VERTICAL"
        sensor_size = data.sensor_width  # along the longer side, whichever it is
    else:
        sensor_size = data.sensor_width if sensor_fit == "HORIZONTAL" else data.sensor_height
    # Length of the side that the sensor fits, in widths of a pixel; Blender's shifts are parts of it.
    fitted_length = width if sensor_fit == "HORIZONTAL" else height * pixel_height
    fx = data.lens * fitted_length / sensor_size
    cx = width / 2 - (data.shift_x + eye_shift) * fitted_length
    cy = height / 2 + data.shift_y * fitted_length / pixel_height
    return fx, fx / pixel_height, cx, cy


def camera_to_world(matrix: Any) -> Floats:
    """Return camera_to_world (4, 4) of the core from an object's matrix_world, without the scale of its parents."""
    values = np.array([list(row) for row in matrix], np.float64)
    lengths = np.linalg.norm(values[:3, :3], axis=0)
    lengths[lengths == 0] = 1.0
    values[:3, :3] /= lengths
    return values @ FLIP_YZ


def core_camera(data: Any, matrix: Any, render: Any, eye_shift: float = 0.0) -> Camera:
    """Return the core's camera for a Blender camera (its evaluated data and matrix_world), in Blender's world.

    eye_shift: as in `intrinsics_of`. Raises CaptureError for a camera that is not a perspective camera, is scaled to
    zero, or is not at a finite position.
    """
    fx, fy, cx, cy = intrinsics_of(data, render, eye_shift)
    width, height = render_size(render)
    pose = camera_to_world(matrix)
    if not np.isfinite(pose).all() or np.linalg.matrix_rank(pose[:3, :3]) < 3:
        raise CaptureError(f"The camera {data.name!r} is scaled to zero, or its position is not finite; correct its "
                           "transform, and the drivers and parents that move it.")
    return Camera(width, height, fx, fy, cx, cy, np.linalg.inv(pose))


def world_to_capture(root: Any, depsgraph: Any) -> Floats:
    """Return the matrix (4, 4) from Blender's world to the capture's, by the current transform of its root.

    The identity without a root, and for a root that is scaled to zero. Raises CaptureError for a disabled root whose
    place is unknown.
    """
    if root is None:
        return np.eye(4)
    matrix = np.array([list(row) for row in world_matrix(root, depsgraph)], np.float64)
    return np.linalg.inv(matrix) if abs(np.linalg.det(matrix[:3, :3])) > 1e-18 else np.eye(4)


def point_in_capture(point: Any, root: Any, depsgraph: Any) -> Floats:
    """Return a point (3,) of Blender's world in the capture's coordinates. Raises CaptureError."""
    return (world_to_capture(root, depsgraph) @ np.array([*point, 1.0]))[:3]


def pose_in_capture(matrix: Any, root: Any, depsgraph: Any) -> Floats:
    """Return world_to_camera (4, 4) in the capture's coordinates for a camera's matrix_world. Raises CaptureError."""
    return transformed_pose(matrix, world_to_capture(root, depsgraph))


def transformed_pose(matrix: Any, to_capture: Floats) -> Floats:
    """Return world_to_camera (4, 4) for a camera's matrix_world, in the coordinates into which `to_capture` (4, 4)
    transforms Blender's."""
    placed = to_capture @ camera_to_world(matrix)  # with the scale of the root
    placed[:3, :3] /= np.linalg.norm(placed[:3, :3], axis=0)
    return np.linalg.inv(placed)
