# SPDX-License-Identifier: GPL-3.0-or-later
"""What a flare goes on to: pictures, a capture, a run, splats with cameras, or a shot that Blender wrote down.

All become frames with a camera and placed lights, each perhaps with a plate, and perhaps one scene of Gaussians
that hides lights and can be shown.
"""
from __future__ import annotations

import hashlib
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..capture import Camera, Capture, Light, View, read_lights
from ..colour import ColourSpace
from ..conventions.frame_numbers import Frame, layers_file, numbered, plates_by_number
from ..errors import CaptureError, SettingsError
from ..gaussians.ply import read_ply
from ..gaussians.scene import SceneGaussians
from ..images.exr import window_of
from ..images.listing import pictures_in
from ..images.picture import Picture, are_one_shape
from ..images.read import read_picture
from ..lights.detection import Detector
from ..look import Look
from ..look.shot import PlacedLight, Shot, ShotFrame
from ..system.files import content_of
from .query import Seen
from .sources import assigned

Mapped = Mapping[str, str]


@dataclass(frozen=True, eq=False)
class TargetFrame:
    """frame: its number and the file of its layers. shot: camera and lights. plate: its picture, if it has one.

    undistorted: gives the plate's picture where the file itself is a distorted one, asked whether with the numbers of
    the file, which are not converted by what it says of its space.
    """

    frame: Frame
    shot: ShotFrame
    plate: Path | None = None
    undistorted: Callable[[bool], Picture] | None = None

    def flared(self, folder: Path) -> Path | None:
        """Where below `folder` the plate with its flare goes: beside those of the layers' folder, under its own name.
        None where none is written: without a plate, and at another size or form than the file's."""
        if self.plate is None or self.undistorted is not None or window_of(self.plate).size != self.shot.camera.size:
            return None
        return folder / Path(self.frame.file).parent / self.plate.name

    def described(self) -> str:
        """Changes whenever the frame would; its plate counts by name and content, so that mirrored disks agree."""
        plate = (self.plate.name, content_of(self.plate)) if self.plate else None
        return repr((self.frame, plate)) + self.shot.described()


@dataclass(frozen=True, eq=False)
class Target:
    """frames: of the whole shot, in order. scene: hides lights; shown: it is the picture too, where no plate is."""

    frames: tuple[TargetFrame, ...]
    scene: SceneGaussians | None = None
    shown: bool = False
    says: tuple[str, ...] = ()
    """Sentences for the person who asked for it."""

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the target's lights, in order of appearance."""
        return tuple(dict.fromkeys(light.name for one in self.frames for light in one.shot.lights))

    def fingerprint(self) -> str:
        """Changes whenever the scene does; "" without one."""
        digest = hashlib.sha256()
        for parameter in self.scene.parameters() if self.scene is not None else ():
            digest.update(parameter.detach().numpy().tobytes())
        return digest.hexdigest()[:16] if self.scene is not None else ""


# ---- pictures -------------------------------------------------------------------------------------


def of_pictures(paths: Sequence[Path], look: Look, lights: Mapping[str, tuple[float, float]], wanted: Mapped,
                distances: Mapping[str, float], *, detector: Detector | None = None, focal: float | None = None,
                centre: tuple[float, float] | None = None, seen: Mapping[str, Seen] | None = None) -> Target:
    """Pictures with a light each in 2D: `lights` in pixels by name, else what `detector` finds.

    focal: in pixels (default: the training camera's field of view, turned where the picture is); centre: principal
    point in pixels (default: the middle). distances: of each source, at which its flare is as bright as it was learned.
    seen: what each source was learned from; a light that was found shows the source that stood most like it. Raises
    SettingsError where a picture has no light, and for two of one name.
    """
    paths = list(dict.fromkeys(paths))
    by_name = {path.name: path for path in paths}
    if len(by_name) < len(paths):
        twin = next(path for path in paths if by_name[path.name] != path)
        raise SettingsError(f"{twin} and {by_name[twin.name]} have one name; put the flare on them one after the "
                            "other, each with an --out of its own.")
    frames, dark = [], []
    for frame in numbered(by_name):
        path = by_name[frame.view]
        window = window_of(path)
        width, height = window.frame
        larger = look.camera.pixels_across(width, height)
        fx = focal or look.camera.fx * larger
        fy = (focal or look.camera.fy * larger) * window.aspect
        cx, cy = centre or (width / 2, height / 2)
        camera = on_plate(Camera(width, height, fx, fy, cx, cy, np.eye(4)), path)
        found = dict(lights) or _detected(path, detector)
        if not found:
            dark.append(path.name)
        told = {name: source for name, source in wanted.items() if name in found}
        if not lights:
            places = {name: ((x - cx) / fx, (y - cy) / fy) for name, (x, y) in found.items()}
            told = {**_most_alike(places, seen or {}), **told}
        sources = assigned(list(found), look.names, told)
        placed = []
        for name, (x, y) in found.items():
            ray = np.array([(x - cx) / fx, (y - cy) / fy, 1.0])
            placed.append(PlacedLight(name, sources[name], ray / np.linalg.norm(ray) * distances[sources[name]]))
        frames.append(TargetFrame(frame, ShotFrame(frame.number, frame.view, camera, tuple(placed)), path))
    if len(dark) == len(frames):
        raise SettingsError(f"No light was found in {paths[0]}; say where it is with --light X,Y.")
    target = Target(tuple(frames), says=(f"{len(dark)} of {len(frames)} pictures show no light, and get no flare: "
                                         f"{', '.join(dark[:12])}{', …' if len(dark) > 12 else ''}.",) if dark else ())
    if missing := set(wanted) - set(target.lights):
        raise SettingsError(f"The pictures have no light {min(missing)!r}; they have {', '.join(target.lights)}.")
    return target


def _detected(path: Path, detector: Detector | None) -> dict[str, tuple[float, float]]:
    if detector is None:
        return {}
    found = detector.detect(read_picture(path))
    return {f"found{number + 1}": (float(one.xy[0]), float(one.xy[1])) for number, one in enumerate(found)}


def _most_alike(places: Mapping[str, tuple[float, float]], seen: Mapping[str, Seen]) -> dict[str, str]:
    """For each light at a place of the plane the source that training saw nearest to it, each source once if there
    are enough."""
    chosen: dict[str, str] = {}
    pairs = sorted((float(np.linalg.norm(of.lights - place, axis=1).min()), name, source)
                   for name, place in places.items() for source, of in seen.items())
    while pairs and len(chosen) < len(places):
        used = set(chosen.values())
        free = [pair for pair in pairs if pair[1] not in chosen]
        _, name, source = next((pair for pair in free if pair[2] not in used), free[0])
        chosen[name] = source
    return chosen


# ---- captures and splats --------------------------------------------------------------------------


def of_capture(capture: Capture, look: Look, wanted: Mapped, *, lights: Path | None = None, scene: Path | None = None,
               shown: bool = False) -> Target:
    """A capture's views. lights: a lights.json instead of the capture's. scene: a 3DGS PLY in its world, which hides
    lights; shown: it is the picture too, and the frames are left alone.

    Raises CaptureError where there are no lights.
    """
    known = read_lights(lights) if lights else capture.lights
    if lights and not lights.is_file():
        raise CaptureError(f"{lights} is missing.")
    if not known:
        raise CaptureError(f"{capture.folder} has no lights; run lights on it, or name a lights.json with --lights.")
    placed = _placed(known, look, wanted)
    views = {view.name: view for view in capture.views}
    frames = []
    for frame in numbered(views):
        view = views[frame.view]
        path = None if shown else capture.frame_path(view)
        undistorted = None if view.lens is None or path is None else _undistorted(capture, view)
        camera = on_plate(view.camera, path) if undistorted is None and path is not None else view.camera
        shot = ShotFrame(frame.number, str(Path(frame.view).parent), camera, placed)
        frames.append(TargetFrame(frame, shot, path, undistorted))
    return Target(tuple(frames), read_ply(scene) if scene else None, shown)


def _placed(lights: Sequence[Light], look: Look, wanted: Mapped) -> tuple[PlacedLight, ...]:
    sources = assigned([light.name for light in lights], look.names, wanted)
    return tuple(PlacedLight(light.name, sources[light.name], light.xyz) for light in lights)


def _undistorted(capture: Capture, view: View) -> Callable[[bool], Picture]:
    return lambda own: capture.frame_in_own_primaries(view) if own else capture.frame(view)


def of_cameras(capture: Capture, look: Look, scene: Path | None = None) -> Target:
    """A capture's cameras without its pictures, and the lights where the flare was learned: for a flare that is shown
    in the scene it comes from. scene: a 3DGS PLY that hides them."""
    placed = tuple(PlacedLight(light.name, light.name, light.xyz) for light in look.lights)
    views = {view.name: view for view in capture.views}
    return Target(tuple(TargetFrame(frame, ShotFrame(frame.number, str(Path(frame.view).parent),
                                                     views[frame.view].camera, placed)) for frame in numbered(views)),
                  read_ply(scene) if scene else None)


# ---- shots ----------------------------------------------------------------------------------------


def of_shot(shot: Shot, look: Look, wanted: Mapped, *, plates: Path | None = None, scene: Path | None = None,
            wanted_frames: Container[int] | None = None) -> Target:
    """A shot's frames. plates: a folder of pictures whose names end with the frames' numbers. wanted_frames: those that
    have to have one, None for all: a farm's task may begin before the last frame is rendered.

    Raises SettingsError where a frame has no plate there.
    """
    given = _by_number(plates) if plates else {}
    # Sources that the shot names itself hold, unless others are wanted or this look has none such.
    told = {light.name: light.source for one in shot.frames for light in one.lights}
    sources = assigned(list(told), look.names,
                       {**{name: source for name, source in told.items() if source in look.names}, **wanted})
    frames, folders = [], shot.folders
    for one in sorted(shot.frames, key=lambda each: (each.name, each.frame)):
        if plates and one.frame not in given and (wanted_frames is None or one.frame in wanted_frames):
            raise SettingsError(f"{plates} has no picture for frame {one.frame}.")
        lights = tuple(replace(light, source=sources[light.name]) for light in one.lights)
        frame = Frame(f"{one.name}/{one.frame}", one.frame, layers_file(folders[one.name], one.frame))
        plate = given.get(one.frame)
        camera = on_plate(one.camera, plate) if plate is not None else one.camera
        if plate is not None:
            _check_shape(plate, camera)
        frames.append(TargetFrame(frame, replace(one, camera=camera, lights=lights), plate))
    if not frames:
        raise SettingsError("The shot has no frames; export it again.")
    return Target(tuple(frames), read_ply(scene) if scene else None)


def _check_shape(plate: Path, camera: Camera) -> None:
    """Raises SettingsError for a plate of another shape than the frame, which would be stretched."""
    width, height = window_of(plate).size
    if not are_one_shape((width, height), camera.size):
        raise SettingsError(f"{plate} is {width} x {height} pixels and the shot {camera.width} x {camera.height}, "
                            "which is another shape; give the plates of this shot.")


def on_plate(camera: Camera, plate: Path) -> Camera:
    """The camera of the pixels that a plate's file has: an EXR's may be more than those of the frame (overscan), or
    fewer. Raises SettingsError where they are, and the frame is not of the camera's size."""
    window = window_of(plate)
    if window.is_frame:
        return camera
    if window.frame != camera.size:
        raise SettingsError(f"{plate} has pixels beyond its frame, or lacks some of it, and its frame of "
                            f"{window.frame[0]} x {window.frame[1]} is not the camera's {camera.width} x "
                            f"{camera.height}; give plates of the camera's size, or cut them to the frame.")
    return camera.cropped(*window.origin, *window.size)


def _by_number(folder: Path) -> dict[int, Path]:
    """Pictures of a folder by the number that each name ends with."""
    files = pictures_in(folder) if folder.is_dir() else []
    if not files:
        raise SettingsError(f"{folder} holds no pictures; name the folder of the plates.")
    return plates_by_number(files)


def sized(target: Target, width: int | None, height: int | None) -> Target:
    """The same at another size in pixels; without a height the proportions stay."""
    if not width:
        return target
    return replace(target, frames=tuple(
        replace(one, shot=replace(one.shot, camera=one.shot.camera.scaled(width, height))) for one in target.frames))


def background(one: TargetFrame, size: tuple[int, int], space: ColourSpace | None) -> NDArray[np.float32] | None:
    """The undistorted plate in linear Rec. 709 at `size`, where the plate's own file cannot be used; else None. space:
    that its numbers are in, where its file is not to say."""
    if one.undistorted is None:
        return None
    picture = one.undistorted(space is not None)
    if space is not None:
        picture = Picture(space.to_linear(picture.pixels), "linear")
    return np.asarray(picture.resized(*size).linear(), np.float32)
