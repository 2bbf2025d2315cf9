# SPDX-License-Identifier: GPL-3.0-or-later
"""A capture: frames, cameras, points and lights of one place, in one folder.

    images/           frames as filmed
    sparse/0/         COLMAP model, binary or text (or transforms.json); `layout` lists the other places
    lights.json       {"lights": [{"name": "lamp", "xyz": [x, y, z]}]}, or paths (`lights.py`); optional
    removed/          clean frames, same names; optional
    masks/            black where frames must not be learned from; optional
    split.json        {"test": ["0003.png", ...]}; optional
    truth/scene/, truth/flare/    exact layers where they are known; optional

A shot whose cameras are not solved has no model (`unsolved.py`): one camera serves all its frames.
Opening checks names, sizes and numbers by headers alone; pixels are decoded on demand. Distorted frames, and the
pictures that belong to them, are undistorted to the pinhole camera of their view.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..colour import ColourSpace
from ..errors import CaptureError, FrameError
from ..images.formats.exif import SWAPS_SIDES
from ..images.picture import Picture, same_aspect
from ..images.read import has_float_pixels, read_picture
from ..images.size import picture_size
from ..system.file_names import canonical_name, find_entry
from ..system.files import read_json, safe_join
from ..system.steps import FRAMES_PER_STEP, Steps, finish
from .camera import Camera, Floats
from .camera_solve import (
    CameraSolve,
    check_single_poses,
    geometry_warnings,
    match_frames_in_steps,
    read_solve_in_steps,
)
from .colmap import PointCloud, PosedFrame
from .frame_files import mask_pictures, matching_pictures, view_name
from .frame_sizes import matching_size, size_or_model_size
from .layout import check_is_folder
from .lens import PINHOLES, Lens
from .lights import Light, LightState, check_places, light_paths, read_lights
from .orientation import TurnedFrame, exif_orientation, upright_frames_of
from .pictures import PictureCache, read_mask
from .plate_space import read_plate_space
from .unsolved import cameras_without_solve

LIGHTS, REMOVED, MASKS = "lights.json", "removed", "masks"
"""Names in a capture's folder: the file of its lights, and the folders of its clean frames and of its masks."""
MIN_MASK_VALUE = 0.99
"""Mean of a mask from which a pixel counts."""
HOLDOUT_INTERVAL = 8
"""Every 8th view is held out by default, as in 3DGS and mip-NeRF 360."""


@dataclass(frozen=True, eq=False)
class View:
    """One frame with its camera: name, pinhole camera of the undistorted picture, and lens of the file (None: no
    distortion).

    points: indices (n,) of the capture's points that were observed in it, where the solve says. upright: the camera was
    solved from the picture as shown, turned by the Exif orientation of its file.
    """

    name: str
    camera: Camera
    lens: Lens | None
    points: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    upright: bool = False


class Capture:
    """A capture, see the module's head. `Capture.open` makes one."""

    def __init__(self, folder: Path, views: Sequence[View], points: PointCloud, lights: Sequence[Light] = (),
                 *, frames: dict[str, Path] | None = None, cache_bytes: int = 1 << 30) -> None:
        """Make a capture of views, and find their pictures in removed/, truth/ and masks/ of `folder`.

        frames: the file of each view by name. cache_bytes: limit of the decoded pictures that are cached."""
        self.folder = folder
        self.views = tuple(views)
        self.points = points
        self.lights = tuple(lights)
        self.has_cameras = True
        """False for frames without a camera solve, whose one camera stands at the origin."""
        self.focal_source = "solved"
        """Source of the focal length, a noun phrase."""
        self.cache_bytes = cache_bytes
        self._frames = frames or {}
        self._pictures = PictureCache(cache_bytes)
        names = [view.name for view in self.views]
        self._clean_frames = matching_pictures(folder / REMOVED, names)
        self._truth_scene = matching_pictures(folder / "truth" / "scene", names)
        self._truth_flare = matching_pictures(folder / "truth" / "flare", names)
        self._masks = mask_pictures(folder / MASKS, names)
        self._order = {name: number for number, name in enumerate(names)}
        self._paths = light_paths(self.lights, names)
        self._focal: float | None = None
        self._split_lists: tuple[set[str] | None, ...] = (None, None)
        self.warnings: tuple[str, ...] = ()
        """Sentences for the user, who should read them before the capture is used."""
        self.left_out: dict[str, tuple[str, ...]] = {}
        """Names of frames that are not among the views, by reason."""

    @classmethod
    def open(cls, folder: Path | str, *, need_frames: bool = True, cache_bytes: int = 1 << 30,
             need_cameras: bool = True, focal: float | None = None) -> Capture:
        """Read a capture and check all that can be checked without decoding a picture.

        With `need_frames` every frame must exist, at the model's size or a uniform scale of it; without, cameras,
        points and lights suffice, and views whose frames are missing have the model's size. At most `cache_bytes` of
        decoded pictures are cached. Without `need_cameras`, frames without a camera solve get one camera at the origin;
        focal: its focal length in pixels of the first frame, None for that of camera.json, of Exif data or a usual one.

        Raises CaptureError (model, lights, split) or FrameError (pictures), naming the file.
        """
        return finish(cls.open_in_steps(folder, need_frames=need_frames, cache_bytes=cache_bytes,
                                        need_cameras=need_cameras, focal=focal))

    @classmethod
    def open_in_steps(cls, folder: Path | str, *, need_frames: bool = True, cache_bytes: int = 1 << 30,
                      need_cameras: bool = True, focal: float | None = None) -> Steps[Capture]:
        """Read a capture as `open` does, as a generator that pauses between short steps and returns the capture."""
        folder = Path(folder)
        check_is_folder(folder)
        solve, focal_source = (yield from read_solve_in_steps(folder, required=need_cameras)), "solved"
        has_cameras = solve is not None
        if solve is None:
            solve, focal_source = cameras_without_solve(folder, focal)
        check_single_poses(solve, folder)
        yield
        matched = yield from match_frames_in_steps(solve)
        yield
        upright_frames, orientation_warnings = upright_frames_of(solve.frames, matched.files,
                                                                 solve.points if has_cameras else None)
        yield
        opened = yield from _open_views_in_steps(folder, solve, matched.files, upright_frames, need_frames)
        names = opened.names
        lights = read_lights(find_entry(folder, LIGHTS) or folder / LIGHTS)
        yield
        capture = cls(folder, opened.views, solve.points, lights, frames=opened.files, cache_bytes=cache_bytes)
        yield
        capture._order, capture.has_cameras = opened.order, has_cameras
        capture._focal, capture.focal_source = focal, focal_source
        check_places(capture.lights, capture.folder / LIGHTS, list(opened.files), has_cameras)
        capture._split_lists = tuple(None if split is None else {names[name] for name in split if name in names}
                                     for split in (solve.training, solve.held_out))
        capture._masks.update({names[name]: path for name, path in solve.masks.items() if name in names})
        yield
        if need_frames:
            yield from capture._check_layer_sizes()
            capture.warnings = (*solve.warnings, *matched.warnings, *orientation_warnings, *geometry_warnings(solve),
                                *capture.light_warnings)
            capture.left_out = {reason: tuple(left_out) for reason, left_out in (
                ("no pose", matched.unposed), ("a pose without a frame", matched.missing)) if left_out}
        if (folder / "split.json").exists():
            capture.split(None)  # raises where it is not valid
        return capture

    def reopen(self) -> Capture:
        """Open the capture's folder anew, with the same cache size. Raises what `open` raises."""
        return Capture.open(self.folder, cache_bytes=self.cache_bytes, need_cameras=self.has_cameras, focal=self._focal)

    def with_exposures(self, exposures: Mapping[str, float]) -> Capture:
        """Return a copy with the views' exposures, by name; 1 for views without."""
        result = copy(self)
        result.views = tuple(replace(view, camera=replace(view.camera, exposure=exposures.get(view.name, 1.0)))
                             for view in self.views)
        return result

    def with_frame_names(self) -> Capture:
        """Return a copy whose cameras carry the names of their frames (`Camera.frame`)."""
        result = copy(self)
        result.views = tuple(replace(view, camera=replace(view.camera, frame=view.name)) for view in self.views)
        return result

    def with_lights_at(self, places: Mapping[str, Floats]) -> Capture:
        """Return a copy with the lights at these positions (3,), by name; those on a path stay on it."""
        return self.with_lights([light if light.moves else replace(light, xyz=places.get(light.name, light.xyz))
                                 for light in self.lights])

    def with_lights(self, lights: Sequence[Light]) -> Capture:
        """Return a copy with other lights."""
        result = copy(self)
        result.lights = tuple(lights)
        result._paths = light_paths(result.lights, [view.name for view in result.views])
        return result

    def with_points(self, points: PointCloud, observed: Mapping[str, NDArray[np.int64]]) -> Capture:
        """Return a copy with other points, and the indices of those observed in each view, by the view's name."""
        result = copy(self)
        result.points = points
        none = np.zeros(0, np.int64)
        result.views = tuple(replace(view, points=observed.get(view.name, none)) for view in self.views)
        return result

    def with_frame_size(self, size: tuple[int, int]) -> Capture:
        """Return a copy in which views without a frame have this size (width, height), if it has their aspect.

        A model may have been solved from larger or smaller frames than those of the fit.
        """
        result = copy(self)
        result.views = tuple(
            replace(view, camera=view.camera.scaled(*size))
            if not self.frame_path(view).is_file() and same_aspect(view.camera.size, size) else view
            for view in self.views)
        return result

    # Lights.

    def light_state(self, light: Light, view: View) -> LightState:
        """Return place and brightness of a light of this capture in a view.

        A light that is known on the picture alone lies at the depth of the capture's extent.
        """
        return self._paths[light.name].state(view.name, view.camera, self.extent)

    @property
    def light_warnings(self) -> list[str]:
        """Sentences for the user on the lights' paths: frames that are interpolated or unknown."""
        return [warning for path in self._paths.values() for warning in path.warnings()]

    # What was filmed.

    @cached_property
    def plate_space(self) -> ColourSpace | None:
        """The space of the frames by the capture's record; None where their files decide. Raises CaptureError,
        SettingsError and EngineError."""
        return read_plate_space(self.folder)

    def frame(self, view: View, size: tuple[int, int] | None = None) -> Picture:
        """Return the view's frame, undistorted, at its camera's size or at `size` (width, height).

        Treat the pixels as read-only: they may be shared. Raises FrameError.
        """
        if view.name not in self._frames:
            raise FrameError(f"{self.folder} has no frame for {view.name}.")
        return self._picture(self._frames[view.name], view, size, self.plate_space)

    def frame_in_space(self, view: View, space: ColourSpace) -> Picture:
        """Return the view's frame, undistorted, at its file's size, read in a space in place of the capture's. Raises
        FrameError."""
        path = self.frame_path(view)
        stored = self._pictures.upright(read_picture(path, space=space, over_black=True), view, path)
        return self._pictures.undistorted(stored, view, path) if view.lens else stored

    def frame_path(self, view: View) -> Path:
        """Return the file of the view's frame."""
        return self._frames[view.name]

    def clean_frame(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """Return the clean frame from removed/; None where there is none."""
        is_developed = self.has_other_format(view)
        return self._optional_picture(self._clean_frames, view, size, None if is_developed else self.plate_space)

    def has_other_format(self, view: View) -> bool:
        """Return whether a view's clean frame is an EXR, so linear light, and its filmed frame is not."""
        path = self._clean_frames.get(view.name)
        return path is not None and path.suffix.lower() == ".exr" != self.frame_path(view).suffix.lower()

    def holds_light_above_white(self, view: View) -> bool:
        """Return whether the file of the view's frame may hold light above white. Raises FrameError."""
        return has_float_pixels(self.frame_path(view), self.plate_space)

    def clean_frame_path(self, view: View) -> Path:
        """Return the file of the view in removed/, where `has_clean_frames`."""
        return self._clean_frames[view.name]

    def mask(self, view: View, size: tuple[int, int] | None = None) -> NDArray[np.bool_] | None:
        """Return (height, width), True for the pixels of the view that count; None without a mask.

        A mask is black, or transparent, where something moves or must not be learned from. A pixel that resampling
        mixes with a black one counts as black. Raises FrameError.
        """
        if view.name not in self._masks:
            return None
        path, size = self._masks[view.name], size or view.camera.size
        picture = self._pictures.upright(read_mask(path), view, path)
        if view.lens is not None:
            picture = self._pictures.undistorted(picture, view, path)
        return np.asarray(picture.resized(*size).pixels.min(axis=2) > MIN_MASK_VALUE)

    def mask_path(self, view: View) -> Path | None:
        """Return the file of the view's mask; None without one."""
        return self._masks.get(view.name)

    @property
    def has_masks(self) -> bool:
        """Return whether some view has a mask."""
        return bool(self._masks)

    def truth_scene(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """Return the exact scene layer; None where it is not known."""
        return self._optional_picture(self._truth_scene, view, size)

    def truth_flare(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """Return the exact flare layer; None where it is not known."""
        return self._optional_picture(self._truth_flare, view, size)

    @property
    def has_clean_frames(self) -> bool:
        """Return whether every view has a clean frame in removed/."""
        return len(self._clean_frames) == len(self.views)

    @property
    def has_truth(self) -> bool:
        """Return whether every view has an exact scene layer."""
        return len(self._truth_scene) == len(self.views)

    @property
    def centre(self) -> Floats:
        """(3,) mean of the camera positions."""
        return self._positions.mean(axis=0)

    @property
    def _positions(self) -> Floats:
        """(views, 3) of the cameras."""
        return np.array([view.camera.position for view in self.views])

    @property
    def extent(self) -> float:
        """Extent of the scene as in 3DGS: 1.1 x the largest distance of a camera from the mean of all.

        For cameras that only rotate: the median distance of the points from their centre, or 1.
        """
        return self._point_distance or 1.0 if self.is_rotation_only else 1.1 * self._camera_radius

    @property
    def is_rotation_only(self) -> bool:
        """Return whether all cameras share one place, as on a tripod, within rounding or the noise of a solve."""
        return self._camera_radius <= max(1e-3 * self._point_distance, 1e-9 * (1 + float(np.abs(self.centre).max())))

    @property
    def _camera_radius(self) -> float:
        """Largest distance of a camera from the mean of all."""
        places = self._positions
        return max(float(np.linalg.norm(away)) for away in places - places.mean(axis=0))

    @property
    def _point_distance(self) -> float:
        """Median distance of the points from that mean; 0 without points."""
        return float(np.median(np.linalg.norm(self.points.xyz - self.centre, axis=1))) if len(self.points) else 0.0

    def view(self, name: str) -> View:
        """Return the view of that name. Raises CaptureError where there is none."""
        view = self._find_view(name)
        if view is None:
            raise CaptureError(f"{self.folder} has no view {name!r}; its first is {self.views[0].name!r}.")
        return view

    def _find_view(self, name: str) -> View | None:
        """Return the view of a name in another form: separators, accents, case of the suffix, "images/" before it."""
        for key in (lambda text: text, canonical_name, lambda text: canonical_name(view_name(text, True))):
            match = next((view for view in self.views if key(view.name) == key(name)), None)
            if match is not None:
                return match
        return None

    def split(self, holdout: str | int | Path | None = None) -> tuple[tuple[View, ...], tuple[View, ...]]:
        """Return (training views, held-out views).

        `holdout`: a JSON file like split.json; a number N (every Nth pose, from the first; 0: none); None: the
        capture's split.json, else the lists of its transforms.json, else every 8th. Raises CaptureError.
        """
        if isinstance(holdout, str) and holdout.strip().lstrip("+-").isdigit():
            holdout = int(holdout)
        if holdout is None:
            default = self.folder / "split.json"
            if not default.exists() and self._split_lists != (None, None):
                return self._split_by_lists()
            holdout = default if default.exists() else HOLDOUT_INTERVAL
        if isinstance(holdout, int):
            if holdout < 0:
                raise CaptureError(f"Every {holdout}th view cannot be held out; give a number from 0.")
            train = tuple(view for view in self.views if not holdout or self._order[view.name] % holdout)
            test = tuple(view for view in self.views if holdout and not self._order[view.name] % holdout)
            if not train:
                raise CaptureError(f"{self.folder}: with every {holdout}th of {len(self.views)} views held out, "
                                   "none is left to train on; hold none out (--holdout 0).")
            return train, test
        names = self._read_held_out_names(Path(holdout))
        train = tuple(view for view in self.views if view.name not in names)
        if not train:
            raise CaptureError(f"{holdout} holds out every view, so that none is left to train on.")
        return train, tuple(view for view in self.views if view.name in names)

    def _split_by_lists(self) -> tuple[tuple[View, ...], tuple[View, ...]]:
        """Return (training views, held-out views) by the lists of transforms.json; views in neither are left out."""
        training, held_out = self._split_lists
        names = {view.name for view in self.views}
        if training is None:
            training = names - (held_out or set())
        if held_out is None:
            held_out = names - training
        train = tuple(view for view in self.views if view.name in training)
        if not train:
            raise CaptureError(f"{self.folder}: the lists of transforms.json leave no view to train on; correct them, "
                               "or choose with --holdout.")
        return train, tuple(view for view in self.views if view.name in held_out and view.name not in training)

    # Reading.

    def _picture(self, path: Path, view: View, size: tuple[int, int] | None,
                 space: ColourSpace | None = None) -> Picture:
        return self._pictures.get(path, view, size or view.camera.size, space)

    def _optional_picture(self, paths: dict[str, Path], view: View, size: tuple[int, int] | None,
                          space: ColourSpace | None = None) -> Picture | None:
        return self._picture(paths[view.name], view, size, space) if view.name in paths else None

    def _read_held_out_names(self, path: Path) -> set[str]:
        """Read the names of the held-out views from a split file; frames that were left out on opening are ignored.
        Raises CaptureError."""
        data = read_json(path, CaptureError)
        names = data.get("test") if isinstance(data, dict) else None
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise CaptureError(f'{path} should read {{"test": ["name of a frame", …]}}.')
        views = {name: self._find_view(name) for name in names}
        without_frame = {canonical_name(view_name(name, True)) for each in self.left_out.values() for name in each}
        unknown = [name for name, view in views.items()
                   if view is None and canonical_name(view_name(name, True)) not in without_frame]
        if unknown:
            raise CaptureError(f"{path} names {min(unknown)!r}, which is not a frame of the capture.")
        if len(set(names)) < len(names):
            raise CaptureError(f"{path} names a frame twice; name each once.")
        return {view.name for view in views.values() if view is not None}

    def _check_layer_sizes(self) -> Steps[None]:
        """Raise where a picture in removed/, truth/ or masks/ has another aspect than its frame, or removed/ lacks
        frames, as an interrupted run leaves it."""
        if self._clean_frames and len(self._clean_frames) < len(self.views):
            lacking = [view.name for view in self.views if view.name not in self._clean_frames]
            raise CaptureError(f"{self.folder / 'removed'} lacks {len(lacking)} of {len(self.views)} frames, "
                               f"first {lacking[0]}; finish or remove it.")
        for paths in (self._clean_frames, self._truth_scene, self._truth_flare, self._masks):
            for number, view in enumerate(self.views):
                if number % FRAMES_PER_STEP == 0:
                    yield
                if view.name in paths:
                    size = picture_size(paths[view.name])
                    if view.upright and exif_orientation(paths[view.name]) in SWAPS_SIDES:
                        size = size[::-1]
                    if not same_aspect(size, view.camera.size):
                        raise FrameError(f"{paths[view.name]} is {size[0]} x {size[1]} pixels and the frame "
                                         f"{view.camera.width} x {view.camera.height}; make them one shape.")


@dataclass(eq=False)
class _OpenedViews:
    """The views of a capture; files and order (index among all poses) by view name; names: view name by pose name."""

    views: list[View] = field(default_factory=list)
    files: dict[str, Path] = field(default_factory=dict)
    order: dict[str, int] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)


def _open_views_in_steps(folder: Path, solve: CameraSolve, files: Mapping[str, Path],
                         upright_frames: Mapping[str, TurnedFrame], need_frames: bool) -> Steps[_OpenedViews]:
    """Check the pictures of the poses, and make views of them. Raises CaptureError and FrameError.

    files: pictures by pose name. upright_frames: those of `upright_frames_of`. need_frames: if False, a view without a
    picture gets the size of its model.
    """
    opened = _OpenedViews()
    for number, frame in enumerate(solve.frames):
        if number % FRAMES_PER_STEP == 0:
            yield
        path = files.get(frame.name)
        if path is None and need_frames and files:
            continue  # left out; if no pose has a picture, the check of the first size says so
        path = path or safe_join(solve.root, frame.name, CaptureError)
        read_size = matching_size if need_frames else size_or_model_size
        size = read_size(path, frame.lens, upright_frames.get(frame.name))
        name = view_name(frame.name, solve.root == folder)
        if name in opened.files:
            raise CaptureError(f"{folder}: the frame {name} has two poses; remove one of them.")
        opened.views.append(_to_view(name, frame, size, frame.name in upright_frames))
        # The order counts poses without a picture as well, so that a missing one does not change the split.
        opened.files[name], opened.order[name], opened.names[frame.name] = path, number, name
    return opened


def _to_view(name: str, frame: PosedFrame, size: tuple[int, int], upright: bool) -> View:
    """Return the view of a frame whose picture has this size (width, height); a lens without distortion becomes None.

    upright: the pose was solved from the picture as its Exif orientation turns it.
    """
    lens = frame.lens
    fx, fy, cx, cy = lens.pinhole
    camera = Camera(lens.width, lens.height, fx, fy, cx, cy, frame.world_to_camera)
    camera = camera if size == camera.size else camera.scaled(*size)
    return View(name, camera, None if lens.model in PINHOLES else lens, frame.points, upright)
