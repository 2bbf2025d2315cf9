# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads `transforms.json` as nerfstudio, instant-ngp, BlenderNeRF and Polycam's exporters write it, and the pairs
`transforms_train.json`, `transforms_test.json` of NeRF's synthetic scenes.

Poses are camera to world with OpenGL axes (x right, y up, z backward). `applied_transform` and `applied_scale` are
already in the poses, so the world of the file is the world of the capture. The point cloud of `ply_file_path` is in
that world too; points of a COLMAP model beside it still need both.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CaptureError
from ..images.listing import SUFFIXES
from ..images.size import picture_size
from ..system.file_names import canonical_name, find_entry, name_below
from ..system.files import read_json, safe_join
from .camera import Floats, is_rotation
from .colmap import MAX_MAGNITUDE, PointCloud, PosedFrame, check_lens, read_model
from .layout import LATER_MODEL_PLACES, choose_model, find_models
from .lens import Lens
from .ply import GREY, read_points

FILE = "transforms.json"
PARTS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
"""Files of NeRF's synthetic scenes and of BlenderNeRF; all but the first list frames to hold out."""
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Names of a lens's coefficients, in the order of `distortion_params`."""
OLD_APPLIED_TRANSFORM = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
"""What nerfstudio applied to poses before it wrote `applied_transform`."""
MAX_MISMATCH = 0.01
"""Distance between two places for one camera, relative to the cameras' extent, up to which they count as the same."""
_EQUIVALENT_KEYS = ((("fl_x",), ("camera_angle_x",)), (("fl_y",), ("camera_angle_y",)),
                    (DISTORTION, ("distortion_params",)))
"""Keys that say one thing in two forms."""


@dataclass
class Transforms:
    """Poses and points of a capture with transforms.json; the names are paths below its folder.

    masks: files of the frames' masks, by the frames' names. training, held_out: names of the frames that the file
    lists for training and for evaluation; None without such a list. warnings: sentences for the user.
    """

    frames: list[PosedFrame]
    points: PointCloud
    masks: dict[str, Path] = field(default_factory=dict)
    training: set[str] | None = None
    held_out: set[str] | None = None
    warnings: list[str] = field(default_factory=list)


def transforms_files(folder: Path) -> list[Path]:
    """Return the transforms.json of a capture, else the files of its parts; none where it has neither."""
    single_file = find_entry(folder, FILE)
    if single_file is not None:
        return [single_file]
    return [path for name in PARTS if (path := find_entry(folder, name)) is not None]


def read_transforms(folder: Path) -> Transforms:
    """Read poses, points, masks and lists of a capture.

    Raises CaptureError, naming the file and the frame, where something is missing or invalid.
    """
    result = Transforms([], PointCloud.empty())
    lenses: dict[tuple[object, ...], Lens] = {}  # one object for frames of one lens: its maps are shared
    files = transforms_files(folder)
    for path in files:
        meta = read_json(path, CaptureError)
        frames = meta.get("frames") if isinstance(meta, dict) else None
        if not isinstance(frames, list) or not (frames or len(files) > 1):
            raise CaptureError(f"{path} holds no frames; export it again.")
        names = [_read_frame(path, number, meta, frame, lenses, result) for number, frame in enumerate(frames)]
        if len(files) > 1 and path.name.casefold() != PARTS[0]:
            result.held_out = (result.held_out or set()) | set(names)
        else:
            _read_split_lists(path, meta, result)
        if not len(result.points):
            result.points = _read_points(path, meta, result)
    if not result.frames:
        raise CaptureError(f"{files[0]} holds no frames; export it again.")
    return result


def _read_frame(path: Path, number: int, meta: dict[str, Any], frame: Any, lenses: dict[tuple[object, ...], Lens],
                result: Transforms) -> str:
    """Read a frame's lens, pose and mask into `result`; return its name.

    number: index of the frame in the file, for messages. meta: the whole file. lenses: the lenses so far, by their
    values; an equal one is shared, a new one is added.
    """
    name = frame.get("file_path") if isinstance(frame, dict) else None
    if not isinstance(name, str):
        raise CaptureError(f"{path}, frame {number}: file_path is missing; export it again.")
    where = f"{path}, {name}:"
    name = _with_suffix(path.parent, name)
    lens = _read_lens(_merge_lens_values(meta, frame), path.parent, name, where)
    lens = lenses.setdefault((lens.model, lens.params, lens.width, lens.height), lens)
    result.frames.append(PosedFrame(name, lens, _read_pose(frame, where)))
    mask = frame.get("mask_path")
    if isinstance(mask, str):
        file = safe_join(path.parent, name_below(path.parent, mask), CaptureError)
        mask_file = find_entry(path.parent, file.relative_to(path.parent).as_posix())
        if mask_file is None or not mask_file.is_file():
            raise CaptureError(f"{where} its mask {file} is missing; put it there, or remove mask_path.")
        result.masks[name] = mask_file
    return name


def _merge_lens_values(meta: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a frame's lens: its own, else those of the file.

    A frame's value also replaces the file's value of the same quantity in another form: camera_angle_x replaces fl_x,
    distortion_params replaces k1, k2, ...
    """
    shared = dict(meta)
    for forms in _EQUIVALENT_KEYS:
        if any(key in frame for form in forms for key in form):
            shared = {key: value for key, value in shared.items() if not any(key in form for form in forms)}
    return {**shared, **frame}


def _read_split_lists(path: Path, meta: dict[str, Any], result: Transforms) -> None:
    """Read nerfstudio's lists of training and held-out frames of `meta` into `result`, which has the frames.

    Validation frames are held out too. Raises CaptureError.
    """
    lists: dict[str, set[str]] = {}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = meta.get(key)
        if names is None:
            continue
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise CaptureError(f"{path}: {key} should be a list of names of frames; correct it or export the file "
                               "again.")
        lists[key] = {_with_suffix(path.parent, name) for name in names}
    name_by_canonical = {canonical_name(frame.name): frame.name for frame in result.frames}
    for key, names in lists.items():
        if unknown := sorted(name for name in names if canonical_name(name) not in name_by_canonical):
            raise CaptureError(f"{path}: {key} names {unknown[0]}, which is not a frame of the file; correct it or "
                               "export the file again.")
    frames_by_list = {key: {name_by_canonical[canonical_name(name)] for name in names} for key, names in lists.items()}
    result.training = frames_by_list.get("train_filenames")
    if "val_filenames" in frames_by_list or "test_filenames" in frames_by_list:
        result.held_out = frames_by_list.get("val_filenames", set()) | frames_by_list.get("test_filenames", set())


def _with_suffix(folder: Path, name: str) -> str:
    """Return the path of a frame below the folder, with the suffix of its picture where the file leaves it out, as in
    NeRF's synthetic scenes."""
    name = Path(name_below(folder, name).replace("\\", "/")).as_posix()  # drops a leading "./"
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
    """Read the lens of the frame `name` from the values of its file. Raises CaptureError, with `where` in front."""
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
    k1, k2, k3, k4, p1, p2 = _read_distortion(meta, where)
    model = meta.get("camera_model", "OPENCV")
    if model in ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE") or meta.get("is_fisheye"):
        # The fisheye polynomial with every coefficient.
        lens = Lens("THIN_PRISM_FISHEYE", (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, 0.0, 0.0), width, height)
    elif model in ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"):
        if k4:
            raise CaptureError(f"{where} k4 of a {model} camera has no agreed meaning; undistort the frames.")
        if any((k1, k2, k3, p1, p2)):
            lens = Lens("FULL_OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0), width, height)
        else:
            lens = Lens("PINHOLE", (fx, fy, cx, cy), width, height)
    else:
        raise CaptureError(f"{where} the camera model {model!r} is not one this program reads; use OPENCV, "
                           "OPENCV_FISHEYE or PINHOLE, or a COLMAP model.")
    return check_lens(lens, where)


def _read_distortion(meta: dict[str, Any], where: str) -> list[float]:
    """Return k1 k2 k3 k4 p1 p2, from one list in this order or from single values."""
    values = meta.get("distortion_params")
    if values is None:
        return [_parse_number(meta, key, where, 0.0) for key in DISTORTION]
    if not isinstance(values, list) or not len(values) <= len(DISTORTION):
        raise CaptureError(f"{where} distortion_params should be the six numbers k1 k2 k3 k4 p1 p2; correct it or "
                           "export the file again.")
    values = [*values, *[0.0] * (len(DISTORTION) - len(values))]
    return [_parse_number({"distortion_params": value}, "distortion_params", where) for value in values]


def _focal_length(angle: float, size: int, where: str) -> float:
    if not 0 < angle < math.pi:
        raise CaptureError(f"{where} a field of view of {angle:g} radians makes no sense; it lies between 0 and pi.")
    return 0.5 * size / math.tan(0.5 * angle)


def _parse_matrix(value: Any, where: str, label: str) -> Floats:
    """Parse (4, 4) from nested lists of 3 or 4 rows of 4 numbers.

    Raises CaptureError, whose message begins with `where` and names the value as `label`.
    """
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape not in ((3, 4), (4, 4)) or not (np.abs(matrix) < MAX_MAGNITUDE).all():
        raise CaptureError(f"{where} {label} should be 4 rows of 4 finite numbers of a sensible size; export the file "
                           "again.")
    pose = np.eye(4)
    pose[:len(matrix)] = matrix
    return pose


def _read_pose(frame: dict[str, Any], where: str) -> Floats:
    """Return world_to_camera with OpenCV axes from camera_to_world with OpenGL axes. Raises CaptureError."""
    pose = _parse_matrix(frame.get("transform_matrix"), where, "transform_matrix")
    rotation = pose[:3, :3]
    if not is_rotation(rotation):
        raise CaptureError(f"{where} transform_matrix is not a rotation and a translation; export the file again.")
    u, _, vt = np.linalg.svd(rotation)  # the nearest rotation: files round their numbers
    rotation = u @ vt @ np.diag([1.0, -1.0, -1.0])
    inverse = np.eye(4)
    inverse[:3, :3] = rotation.T
    inverse[:3, 3] = -rotation.T @ pose[:3, 3]
    return inverse


def _read_points(path: Path, meta: dict[str, Any], result: Transforms) -> PointCloud:
    """Return the points that a transforms.json names, else those of a COLMAP model beside it, moved to the
    file's world. Adds warnings to `result`."""
    folder, name = path.parent, meta.get("ply_file_path")
    if isinstance(name, str):
        file = safe_join(folder, Path(name_below(folder, name)).as_posix(), CaptureError)
        cloud_file = find_entry(folder, file.relative_to(folder).as_posix())
        if cloud_file is None or not cloud_file.is_file():
            raise CaptureError(f"{file} is missing, which {path} names as its points.")
        cloud = read_points(cloud_file)
        if len(cloud) and (cloud.rgb == GREY).all():
            result.warnings.append(f"The points of {cloud_file} have no colours, so they start grey.")
        return cloud
    model, choice_warning = choose_model(find_models(folder, LATER_MODEL_PLACES), folder)
    if model is None:
        return PointCloud.empty()
    posed, points = read_model(model)
    result.warnings += [choice_warning] if choice_warning else []
    to_world = _read_applied_transform(path, meta)
    from_cameras = _fit_similarity(posed, result.frames)
    if from_cameras is not None and not _move_alike(to_world, from_cameras, points.xyz):
        result.warnings.append(f"The points of {model} are moved as their cameras are in {path.name}: "
                               + ("applied_transform and applied_scale say otherwise." if "applied_transform" in meta
                                   else "it has no applied_transform."))
        to_world = from_cameras
    xyz = points.xyz.astype(np.float64) @ to_world[:3, :3].T + to_world[:3, 3]
    return PointCloud(xyz.astype(np.float32), points.rgb, points.error)


def _read_applied_transform(path: Path, meta: dict[str, Any]) -> Floats:
    """Return (4, 4): nerfstudio's motion and scale from the world of its COLMAP model to that of the file."""
    applied = _parse_matrix(meta.get("applied_transform", OLD_APPLIED_TRANSFORM), f"{path}:", "applied_transform")
    scale = _parse_number(meta, "applied_scale", f"{path}:", 1.0)
    if scale <= 0:
        raise CaptureError(f"{path}: applied_scale should be above 0, not {scale:g}; export the file again.")
    return np.diag([scale, scale, scale, 1.0]) @ applied


def _fit_similarity(model: Sequence[PosedFrame], frames: Sequence[PosedFrame]) -> Floats | None:
    """Return (4, 4), the similarity from the cameras of a COLMAP model to the cameras of the same names in the file.

    None where fewer than three share a name, where all lie in one place, or where they do not match within
    MAX_MISMATCH of their extent.
    """
    model_frames = {PurePosixPath(canonical_name(frame.name)).name: frame for frame in model}
    pairs = [(model_frames[name], frame) for frame in frames
             if (name := PurePosixPath(canonical_name(frame.name)).name) in model_frames]
    if len(pairs) < 3:
        return None
    # Each pair gives the rotation between the worlds; the nearest rotation to their mean is taken.
    rotations = np.array([in_file.world_to_camera[:3, :3].T @ in_model.world_to_camera[:3, :3]
                          for in_model, in_file in pairs])
    u, _, vt = np.linalg.svd(rotations.mean(axis=0))
    rotation = u @ vt
    model_centres, file_centres = (
        np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in (frame.world_to_camera for frame in side_frames)])
        for side_frames in zip(*pairs, strict=True))
    model_mean, file_mean = model_centres.mean(axis=0), file_centres.mean(axis=0)
    centred, target_centred = (model_centres - model_mean) @ rotation.T, file_centres - file_mean
    # Sums of squares: the scale is that of least squares, and the mismatch is compared as a square.
    centred_square, target_square = float(np.square(centred).sum()), float(np.square(target_centred).sum())
    scale = float((centred * target_centred).sum()) / centred_square if centred_square > 0 else 0.0
    if scale <= 0 or np.square(scale * centred - target_centred).sum() > MAX_MISMATCH**2 * target_square:
        return None
    similarity = np.eye(4)
    similarity[:3, :3] = scale * rotation
    similarity[:3, 3] = file_mean - scale * rotation @ model_mean
    return similarity


def _move_alike(first: Floats, second: Floats, xyz: NDArray[np.float32]) -> bool:
    """Return whether two similarities (4, 4) move points (n, 3) to the same places, within 2 MAX_MISMATCH of their
    extent."""
    sampled = xyz[::max(len(xyz) // 1000, 1)].astype(np.float64)
    if not len(sampled):
        return True
    results = [sampled @ motion[:3, :3].T + motion[:3, 3] for motion in (first, second)]
    extent = float(np.median(np.linalg.norm(results[1] - results[1].mean(axis=0), axis=1)))
    return float(np.median(np.linalg.norm(results[0] - results[1], axis=1))) <= 2 * MAX_MISMATCH * max(extent, 1e-12)
