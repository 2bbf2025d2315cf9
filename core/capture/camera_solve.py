# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the camera solve of a capture, of whatever program, and matches its poses with the pictures on disk.

`Capture.open` calls `read_solve_in_steps`, then `match_frames_in_steps`; it makes its views of the result and passes
the warnings on.
"""
from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from ..errors import CaptureError
from ..system.file_names import canonical_name, natural_key
from ..system.files import safe_join
from ..system.steps import FRAMES_PER_STEP, Steps
from ..system.tally import list_first
from .colmap import PointCloud, PosedFrame, read_model_in_steps
from .frame_files import PictureIndex
from .layout import LATER_MODEL_PLACES, choose_model, find_deeper_model, find_models, frames_folder
from .transforms import FILE as TRANSFORMS
from .transforms import read_transforms, transforms_files

SAMPLED_POINTS, SAMPLED_VIEWS = 4000, 40
"""Approximate numbers of points and views by which the solve is checked."""
MIN_SHARE_IN_VIEW = 0.5
"""Share of the points before some camera below which points and cameras do not fit each other."""
MIN_FIELD_OF_VIEW, MAX_FIELD_OF_VIEW = 0.5, 170.0
"""Degrees along the longer side that lenses of frames have."""


@dataclass
class CameraSolve:
    """Poses and points of a capture, before their pictures are looked at.

    root: folder that the frames' names start from. masks: files by the frames' names. training, held_out: names of
    the frames that the solve itself lists for training and for evaluation; None without such lists. warnings: sentences
    for the user.
    """

    frames: list[PosedFrame]
    points: PointCloud
    root: Path
    masks: dict[str, Path] = field(default_factory=dict)
    training: set[str] | None = None
    held_out: set[str] | None = None
    warnings: list[str] = field(default_factory=list)


def read_solve_in_steps(folder: Path, *, required: bool = True) -> Steps[CameraSolve | None]:
    """Read a COLMAP model or a transforms.json, in natural order of the frames.

    Order of preference: a model in one of the usual places, transforms.json, a model below colmap/. Without any it
    raises CaptureError if a solve is `required`, and returns None otherwise.
    """
    models = find_models(folder)
    if not models and transforms_files(folder):
        read = read_transforms(folder)
        solve = CameraSolve(read.frames, read.points, folder, read.masks, read.training, read.held_out, read.warnings)
    else:
        model, choice_warning = choose_model(models or find_models(folder, LATER_MODEL_PLACES), folder)
        if model is None and not required:
            return None
        if model is None:
            deeper = find_deeper_model(folder)
            raise CaptureError(f"{folder} has no camera solve: neither sparse/0/cameras.bin (or .txt) nor "
                               f"{TRANSFORMS}; " + (
                                   "run solve first." if deeper is None else
                                   f"a model lies in {deeper}: name the folder that holds it and its images, such as "
                                   f"{deeper.parent}, or move it to {folder / 'sparse' / '0'}."))
        frames, points = yield from read_model_in_steps(model)
        root = frames_folder(folder, model)
        solve = CameraSolve(_with_relative_names(root, frames), points, root)
        solve.warnings += [choice_warning] if choice_warning else []
    solve.frames.sort(key=lambda frame: natural_key(frame.name))
    return solve


def _with_relative_names(root: Path, frames: list[PosedFrame]) -> list[PosedFrame]:
    """Return a model's frames with names that start from `root`, the folder of the frames.

    COLMAP's names start from the folder that it was started on: "images/1.png", "/data/shot/images/1.png" of another
    machine. Of the leading folders that all names share, the fewest are dropped with which some name leads to a
    picture. If no name ever does, the names stay as they are.
    """
    parts = [PurePosixPath(frame.name.replace("\\", "/")).parts for frame in frames]
    shared = 0
    while all(len(name_parts) > shared + 1 and name_parts[shared] == parts[0][shared] for name_parts in parts):
        shared += 1
    if not shared or not root.is_dir():
        return frames
    # Names stay as they are where one of them leads to a picture, by its own name or another form of it.
    is_below = parts[0][0] not in ("/", "..")
    if is_below and any(root.joinpath(*name_parts).exists() for name_parts in parts):
        return frames
    index = PictureIndex(root)
    if is_below and any(index.find(frame.name) for frame in frames):
        return frames
    for start in range(1, shared + 1):
        names = ["/".join(name_parts[start:]) for name_parts in parts]
        if any(index.find(name) for name in names):
            return [replace(frame, name=name) for frame, name in zip(frames, names, strict=True)]
    return frames


def check_single_poses(solve: CameraSolve, folder: Path) -> None:
    """Raise CaptureError, which names the folder of the capture, for a frame that has two poses."""
    names = [frame.name for frame in solve.frames]
    if len(set(names)) < len(names):
        duplicate = next(name for name in names if names.count(name) > 1)
        raise CaptureError(f"{folder}: the frame {duplicate} has two poses; remove one of them.")


@dataclass
class MatchedFrames:
    """The pictures of posed frames (`files`, by the frame's name in the solve), and what has no counterpart.

    missing: names of poses without a picture; unposed: names of pictures without a pose, below the folder of the
    frames. warnings: sentences for the user.
    """

    files: dict[str, Path]
    missing: list[str]
    unposed: list[str]
    warnings: list[str]


def match_frames_in_steps(solve: CameraSolve) -> Steps[MatchedFrames]:
    """Find the pictures of the posed frames, by other forms of their names too. Raises CaptureError for a name that
    leads out of the capture."""
    paths, files = {}, {}
    for number, frame in enumerate(solve.frames):
        if number % FRAMES_PER_STEP == 0:
            yield
        path = paths[frame.name] = safe_join(solve.root, frame.name, CaptureError)
        if path.exists() or path.is_symlink():
            files[frame.name] = path
    yield
    index = _index_pictures(solve.root, [path.parent for path in paths.values()])
    yield
    used = {path.relative_to(solve.root).as_posix() for path in files.values()}
    missing: list[str] = []
    renamed: list[str] = []
    for name in paths:  # the names without a picture of exactly that path
        if name in files:
            continue
        file = index.find(name)
        if file is None or file in used:
            missing.append(name)
            continue
        used.add(file)
        files[name] = safe_join(solve.root, file, CaptureError)
        if canonical_name(file) != canonical_name(name):
            renamed.append(f"{file} for {name}")
    unposed = [name for name in index.names if name not in used]
    return MatchedFrames(files, missing, unposed, _describe_matches(solve, files, missing, unposed, renamed))


def _index_pictures(root: Path, folders: list[Path]) -> PictureIndex:
    """Index the pictures below the folder of the frames; where names start from the capture, those of the frames'
    folders."""
    if root.name.casefold() == "images":
        return PictureIndex(root)
    return PictureIndex(root, list(dict.fromkeys(folders)))


def _describe_matches(solve: CameraSolve, files: dict[str, Path], missing: list[str], unposed: list[str],
                      renamed: list[str]) -> list[str]:
    """Return sentences for the user on frames without a pose, poses without a frame, and frames of another name.

    files: pictures by the frames' names. missing: names of poses without a picture. unposed: names of pictures without
    a pose. renamed: "file for name" of each picture whose name differs from that in the solve.
    """
    warnings = []
    if files and (missing or unposed):
        text = f"{len(files)} of {len(files) + len(unposed)} frames in {solve.root} have a pose"
        text += f", not {list_first(unposed)}" if unposed else ""
        text += f"; {len(missing)} poses have no frame: {list_first(missing)}" if missing else ""
        warnings.append(f"{text}. What has no counterpart is left out.")
    if renamed:
        warnings.append(f"{len(renamed)} frames have other names than in the camera solve: {list_first(renamed)}.")
    return warnings


def geometry_warnings(solve: CameraSolve) -> list[str]:
    """Return sentences for the user on points that no camera sees, and on impossible focal lengths."""
    return [*_point_warnings(solve), *_focal_length_warnings(solve)]


def _point_warnings(solve: CameraSolve) -> list[str]:
    """Return a warning if most sampled points are in no view, or behind the cameras; [] otherwise."""
    points = solve.points.xyz[::max(len(solve.points) // SAMPLED_POINTS, 1)].astype(np.float64)
    if not len(points):
        return []
    is_in_view = np.zeros(len(points), bool)
    shares_in_front = []
    for frame in solve.frames[::max(len(solve.frames) // SAMPLED_VIEWS, 1)]:
        local = points @ frame.world_to_camera[:3, :3].T + frame.world_to_camera[:3, 3]
        in_front = local[:, 2] > 0
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            # Twice the field of view: room for distortion and for a principal point off centre.
            plane = np.abs(local[:, :2] / local[:, 2:])
            max_plane = np.array([frame.lens.width, frame.lens.height]) / np.array(frame.lens.focal)
        is_in_view |= in_front & (plane <= max_plane).all(axis=1)
        shares_in_front.append(in_front.mean())
    share_in_view, share_in_front = float(is_in_view.mean()), float(np.mean(shares_in_front))
    if min(share_in_view, share_in_front) >= MIN_SHARE_IN_VIEW:
        return []
    return [f"Cameras and points do not fit each other: {100 * share_in_view:.0f} % of the points are in some view, "
            f"and a camera has {100 * share_in_front:.0f} % of them before it. Export both in one coordinate system "
            "(scale, axes, origin)."]


def _focal_length_warnings(solve: CameraSolve) -> list[str]:
    """Return a warning if a focal length gives a field of view that no lens has; [] otherwise."""
    impossible = []
    for frame in solve.frames:
        lens = frame.lens
        side, focal = max((lens.width, lens.focal[0]), (lens.height, lens.focal[1]))
        angle = 2 * float(np.degrees(np.arctan(0.5 * side / focal)))
        is_perspective = lens.model != "EQUIRECTANGULAR" and "FISHEYE" not in lens.model
        if is_perspective and not MIN_FIELD_OF_VIEW <= angle <= MAX_FIELD_OF_VIEW:
            impossible.append((frame.name, focal, angle))
    if not impossible:
        return []
    name, focal, angle = impossible[0]
    return [f"The focal length of {len(impossible)} of {len(solve.frames)} frames cannot be: {name} has {focal:.4g} "
            f"pixels, a field of view of {angle:.3g} degrees. Export it in pixels of the frames."]
