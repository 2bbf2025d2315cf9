# SPDX-License-Identifier: GPL-3.0-or-later
"""A capture made of Blender's own camera: solved by the motion tracker, or animated in any other way.

transforms.json with the camera of every frame, images/ with the frames, points.ply with the tracker's
bundles and the vertices of the scene's meshes, which the fit begins from.
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
from ...core.capture.colmap import find_model
from ...core.capture.transforms import FILE as TRANSFORMS
from ...core.errors import CaptureError
from ...core.images.picture import are_one_shape
from ...core.images.size import picture_size
from ...core.system.files import atomic_path, read_json, remove_file, write_json
from .. import cameras
from ..paths import absolute, stored

MOST_POINTS = 100_000
MAKER = "Fit Flare"
"""What transforms.json that was made here says; that one may be written again."""
_NUMBER = re.compile(r"(\d+)(?=\D*$)")


@dataclass(frozen=True)
class Footage:
    """A numbered sequence of pictures: the first one's path, and the scene's frame that shows it."""

    first: Path
    frame: int

    def path(self, frame: int) -> Path:
        """The picture that the scene's frame shows."""
        match = _NUMBER.search(self.first.stem)
        if match is None:
            return self.first
        number = f"{int(match[1]) + frame - self.frame:0{len(match[1])}d}"
        return self.first.with_name(self.first.stem[:match.start()] + number + self.first.stem[match.end():]
                                    + self.first.suffix)


def footage_of(camera: Any) -> Footage | None:
    """The image sequence behind a camera: of its background images, or of the movie clip there."""
    for back in camera.data.background_images if camera.type == "CAMERA" else ():
        if back.source == "IMAGE" and back.image is not None and back.image.source == "SEQUENCE":
            user, path = back.image_user, absolute(back.image.filepath, back.image.library)
            match = _NUMBER.search(path.stem)
            shown = user.frame_start - user.frame_offset - 1 + int(match[1]) if match else user.frame_start
            # The sequence shows file number `frame - frame_start + 1 + frame_offset`.
            return Footage(path, shown)
        if back.source == "MOVIE_CLIP" and back.clip is not None and back.clip.source == "SEQUENCE":
            return Footage(absolute(back.clip.filepath, back.clip.library),
                           back.clip.frame_start - back.clip.frame_offset)
    return None


def export(scene: Any, folder: Path) -> int:
    """Write a capture of the scene's camera over the scene's frames, and make it the scene's; how many frames.

    Raises CaptureError where a frame's picture is missing or there is nothing to start a fit from, and for a folder
    with another capture, or pictures that would be lost.
    """
    camera = scene.camera
    footage = footage_of(camera) if camera is not None else None
    if footage is None:
        raise CaptureError("The camera has no background image sequence or movie clip to take the frames from.")
    pictures = {frame: footage.path(frame) for frame in range(scene.frame_start, scene.frame_end + 1)}
    pictures = {frame: path for frame, path in pictures.items() if path.is_file()}
    if len(pictures) < 3:
        raise CaptureError(f"Of the frames that the camera shows, {len(pictures)} are there as pictures beside "
                           f"{footage.first}; set the scene's frame range to the footage.")
    before = scene.frame_current
    try:
        entries = write_frames(scene, camera, pictures, folder)
    finally:
        scene.frame_set(before)
    write_cameras(folder, entries)
    state = scene.fit_flare
    state.capture, state.root, state.mode, state.footage = stored(folder), None, "estimated", "images"
    state.known_lights = ""  # those of an earlier capture are other lights, whatever their names
    return len(entries)


def write_frames(scene: Any, camera: Any, plates: Mapping[int, Path], folder: Path,
                 done: Callable[[], None] = lambda: None) -> list[dict[str, Any]]:
    """A capture but for transforms.json, which says that it is whole: its pictures and points; what that is to have of
    the frames. The scene is at the last of them then.

    camera: None for the one that the scene has in each frame. plates: the picture of each. Raises CaptureError where
    there is nothing to begin a fit from, or the plates cannot be a capture's in this folder, and FrameError.
    """
    _check_free(folder, plates)
    _check_shape(scene, plates)
    points = points_of(scene, camera or scene.camera)
    if not len(points):
        raise CaptureError("There are no points to begin a fit from; solve the camera with the motion tracker, or "
                           "model the rough scene as a mesh.")
    entries = []
    for frame, path in sorted(plates.items()):
        scene.frame_set(frame)
        entries.append(entry_of(scene, camera or scene.camera, frame, path, folder))
        done()
    write_points(folder / "points.ply", points)
    return entries


def _check_free(folder: Path, plates: Mapping[int, Path]) -> None:
    """Raises CaptureError for a folder with a capture that was not made here: its frames would be lost, or its solve
    be read in place of what is written; and where pictures that are no capture's, or the plates themselves under
    other numbers, would be replaced. plates: the picture of each frame."""
    is_capture = (folder / TRANSFORMS).exists()
    known = read_json(folder / TRANSFORMS, CaptureError) if is_capture else {"made_by": MAKER}
    ours = isinstance(known, dict) and known.get("made_by") == MAKER
    if find_model(folder) is not None or not ours:
        raise CaptureError(f"{folder} holds another capture already; choose another folder.")
    for frame, plate in plates.items():
        picture = folder / _picture(frame, plate)
        if not picture.exists() or _is_copy(picture, plate):
            continue
        if not is_capture or plate.parent.resolve() == picture.parent.resolve():
            raise CaptureError(f"{picture} is there already and would be replaced by {plate}; choose another folder.")


def _check_shape(scene: Any, plates: Mapping[int, Path]) -> None:
    """Raises CaptureError for a plate of another shape than is rendered, which no fit would take, and FrameError for
    one that is no picture."""
    rendered = cameras.render_size(scene.render)
    for plate in plates.values():
        size = picture_size(plate)
        if not are_one_shape(size, rendered):
            raise CaptureError(f"{plate} is {size[0]} x {size[1]} pixels and the scene renders {rendered[0]} x "
                               f"{rendered[1]}, which is another shape; set the scene's resolution to that of the "
                               "pictures.")


def write_cameras(folder: Path, entries: list[dict[str, Any]]) -> None:
    """transforms.json of frames as `entry_of` gives them, beside points.ply."""
    write_json(folder / TRANSFORMS,
               {"made_by": MAKER, "camera_model": "PINHOLE", "ply_file_path": "points.ply", "frames": entries})


def entry_of(scene: Any, camera: Any, frame: int, path: Path, folder: Path) -> dict[str, Any]:
    """A frame of transforms.json; its picture is linked or copied into the capture. Raises CaptureError for a camera
    that is mirrored or skewed."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    evaluated = camera.evaluated_get(depsgraph)
    core = cameras.core_camera(evaluated.data, evaluated.matrix_world, scene.render)
    pose = _pose_of(evaluated, frame)
    name = _picture(frame, path)
    target = folder / name
    target.parent.mkdir(parents=True, exist_ok=True)
    if not _is_copy(target, path):
        remove_file(target)  # not written into: it may be linked to an earlier plate
        try:
            os.link(path.resolve(), target)  # of a symbolic link Linux would link that, to where it leads from here
        except OSError:  # another disk, or a file system without links
            shutil.copy2(path, target)
    return {"file_path": name, "w": core.width, "h": core.height, "fl_x": core.fx, "fl_y": core.fy, "cx": core.cx,
            "cy": core.cy, **distortion_of(camera, path), "transform_matrix": pose.tolist()}


def _pose_of(camera: Any, frame: int) -> cameras.Floats:
    """camera_to_world (4, 4) of an evaluated camera in Blender's axes. Raises CaptureError where it is no rotation."""
    pose = cameras.camera_to_world(camera.matrix_world) @ cameras.FLIP
    if not is_rotation(pose[:3, :3]):
        raise CaptureError(f"The camera {camera.name!r} is mirrored or skewed at frame {frame}; apply the scale of it "
                           "and of its parents.")
    return pose


def _picture(frame: int, plate: Path) -> str:
    """A frame's picture in the capture."""
    return f"images/{frame:06d}{plate.suffix.lower()}"


def _is_copy(target: Path, path: Path) -> bool:
    """Whether a capture's picture is the plate, or a copy of it as it is now."""
    if not target.exists():
        return False
    copied, plate = target.stat(), path.stat()
    return target.samefile(path) or (copied.st_size, copied.st_mtime) == (plate.st_size, plate.st_mtime)


_OTHER_DISTORTION = {"DIVISION": ("division_k1", "division_k2"), "NUKE": ("nuke_k1", "nuke_k2"),
                     "BROWN": ("brown_k1", "brown_k2", "brown_k3", "brown_k4", "brown_p1", "brown_p2")}
"""Coefficients of the tracker's models that are not Polynomial."""


def distortion_of(camera: Any, path: Path) -> dict[str, float]:
    """What the motion tracker found of a lens's distortion, for a picture of the clip itself; {} for none, and for
    pictures from elsewhere, which are taken for straight.

    Raises CaptureError for distortion of another model than Polynomial, which transforms.json has no words for.
    """
    for back in camera.data.background_images:
        clip = back.clip if back.source == "MOVIE_CLIP" else None
        if clip is None or absolute(clip.filepath, clip.library).parent.resolve() != path.parent.resolve():
            continue
        lens = clip.tracking.camera
        if lens.distortion_model == "POLYNOMIAL":
            found = {name: float(getattr(lens, name)) for name in ("k1", "k2", "k3")}
            return found if any(found.values()) else {}
        if any(getattr(lens, name, 0) for name in _OTHER_DISTORTION.get(lens.distortion_model, ())):
            raise CaptureError(f"The lens of the clip {clip.name!r} is distorted by the model {lens.distortion_model}; "
                               "solve it with the model Polynomial, or give undistorted frames.")
    return {}


def space_of_bundles(camera: Any) -> Any:
    """The matrix from the space of a clip's solved points to the world; None for the world itself. With the solver's
    constraint on the camera they move with the camera object's own transform, which Set Origin and Set Scale write."""
    parent = camera.parent.matrix_world if camera.parent else None
    if not any(one.type == "CAMERA_SOLVER" and not one.mute for one in camera.constraints):
        return parent
    return camera.matrix_basis if parent is None else parent @ camera.matrix_parent_inverse @ camera.matrix_basis


def points_of(scene: Any, camera: Any) -> np.ndarray[Any, Any]:
    """(n, 3) of the clip's solved tracks and of the scene's meshes, in Blender's world."""
    found: list[np.ndarray[Any, Any]] = []
    for back in camera.data.background_images:
        if back.source == "MOVIE_CLIP" and back.clip is not None:
            bundles = [list(track.bundle) for track in back.clip.tracking.tracks if track.has_bundle]
            if bundles:
                found.append(_moved(np.array(bundles), space_of_bundles(camera)))
    for item in scene.objects:
        if item.type == "MESH" and len(item.data.vertices):
            flat = np.empty(3 * len(item.data.vertices), np.float32)
            item.data.vertices.foreach_get("co", flat)
            found.append(_moved(flat.reshape(-1, 3), item.matrix_world))
    every = np.concatenate(found) if found else np.zeros((0, 3))
    return every[:: max(len(every) // MOST_POINTS, 1)]


def _moved(points: np.ndarray[Any, Any], matrix: Any) -> np.ndarray[Any, Any]:
    if matrix is None:
        return points
    values = np.array([list(row) for row in matrix])
    return np.asarray(points @ values[:3, :3].T + values[:3, 3])


def write_points(path: Path, points: np.ndarray[Any, Any]) -> None:
    """Points (n, 3) as a PLY."""
    head = (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
            "property float x\nproperty float y\nproperty float z\nend_header\n")
    with atomic_path(path) as temporary:
        temporary.write_bytes(head.encode() + np.ascontiguousarray(points, "<f4").tobytes())
