# SPDX-License-Identifier: GPL-3.0-or-later
"""A capture: frames, cameras, points and lights of one place, in one folder.

    images/           frames as filmed
    sparse/0/         COLMAP model, binary or text (or transforms.json)
    lights.json       {"lights": [{"name": "lamp", "xyz": [x, y, z]}]}; optional
    removed/          clean frames, same names; optional
    split.json        {"test": ["0003.png", ...]}; optional
    truth/scene/, truth/flare/    exact layers where they are known; optional

Opening checks names, sizes and numbers by headers alone; pixels are decoded on demand. Distorted frames, and the
pictures that belong to them, are undistorted to the pinhole camera of their view.
"""
from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CaptureError, FrameError
from ..images.listing import SUFFIXES, pictures_below
from ..images.picture import Picture, same_aspect
from ..images.read import read_picture
from ..images.size import picture_size
from ..images.unsupported import unsupported_file
from ..images.video import is_video
from ..system.files import read_json, safe_join
from .camera import Camera, Floats
from .colmap import PointCloud, PosedFrame, find_model, read_model
from .lens import PINHOLES, Lens, undistort_picture
from .transforms import FILE as TRANSFORMS
from .transforms import read_transforms

LIGHTS, REMOVED = "lights.json", "removed"
"""Names in a capture's folder: the file of its lights, and the folder of its clean frames."""
HOLDOUT_INTERVAL = 8
"""Every 8th view is held out by default, as in 3DGS and mip-NeRF 360."""


@dataclass(frozen=True, eq=False)
class View:
    """One frame with its camera: name, pinhole camera of the undistorted picture, and lens of the file (None: no
    distortion).

    points: indices (n,) of the capture's points that were observed in it, where the solve says.
    """

    name: str
    camera: Camera
    lens: Lens | None
    points: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True, eq=False)
class Light:
    """A light at `xyz` (3,) in world coordinates."""

    name: str
    xyz: Floats


class Capture:
    """A capture, see the module's head. `Capture.open` makes one."""

    def __init__(self, folder: Path, views: Sequence[View], points: PointCloud, lights: Sequence[Light] = (),
                 *, frames: dict[str, Path] | None = None, cache_bytes: int = 1 << 30) -> None:
        """frames: the file of each view by name; without it the capture has no pictures."""
        self.folder = folder
        self.views = tuple(views)
        self.points = points
        self.lights = tuple(lights)
        self.cache_bytes = cache_bytes
        self._frames = frames or {}
        self._pictures = _PictureCache(cache_bytes)
        self._removed = _matching_pictures(folder / REMOVED, self.views)
        self._truth_scene = _matching_pictures(folder / "truth" / "scene", self.views)
        self._truth_flare = _matching_pictures(folder / "truth" / "flare", self.views)

    @classmethod
    def open(cls, folder: Path | str, *, need_frames: bool = True, cache_bytes: int = 1 << 30) -> Capture:
        """Read a capture and check all that can be checked without decoding a picture.

        With `need_frames` every frame must exist, at the model's size or a uniform scale of it; without, cameras,
        points and lights suffice, and views whose frames are missing have the model's size. At most `cache_bytes` of
        decoded pictures are cached.

        Raises CaptureError (model, lights, split) or FrameError (pictures), naming the file.
        """
        folder = Path(folder)
        if folder.is_file() and is_video(folder):
            raise CaptureError(f"{folder} is a video; make a capture of it by `solve {folder.name} --out my_capture`, "
                               "and name that.")
        if not folder.is_dir():
            raise CaptureError(f"{folder} is {'no folder' if folder.exists() else 'missing'}; name a capture's folder.")
        posed, points, root = _read_poses(folder)
        names = [frame.name for frame in posed]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise CaptureError(f"{folder}: the frame {twice} has two poses; remove one of them.")
        views, frames = [], {}
        for frame in sorted(posed, key=lambda frame: frame.name):
            path = safe_join(root, frame.name, CaptureError)
            size = _checked_size(path, frame.lens) if need_frames else _size_or_model_size(path, frame.lens)
            name = frame.name.removeprefix("images/") if root == folder else frame.name
            if name in frames:
                raise CaptureError(f"{folder}: the frame {name} has two poses; remove one of them.")
            views.append(_to_view(name, frame, size))
            frames[name] = path
        capture = cls(folder, views, points, read_lights(folder / LIGHTS), frames=frames,
                      cache_bytes=cache_bytes)
        if need_frames:
            capture._check_layer_sizes()
        if (folder / "split.json").exists():
            capture.split(None)
        return capture

    def reopen(self) -> Capture:
        """Open the capture's folder anew, with the same cache size. Raises what `open` raises."""
        return Capture.open(self.folder, cache_bytes=self.cache_bytes)

    def with_exposures(self, exposures: Mapping[str, float]) -> Capture:
        """Return a copy with the views' exposures, by name; 1 for views without."""
        same = copy(self)
        same.views = tuple(replace(view, camera=replace(view.camera, exposure=exposures.get(view.name, 1.0)))
                           for view in self.views)
        return same

    def with_lights_at(self, places: Mapping[str, Floats]) -> Capture:
        """Return a copy with the lights at these positions (3,), by name."""
        same = copy(self)
        same.lights = tuple(replace(light, xyz=places.get(light.name, light.xyz)) for light in self.lights)
        return same

    def with_frame_size(self, size: tuple[int, int]) -> Capture:
        """Return a copy in which views without a frame have this size (width, height), where it is a uniform scale of
        theirs.

        A model may have been solved from larger or smaller frames than those of the fit.
        """
        same = copy(self)
        same.views = tuple(
            replace(view, camera=view.camera.scaled(*size))
            if not self.frame_path(view).is_file() and same_aspect(view.camera.size, size) else view
            for view in self.views)
        return same

    # What was filmed.

    def frame(self, view: View, size: tuple[int, int] | None = None) -> Picture:
        """The view's frame, undistorted, at its camera's size or at `size` (width, height).

        Treat the pixels as read-only: they may be shared. Raises FrameError.
        """
        if view.name not in self._frames:
            raise FrameError(f"{self.folder} has no frame for {view.name}.")
        return self._picture(self._frames[view.name], view, size)

    def frame_in_file_primaries(self, view: View) -> Picture:
        """Return the view's frame, undistorted, at its file's size, without conversion to Rec. 709. Raises FrameError.
        """
        path = self.frame_path(view)
        stored = read_picture(path, keep_primaries=True)
        return self._pictures.undistorted(stored, view, path) if view.lens else stored

    def frame_path(self, view: View) -> Path:
        """The file of the view's frame."""
        return self._frames[view.name]

    def removed(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """Return the clean frame from removed/; None where there is none."""
        return self._optional_picture(self._removed, view, size)

    def removed_path(self, view: View) -> Path:
        """Return the file of the view in removed/, where `has_removed`."""
        return self._removed[view.name]

    def truth_scene(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """Return the exact scene layer; None where it is not known."""
        return self._optional_picture(self._truth_scene, view, size)

    def truth_flare(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """Return the exact flare layer; None where it is not known."""
        return self._optional_picture(self._truth_flare, view, size)

    @property
    def has_removed(self) -> bool:
        """True if every view has a clean frame."""
        return bool(self._removed)

    @property
    def has_truth(self) -> bool:
        """True if every view has an exact scene layer."""
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
        """True if all cameras share one place, as on a tripod, within rounding or the noise of a solve."""
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
        for view in self.views:
            if view.name == name:
                return view
        raise CaptureError(f"{self.folder} has no view {name!r}; its first is {self.views[0].name!r}.")

    def split(self, holdout: str | int | Path | None = None) -> tuple[tuple[View, ...], tuple[View, ...]]:
        """Return (training views, held-out views).

        `holdout`: a JSON file like split.json; a number N (every Nth view, from the first; 0: none); None: the
        capture's split.json, else every 8th. Raises CaptureError.
        """
        if isinstance(holdout, str) and holdout.strip().lstrip("+-").isdigit():
            holdout = int(holdout)
        if holdout is None:
            default = self.folder / "split.json"
            holdout = default if default.exists() else HOLDOUT_INTERVAL
        if isinstance(holdout, int):
            if holdout < 0:
                raise CaptureError(f"Every {holdout}th view cannot be held out; give a number from 0.")
            train = tuple(view for i, view in enumerate(self.views) if not holdout or i % holdout)
            test = tuple(view for i, view in enumerate(self.views) if holdout and not i % holdout)
            if not train:
                raise CaptureError(f"{self.folder}: with every {holdout}th of {len(self.views)} views held out, "
                                   "none is left to train on; hold none out (--holdout 0).")
            return train, test
        names = self._read_held_out_names(Path(holdout))
        train = tuple(view for view in self.views if view.name not in names)
        if not train:
            raise CaptureError(f"{holdout} holds out every view, so that none is left to train on.")
        return train, tuple(view for view in self.views if view.name in names)

    # How the pictures are had.

    def _picture(self, path: Path, view: View, size: tuple[int, int] | None) -> Picture:
        return self._pictures.get(path, view, size or view.camera.size)

    def _optional_picture(self, paths: dict[str, Path], view: View, size: tuple[int, int] | None) -> Picture | None:
        return self._picture(paths[view.name], view, size) if view.name in paths else None

    def _read_held_out_names(self, path: Path) -> set[str]:
        data = read_json(path, CaptureError)
        names = data.get("test") if isinstance(data, dict) else None
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise CaptureError(f'{path} should read {{"test": ["name of a frame", …]}}.')
        unknown = set(names) - {view.name for view in self.views}
        if unknown:
            raise CaptureError(f"{path} names {min(unknown)!r}, which is not a frame of the capture.")
        if len(set(names)) < len(names):
            raise CaptureError(f"{path} names a frame twice; name each once.")
        return set(names)

    def _check_layer_sizes(self) -> None:
        """Check the sizes of removed/ and truth/, and that removed/ is complete: an incomplete one is an interrupted
        run."""
        if self._removed and len(self._removed) < len(self.views):
            lacking = [view.name for view in self.views if view.name not in self._removed]
            raise CaptureError(f"{self.folder / 'removed'} lacks {len(lacking)} of {len(self.views)} frames, "
                               f"first {lacking[0]}; finish or remove it.")
        for paths in (self._removed, self._truth_scene, self._truth_flare):
            for view in self.views:
                if view.name in paths:
                    size = picture_size(paths[view.name])
                    if not same_aspect(size, view.camera.size):
                        raise FrameError(f"{paths[view.name]} is {size[0]} x {size[1]} pixels and the frame "
                                         f"{view.camera.width} x {view.camera.height}; make them one shape.")


class _PictureCache:
    """Decoded, undistorted, resized pictures; evicts the least recently used above its capacity."""

    def __init__(self, room: int) -> None:
        self._capacity = room
        self._used = 0
        self._pictures: OrderedDict[tuple[Path, tuple[int, int]], Picture] = OrderedDict()
        self._maps: OrderedDict[tuple[int, tuple[int, int], float], Any] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, path: Path, view: View, size: tuple[int, int]) -> Picture:
        key = (path, size)
        with self._lock:
            if key in self._pictures:
                self._pictures.move_to_end(key)
                return self._pictures[key]
        picture = read_picture(path)
        if view.lens is not None:
            picture = self.undistorted(picture, view, path)
        elif not same_aspect(picture.size, view.camera.size):
            raise FrameError(f"{path} is {picture.size[0]} x {picture.size[1]} pixels, not "
                             f"{view.camera.width} x {view.camera.height}.")
        picture = picture.resized(*size)
        picture.pixels.flags.writeable = False
        self._store(key, picture)
        return picture

    def _store(self, key: tuple[Path, tuple[int, int]], picture: Picture) -> None:
        with self._lock:
            if key in self._pictures or picture.pixels.nbytes > self._capacity:
                return
            self._pictures[key] = picture
            self._used += picture.pixels.nbytes
            while self._used > self._capacity:
                _, old = self._pictures.popitem(last=False)
                self._used -= old.pixels.nbytes

    def undistorted(self, picture: Picture, view: View, path: Path) -> Picture:
        """Undistort a picture of a view's file, whose lens is distorted. Raises FrameError."""
        assert view.lens is not None
        if not same_aspect(picture.size, view.camera.size):
            raise FrameError(f"{path} is {picture.size[0]} x {picture.size[1]} pixels, not "
                             f"{view.camera.width} x {view.camera.height}.")
        camera = view.camera.scaled(*picture.size)
        key = (id(view.lens), picture.size, camera.fx)
        with self._lock:
            maps = self._maps.get(key)
        if maps is None:
            maps = view.lens.maps(camera)
            with self._lock:
                self._maps[key] = maps
                while len(self._maps) > 4:
                    self._maps.popitem(last=False)
        return undistort_picture(picture, maps)


def read_lights(path: Path) -> tuple[Light, ...]:
    """Read the lights of a lights.json, none where the file is absent. Raises CaptureError where it is invalid."""
    if not path.exists():
        return ()
    data = read_json(path, CaptureError)
    entries = data.get("lights") if isinstance(data, dict) else None
    if not isinstance(entries, list):
        raise CaptureError(f'{path} should read {{"lights": [{{"name": "lamp", "xyz": [x, y, z]}}, …]}}.')
    lights: dict[str, Light] = {}
    for number, entry in enumerate(entries):
        name = entry.get("name") if isinstance(entry, dict) else None
        if not isinstance(name, str) or not name.strip():
            raise CaptureError(f"{path}, light {number}: the name is missing.")
        if name in lights:
            raise CaptureError(f"{path} has two lights with the name {name!r}; rename one.")
        xyz = entry.get("xyz")
        if not is_point(xyz):
            raise CaptureError(f"{path}, {name!r}: xyz should be three finite numbers.")
        lights[name] = Light(name, np.array(xyz, np.float64))
    return tuple(lights.values())


def is_point(xyz: Any) -> bool:
    """True for three finite numbers, as in JSON."""
    return isinstance(xyz, list) and len(xyz) == 3 and all(_is_finite(x) for x in xyz)


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e30


def _read_poses(folder: Path) -> tuple[list[PosedFrame], PointCloud, Path]:
    """Return frames with their poses, points, and the folder that the frames' names start from."""
    model = find_model(folder)
    if model is None and (folder / TRANSFORMS).exists():
        return *read_transforms(folder), folder
    model = model or find_model(folder, ("colmap/sparse/0",))
    if model is None:
        raise CaptureError(f"{folder} has no camera solve: neither sparse/0/cameras.bin (or .txt) nor "
                           f"{TRANSFORMS}; run solve first.")
    return *read_model(model), folder / "images"


def _checked_size(path: Path, lens: Lens) -> tuple[int, int]:
    size = picture_size(path)
    if not same_aspect(size, (lens.width, lens.height)):
        raise FrameError(f"{path} is {size[0]} x {size[1]} pixels and its camera {lens.width} x {lens.height}, "
                         "which is another shape; use the frames that were solved.")
    if path.suffix.lower() not in SUFFIXES:
        raise unsupported_file(path)
    return size


def _size_or_model_size(path: Path, lens: Lens) -> tuple[int, int]:
    """Return the picture's size, or the model's where the picture is missing or unusable."""
    try:
        return _checked_size(path, lens)
    except FrameError:
        return lens.width, lens.height


def _to_view(name: str, frame: PosedFrame, size: tuple[int, int]) -> View:
    lens = frame.lens
    fx, fy, cx, cy = lens.pinhole
    camera = Camera(lens.width, lens.height, fx, fy, cx, cy, frame.world_to_camera)
    straight = lens.model in PINHOLES
    return View(name, camera if size == camera.size else camera.scaled(*size), None if straight else lens, frame.points)


class PictureIndex:
    """The pictures below a folder, found by the names of frames elsewhere, which may have another suffix."""

    def __init__(self, folder: Path) -> None:
        self.paths = pictures_below(folder)
        self._names: dict[str, str] = {}
        for path in self.paths:  # by the name with a lower-case suffix
            name = path.relative_to(folder)
            self._names.setdefault(name.with_suffix(name.suffix.lower()).as_posix(), name.as_posix())

    def find(self, frame: Path | str) -> str | None:
        """Return the name below the folder of a frame's picture, or None."""
        name = Path(frame)
        suffixes = (name.suffix.lower(), ".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg")
        keys = (name.with_suffix(suffix).as_posix() for suffix in suffixes)
        return next((self._names[key] for key in keys if key in self._names), None)


def _matching_pictures(folder: Path, views: Sequence[View]) -> dict[str, Path]:
    """Map the views to their pictures in `folder`."""
    matches: dict[str, Path] = {}
    if not folder.is_dir():
        return matches
    pictures = PictureIndex(folder)
    for view in views:
        safe_join(folder, view.name, CaptureError)
        match = pictures.find(view.name)
        if match is not None:
            matches[view.name] = safe_join(folder, match, CaptureError)
    if pictures.paths and views and not matches:
        raise CaptureError(f"{folder} holds {len(pictures.paths)} pictures, the first {pictures.paths[0].name}, and "
                           f"none has the name of a frame, such as {views[0].name}; give them the frames' names.")
    return matches


