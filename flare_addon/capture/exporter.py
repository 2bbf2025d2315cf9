# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes a capture from Blender's own camera, solved by the motion tracker or animated in another way.

The capture has transforms.json with the camera of every frame, images/ with the frames, and points.ply with the
tracker's bundles and the vertices of the scene's meshes, from which the fit starts. The panel exports by
`export_capture`, the command `solve` by `blend_shot`.
"""
from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core.capture.camera import is_rotation
from ...core.capture.layout import find_model
from ...core.capture.transforms import FILE as TRANSFORMS
from ...core.errors import CaptureError
from ...core.images.picture import same_aspect
from ...core.images.size import picture_size
from ...core.system.files import atomic_path, read_json, remove_file, write_json
from .. import cameras
from ..paths import absolute, blend_relative

MAX_POINTS = 100_000
"""Most points of a cloud; a larger one is thinned to every second, third, ... point."""
MAKER = "Fit Flare"
"""The value of made_by in a transforms.json from here; only such a file is overwritten."""
_NUMBER = re.compile(r"(\d+)(?=\D*$)")


@dataclass(frozen=True)
class Footage:
    """A numbered sequence of pictures: the path of the first one, and the scene's frame that shows it."""

    first: Path
    frame: int

    def path(self, frame: int) -> Path:
        """Return the picture that a frame of the scene shows."""
        match = _NUMBER.search(self.first.stem)
        if match is None:
            return self.first
        number = f"{int(match[1]) + frame - self.frame:0{len(match[1])}d}"
        return self.first.with_name(self.first.stem[:match.start()] + number + self.first.stem[match.end():]
                                    + self.first.suffix)


def footage_of(camera: Any) -> Footage | None:
    """Return the image sequence behind a camera, from its background images or its movie clip; None without one."""
    for background in camera.data.background_images if camera.type == "CAMERA" else ():
        if background.source == "IMAGE" and background.image is not None and background.image.source == "SEQUENCE":
            user, path = background.image_user, absolute(background.image.filepath, background.image.library)
            match = _NUMBER.search(path.stem)
            # Blender shows file number frame - frame_start + 1 + frame_offset: solved for the frame of this file.
            start_frame = user.frame_start - user.frame_offset - 1 + int(match[1]) if match else user.frame_start
            return Footage(path, start_frame)
        if background.source == "MOVIE_CLIP" and background.clip is not None and background.clip.source == "SEQUENCE":
            return Footage(absolute(background.clip.filepath, background.clip.library),
                           background.clip.frame_start - background.clip.frame_offset)
    return None


def export_capture(scene: Any, folder: Path) -> int:
    """Write a capture of the scene's camera over its frame range, and set it as the scene's; return its number of
    frames.

    Raises CaptureError where pictures or points are missing, and for a folder with another capture or with pictures
    that would be overwritten.
    """
    camera = scene.camera
    footage = footage_of(camera) if camera is not None else None
    if footage is None:
        raise CaptureError("The camera has no background image sequence or movie clip to take the frames from.")
    pictures = {frame: footage.path(frame) for frame in range(scene.frame_start, scene.frame_end + 1)}
    pictures = {frame: path for frame, path in pictures.items() if path.is_file()}
    if len(pictures) < 3:
        raise CaptureError(f"Only {len(pictures)} of the frames in the scene's range have a picture beside "
                           f"{footage.first}; set the frame range to that of the footage.")
    current_frame, subframe = scene.frame_current, scene.frame_subframe
    try:
        entries = write_frames(scene, camera, pictures, folder)
    finally:
        scene.frame_set(current_frame, subframe=subframe)
    write_cameras(folder, entries)
    state = scene.fit_flare
    state.capture, state.root, state.mode, state.footage = blend_relative(folder), None, "estimated", "images"
    state.known_lights = ""  # lights of an earlier capture do not count, whatever their names
    return len(entries)


def write_frames(scene: Any, camera: Any, plates: Mapping[int, Path], folder: Path,
                 done: Callable[[], None] = lambda: None) -> list[dict[str, Any]]:
    """Write the pictures and points of a capture; return the frames of its transforms.json.

    transforms.json is written last, by `write_cameras`, since it marks a complete capture. The scene is left at the
    last frame. camera: None for the scene's camera in each frame. plates: the picture of each frame. done: called after
    each frame. Raises CaptureError where there are no points, or the folder or the plates cannot be used, and
    FrameError.
    """
    _check_free(folder, plates)
    _check_shape(scene, plates)
    points = scene_points(scene, camera or scene.camera)
    if not len(points):
        raise CaptureError("There are no points to start a fit from; solve the camera with the motion tracker, or "
                           "model the rough scene as a mesh.")
    entries = []
    for frame, path in sorted(plates.items()):
        scene.frame_set(frame)
        entries.append(write_frame(scene, camera or scene.camera, frame, path, folder))
        done()
    write_points(folder / "points.ply", points)
    return entries


def _check_free(folder: Path, plates: Mapping[int, Path]) -> None:
    """Raise CaptureError where the folder holds a capture from elsewhere, or other pictures would be overwritten.

    plates: the picture of each frame.
    """
    is_capture = (folder / TRANSFORMS).exists()
    transforms = read_json(folder / TRANSFORMS, CaptureError) if is_capture else {"made_by": MAKER}
    is_ours = isinstance(transforms, dict) and transforms.get("made_by") == MAKER
    if find_model(folder) is not None or not is_ours:
        raise CaptureError(f"{folder} holds another capture already; choose another folder.")
    for frame, plate in plates.items():
        picture = folder / _picture_path(frame, plate)
        if not picture.exists() or _is_copy(picture, plate):
            continue
        # Pictures of an earlier export may be replaced, but not by plates of the same folder.
        if not is_capture or plate.parent.resolve() == picture.parent.resolve():
            raise CaptureError(f"{picture} exists already and would be replaced by {plate}; choose another folder.")


def _check_shape(scene: Any, plates: Mapping[int, Path]) -> None:
    """Raise CaptureError for a plate whose aspect ratio differs from the render's, and FrameError for an unreadable
    one."""
    rendered = cameras.render_size(scene.render)
    for plate in plates.values():
        size = picture_size(plate)
        if not same_aspect(size, rendered):
            raise CaptureError(f"{plate} is {size[0]} x {size[1]} pixels and the scene renders {rendered[0]} x "
                               f"{rendered[1]}, which is another aspect ratio; set the scene's resolution to that of "
                               "the pictures.")


def write_cameras(folder: Path, entries: list[dict[str, Any]]) -> None:
    """Write transforms.json with frames from `write_frame`."""
    write_json(folder / TRANSFORMS,
               {"made_by": MAKER, "camera_model": "PINHOLE", "ply_file_path": "points.ply", "frames": entries})


def write_frame(scene: Any, camera: Any, frame: int, plate: Path, folder: Path) -> dict[str, Any]:
    """Link or copy the picture of a frame into the capture; return the frame's entry for transforms.json.

    The scene must be at this frame. plate: the picture. folder: the capture's. Raises CaptureError for a camera that
    is mirrored or skewed.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    evaluated = camera.evaluated_get(depsgraph)
    core_camera = cameras.core_camera(evaluated.data, evaluated.matrix_world, scene.render)
    pose = _camera_pose(evaluated, frame)
    name = _picture_path(frame, plate)
    target = folder / name
    target.parent.mkdir(parents=True, exist_ok=True)
    if not _is_copy(target, plate):
        remove_file(target)  # not overwritten in place, since it may be a hard link to an earlier plate
        try:
            os.link(plate.resolve(), target)  # resolved, since Linux would link a symbolic link itself
        except OSError:  # another disk, or a file system without links
            shutil.copy2(plate, target)
    return {"file_path": name, "w": core_camera.width, "h": core_camera.height,
            "fl_x": core_camera.fx, "fl_y": core_camera.fy, "cx": core_camera.cx, "cy": core_camera.cy,
            **lens_distortion(camera, plate), "transform_matrix": pose.tolist()}


def _camera_pose(camera: Any, frame: int) -> cameras.Floats:
    """Return camera_to_world (4, 4) of an evaluated camera in Blender's axes.

    Raises CaptureError for a mirrored one.
    """
    pose = cameras.camera_to_world(camera.matrix_world) @ cameras.FLIP_YZ
    if not is_rotation(pose[:3, :3]):
        raise CaptureError(f"The camera {camera.name!r} is mirrored or skewed at frame {frame}; apply the scale of it "
                           "and of its parents.")
    return pose


def _picture_path(frame: int, plate: Path) -> str:
    """Return the path of a frame's picture inside the capture."""
    return f"images/{frame:06d}{plate.suffix.lower()}"


def _is_copy(target: Path, path: Path) -> bool:
    """Return whether a capture's picture is the plate itself or an unchanged copy of it."""
    if not target.exists():
        return False
    copied, plate = target.stat(), path.stat()
    return target.samefile(path) or (copied.st_size, copied.st_mtime) == (plate.st_size, plate.st_mtime)


_UNSUPPORTED_DISTORTION = {"DIVISION": ("division_k1", "division_k2"), "NUKE": ("nuke_k1", "nuke_k2"),
                           "BROWN": ("brown_k1", "brown_k2", "brown_k3", "brown_k4", "brown_p1", "brown_p2")}
"""The coefficients of the tracker's distortion models other than Polynomial."""


def lens_distortion(camera: Any, path: Path) -> dict[str, float]:
    """Return the distortion coefficients k1, k2, k3 from the motion tracker, for a picture in the folder of the clip.

    {} without distortion, and for other pictures, which count as undistorted. Raises CaptureError for a distortion
    model other than Polynomial, which transforms.json cannot represent.
    """
    for background in camera.data.background_images:
        clip = background.clip if background.source == "MOVIE_CLIP" else None
        if clip is None or absolute(clip.filepath, clip.library).parent.resolve() != path.parent.resolve():
            continue
        lens = clip.tracking.camera
        if lens.distortion_model == "POLYNOMIAL":
            coefficients = {name: float(getattr(lens, name)) for name in ("k1", "k2", "k3")}
            return coefficients if any(coefficients.values()) else {}
        if any(getattr(lens, name, 0) for name in _UNSUPPORTED_DISTORTION.get(lens.distortion_model, ())):
            raise CaptureError(f"The lens of the clip {clip.name!r} is distorted by the model {lens.distortion_model}; "
                               "solve it with the model Polynomial, or give undistorted frames.")
    return {}


def bundle_matrix(camera: Any) -> Any:
    """Return the matrix from the space of a clip's solved points to the world; None for the world itself.

    With the solver's constraint on the camera, the points follow the transform of the camera object, which Set Origin
    and Set Scale change.
    """
    parent = camera.parent.matrix_world if camera.parent else None
    if not any(constraint.type == "CAMERA_SOLVER" and not constraint.mute for constraint in camera.constraints):
        return parent
    return camera.matrix_basis if parent is None else parent @ camera.matrix_parent_inverse @ camera.matrix_basis


def scene_points(scene: Any, camera: Any) -> np.ndarray[Any, Any]:
    """Return the points (n, 3) of the clip's solved tracks and of the scene's meshes, in Blender's world.

    Of more than MAX_POINTS, every second, third, ... point is returned.
    """
    clouds: list[np.ndarray[Any, Any]] = []
    for background in camera.data.background_images:
        if background.source == "MOVIE_CLIP" and background.clip is not None:
            bundles = [list(track.bundle) for track in background.clip.tracking.tracks if track.has_bundle]
            if bundles:
                clouds.append(_transform(np.array(bundles), bundle_matrix(camera)))
    for item in scene.objects:
        if item.type == "MESH" and len(item.data.vertices):
            flat = np.empty(3 * len(item.data.vertices), np.float32)
            item.data.vertices.foreach_get("co", flat)
            clouds.append(_transform(flat.reshape(-1, 3), item.matrix_world))
    all_points = np.concatenate(clouds) if clouds else np.zeros((0, 3))
    return all_points[:: max(-(-len(all_points) // MAX_POINTS), 1)]


def _transform(points: np.ndarray[Any, Any], matrix: Any) -> np.ndarray[Any, Any]:
    """Transform points (n, 3) by a matrix (4, 4); None is the identity."""
    if matrix is None:
        return points
    values = np.array([list(row) for row in matrix])
    return np.asarray(points @ values[:3, :3].T + values[:3, 3])


def write_points(path: Path, points: np.ndarray[Any, Any]) -> None:
    """Write points (n, 3) as a PLY."""
    head = (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
            "property float x\nproperty float y\nproperty float z\nend_header\n")
    with atomic_path(path) as temporary:
        temporary.write_bytes(head.encode() + np.ascontiguousarray(points, "<f4").tobytes())
