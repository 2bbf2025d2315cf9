# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads nerfstudio's and instant-ngp's `transforms.json`.

Poses are camera to world with OpenGL axes (x right, y up, z backward). `applied_transform` is already in the poses and
in the point cloud of `ply_file_path`, so the world of the file is the world of the capture; points of a COLMAP model
beside it still need it.
"""
from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CaptureError
from ..images.listing import SUFFIXES
from ..images.size import picture_size
from ..system.files import read_json, safe_join
from .camera import Floats, is_rotation
from .colmap import MAX_MAGNITUDE, PointCloud, PosedFrame, check_lens, find_model, read_model
from .lens import Lens
from .ply import read_points

FILE = "transforms.json"


def read_transforms(folder: Path) -> tuple[list[PosedFrame], PointCloud]:
    """Read poses and points of a capture; the names are paths below `folder`.

    Raises CaptureError, naming the file and the frame, where something is missing or invalid.
    """
    path = folder / FILE
    meta = read_json(path, CaptureError)
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames:
        raise CaptureError(f"{path} holds no frames; export it again.")
    posed: list[PosedFrame] = []
    lenses: dict[tuple[object, ...], Lens] = {}  # one object for frames of one lens: its maps are shared
    for number, frame in enumerate(frames):
        name = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(name, str):
            raise CaptureError(f"{path}, frame {number}: file_path is missing; export it again.")
        where = f"{path}, {name}:"
        name = _with_suffix(folder, name)
        lens = _read_lens({**meta, **frame}, folder, name, where)
        lens = lenses.setdefault((lens.model, lens.params, lens.width, lens.height), lens)
        posed.append(PosedFrame(name, lens, _read_pose(frame, where)))
    return posed, _read_points(folder, meta)


def _with_suffix(folder: Path, name: str) -> str:
    """Return the path of a frame below the folder; NeRF's synthetic scenes leave its suffix out."""
    name = Path(name.replace("\\", "/")).as_posix()  # drops a leading "./"
    path = safe_join(folder, name, CaptureError)
    if path.suffix.lower() not in SUFFIXES:
        for suffix in sorted(SUFFIXES):
            if path.with_name(path.name + suffix).is_file():
                return name + suffix
    return name


def _parse_number(meta: dict[str, Any], key: str, where: str, default: float | None = None) -> float:
    value = meta.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_MAGNITUDE:
        raise CaptureError(f"{where} {key} should be a finite number, not {value!r:.40}; correct it or export the file "
                           "again.")
    return float(value)


def _read_lens(meta: dict[str, Any], folder: Path, name: str, where: str) -> Lens:
    if "w" in meta or "h" in meta:
        width, height = int(_parse_number(meta, "w", where)), int(_parse_number(meta, "h", where))
    else:
        width, height = picture_size(safe_join(folder, name, CaptureError))
    if "fl_x" in meta:
        fx = _parse_number(meta, "fl_x", where)
    else:
        fx = _focal_length(_parse_number(meta, "camera_angle_x", where), width, where)
    if "fl_y" in meta:
        fy = _parse_number(meta, "fl_y", where)
    else:
        has_angle = "camera_angle_y" in meta
        fy = _focal_length(_parse_number(meta, "camera_angle_y", where), height, where) if has_angle else fx
    cx, cy = _parse_number(meta, "cx", where, width / 2), _parse_number(meta, "cy", where, height / 2)
    k1, k2, k3, k4, p1, p2 = (_parse_number(meta, key, where, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    kind = meta.get("camera_model", "OPENCV")
    if kind in ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE") or meta.get("is_fisheye"):
        # The fisheye polynomial with every coefficient.
        lens = Lens("THIN_PRISM_FISHEYE", (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, 0.0, 0.0), width, height)
    elif kind in ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"):
        if k4:
            raise CaptureError(f"{where} k4 of a {kind} camera has no agreed meaning; undistort the frames.")
        if any((k1, k2, k3, p1, p2)):
            lens = Lens("FULL_OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0), width, height)
        else:
            lens = Lens("PINHOLE", (fx, fy, cx, cy), width, height)
    else:
        raise CaptureError(f"{where} the camera model {kind!r} is not one this program reads; use OPENCV, "
                           "OPENCV_FISHEYE or PINHOLE, or a COLMAP model.")
    return check_lens(lens, where)


def _focal_length(angle: float, size: int, where: str) -> float:
    if not 0 < angle < math.pi:
        raise CaptureError(f"{where} a field of view of {angle:g} radians makes no sense; it lies between 0 and pi.")
    return 0.5 * size / math.tan(0.5 * angle)


def _parse_matrix(value: Any, where: str, what: str) -> Floats:
    """Parse (4, 4) from nested lists of 3 or 4 rows of 4 numbers. Raises CaptureError."""
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape not in ((3, 4), (4, 4)) or not (np.abs(matrix) < MAX_MAGNITUDE).all():
        raise CaptureError(f"{where} {what} should be 4 rows of 4 finite numbers of a sensible size; export the file "
                           "again.")
    full = np.eye(4)
    full[:len(matrix)] = matrix
    return full


def _read_pose(frame: dict[str, Any], where: str) -> Floats:
    """Return world_to_camera with OpenCV axes from camera_to_world with OpenGL axes. Raises CaptureError."""
    pose = _parse_matrix(frame.get("transform_matrix"), where, "transform_matrix")
    rotation = pose[:3, :3]
    if not is_rotation(rotation):
        raise CaptureError(f"{where} transform_matrix is not a rotation and a translation; export the file again.")
    left, _, right = np.linalg.svd(rotation)  # the nearest rotation: files round their numbers
    rotation = left @ right @ np.diag([1.0, -1.0, -1.0])
    inverse = np.eye(4)
    inverse[:3, :3] = rotation.T
    inverse[:3, 3] = -rotation.T @ pose[:3, 3]
    return inverse


def _read_points(folder: Path, meta: dict[str, Any]) -> PointCloud:
    name = meta.get("ply_file_path")
    if isinstance(name, str):
        path = safe_join(folder, Path(name).as_posix(), CaptureError)
        if not path.is_file():
            raise CaptureError(f"{path} is missing, which {folder / FILE} names as its points.")
        return read_points(path)
    model = find_model(folder, ("colmap/sparse/0",))
    if model is None:
        return PointCloud.empty()
    _, points = read_model(model)
    applied = _parse_matrix(meta.get("applied_transform", np.eye(4).tolist()), f"{folder / FILE}:", "applied_transform")
    moved = points.xyz.astype(np.float64) @ applied[:3, :3].T + applied[:3, 3]
    return PointCloud(moved.astype(np.float32), points.rgb, points.error)
