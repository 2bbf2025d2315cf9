# SPDX-License-Identifier: GPL-3.0-or-later
"""Targets of a transfer: pictures, a capture, a run, splats with cameras, or a shot written by Blender.

Each becomes a `Target`: frames with a camera and placed lights, with optional plates, and an optional scene of
Gaussians that hides lights and can be the background.
"""
from __future__ import annotations

import hashlib
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..capture import Camera, Capture, View, read_lights
from ..capture.camera import check_in_view
from ..colour import ColourSpace
from ..conventions.frame_numbers import NumberedFrame, layers_file, number_views, plates_by_number
from ..errors import CaptureError, FrameError, SettingsError
from ..gaussians.ply import read_ply
from ..gaussians.scene import SceneGaussians
from ..images.exr import is_exr, read_data_window
from ..images.exr_views import views_of_file
from ..images.formats.exif import read_exif
from ..images.formats.tiff import UPRIGHT
from ..images.listing import pictures_in
from ..images.picture import Picture, same_aspect
from ..images.plates import clean_name
from ..images.window import DataWindow, union_window
from ..lights.detection import Detector
from ..look import Look, PlacedLight
from ..look.shot import Shot, ShotFrame
from ..system.files import content_hash
from .plates import upright_picture
from .query import TrainingViews
from .sources import assign_sources

SourceNames = Mapping[str, str]
_WITH_ALPHA = (".png", ".tif", ".tiff")
"""Suffixes of files whose colours may not be multiplied with their alpha."""


@dataclass(frozen=True, eq=False)
class TargetFrame:
    """One frame of a target. frame: its number and the file of its layers. shot: camera and lights. plate: its picture,
    or None.

    undistorted: reads the plate's undistorted picture, if the file is distorted; its argument is the space to read it
    in, None for the capture's. window: where the layers' pixels lie on the plate's frame, all of which they hold; None
    if the camera has another size than the plate. orientation: Exif orientation of the plate; camera and layers are
    those of the upright picture. space: the plate's, where its capture names one (`plate_space.json`).
    """

    frame: NumberedFrame
    shot: ShotFrame
    plate: Path | None = None
    undistorted: Callable[[ColourSpace | None], Picture] | None = None
    window: DataWindow | None = None
    orientation: int = UPRIGHT
    space: ColourSpace | None = None

    def plate_with_flare_path(self, folder: Path) -> Path | None:
        """Return the path below `folder` of the plate with its flare: in the layers' subfolder, with the plate's name.

        None if it is not written: without a plate, or if the frame's size or distortion differs from the file's."""
        if self.plate is None or self.undistorted is not None or self.window is None:
            return None
        return folder / Path(self.frame.file).parent / clean_name(self.plate).name

    def cache_key(self) -> str:
        """Return a text that changes whenever the frame would; the plate counts by name and content, not by path."""
        plate = (self.plate.name, content_hash(self.plate)) if self.plate else None
        view, number, file = self.frame.view, self.frame.number, self.frame.file
        # Written out, not the repr of the class: a change would invalidate the layers of earlier transfers.
        text = f"(Frame(view={view!r}, number={number!r}, file={file!r}), {plate!r})" + self.shot.cache_key()
        if self.orientation != UPRIGHT:
            text += f"orientation {self.orientation}"
        if self.plate is not None and self.plate.suffix.lower() in _WITH_ALPHA:
            text += "over black"  # layers of an earlier version show the colours under alpha
        if self.space is not None:
            text += f"in {self.space.fingerprint}"
        return text


@dataclass(frozen=True, eq=False)
class Target:
    """Frames of the whole shot, in order. scene: hides lights. scene_is_background: frames without a plate show it."""

    frames: tuple[TargetFrame, ...]
    scene: SceneGaussians | None = None
    scene_is_background: bool = False
    warnings: tuple[str, ...] = ()
    """Sentences for the user."""

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the target's lights, in order of appearance."""
        return tuple(dict.fromkeys(light.name for frame in self.frames for light in frame.shot.lights))

    def fingerprint(self) -> str:
        """Return a hash of the scene; "" without one."""
        digest = hashlib.sha256()
        for parameter in self.scene.parameters() if self.scene is not None else ():
            digest.update(parameter.detach().cpu().numpy().tobytes())
        return digest.hexdigest()[:16] if self.scene is not None else ""


# ---- pictures -------------------------------------------------------------------------------------


def picture_target(paths: Sequence[Path], look: Look, lights: Mapping[str, tuple[float, float]], requested: SourceNames,
                   distances: Mapping[str, float], *, detector: Detector | None = None, focal: float | None = None,
                   centre: tuple[float, float] | None = None, space: ColourSpace | None = None,
                   training: Mapping[str, TrainingViews] | None = None) -> Target:
    """Return a target of pictures with lights in 2D: `lights`, px, by name, else those that `detector` finds.

    focal: px (default: the training camera's field of view, turned for a picture of the other orientation); centre:
    principal point, px (default: the middle). distances: distance of each source at which its flare has the brightness
    of the fit. requested: source by light. space: of the pictures, for `detector`; None for what their files declare.
    training: training views by source; a detected light shows the source with the most similar view.

    Raises SettingsError if no picture has a light, and for two pictures of one name.
    """
    path_by_name = _paths_by_name(paths)
    frames, unlit = [], []
    for frame in number_views(path_by_name):
        path = path_by_name[frame.view]
        orientation = read_exif(path)[0]
        window = plate_window(path, orientation)
        camera = _picture_camera(look, window, focal, centre)
        positions = dict(lights) or _detect_positions(path, detector, orientation, space)
        if not positions:
            unlit.append(path.name)
        plane_positions = {name: ((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
                           for name, (x, y) in positions.items()}
        similar = {} if lights else _most_similar_sources(plane_positions, training or {})
        sources_by_light = similar | {name: source for name, source in requested.items() if name in positions}
        sources = assign_sources(list(positions), look.names, sources_by_light)
        placed = [PlacedLight(name, sources[name], _point_on_ray(plane_position, distances[sources[name]]))
                  for name, plane_position in plane_positions.items()]
        frames.append(TargetFrame(frame, ShotFrame(frame.number, frame.view, camera, tuple(placed)), path,
                                  window=window, orientation=orientation))
    if len(unlit) == len(frames):
        raise SettingsError(f"No light was found in {paths[0]}; say where it is with --light X,Y.")
    names = f"{', '.join(unlit[:12])}{', …' if len(unlit) > 12 else ''}"
    warning = f"{len(unlit)} of {len(frames)} pictures show no light, and get no flare: {names}."
    target = Target(_share_windows(frames), warnings=(warning,) if unlit else ())
    if missing := set(requested) - set(target.lights):
        raise SettingsError(f"The pictures have no light {min(missing)!r}; they have {', '.join(target.lights)}.")
    return target


def _paths_by_name(paths: Sequence[Path]) -> dict[str, Path]:
    """Return paths by their file names. Raises SettingsError for two different paths of one name."""
    path_by_name: dict[str, Path] = {}
    for path in paths:
        other = path_by_name.setdefault(path.name, path)
        if other != path:
            raise SettingsError(f"{other} and {path} have one name; put the flare on them one after the other, each "
                                "with an --out of its own.")
    return path_by_name


def _point_on_ray(plane_position: tuple[float, float], distance: float) -> NDArray[np.float64]:
    """Return the point (3,) at a distance from the camera that projects to a position on the normalised plane."""
    ray = np.array([*plane_position, 1.0])
    return np.asarray(ray / np.linalg.norm(ray) * distance)


def _picture_camera(look: Look, window: DataWindow, focal: float | None,
                    centre: tuple[float, float] | None) -> Camera:
    """Return the camera of a picture's frame, at the origin. focal: px, None for the training camera's field of view;
    centre: principal point, px, None for the middle."""
    width, height = window.frame
    pixel_ratio = look.camera.pixel_ratio(width, height)
    fx = focal or look.camera.fx * pixel_ratio
    fy = (focal or look.camera.fy * pixel_ratio) * window.aspect
    cx, cy = centre or (width / 2, height / 2)
    return Camera(width, height, fx, fy, cx, cy, np.eye(4))


def _detect_positions(path: Path, detector: Detector | None, orientation: int,
                      space: ColourSpace | None) -> dict[str, tuple[float, float]]:
    """Return the position, px, of each light that the detector finds in a picture, by name; {} without a detector.

    space: colour space of the picture, None for what its file declares.
    """
    if detector is None:
        return {}
    detections = detector.detect(upright_picture(path, orientation, space))
    return {f"found{number}": (float(detection.xy[0]), float(detection.xy[1]))
            for number, detection in enumerate(detections, 1)}


def _most_similar_sources(
    positions: Mapping[str, tuple[float, float]], training: Mapping[str, TrainingViews]
) -> dict[str, str]:
    """Return for each light, by its position on the plane, the source with the nearest light in a training view.

    Greedy: the most similar pair first, and each source once if there are enough."""
    chosen: dict[str, str] = {}
    # Every light with every source, the most similar first.
    ranked = sorted((float(np.linalg.norm(views.lights - position, axis=1).min()), name, source)
                    for name, position in positions.items() for source, views in training.items())
    while ranked and len(chosen) < len(positions):
        used = set(chosen.values())
        free = [(name, source) for _, name, source in ranked if name not in chosen]
        name, source = next(((name, source) for name, source in free if source not in used), free[0])
        chosen[name] = source
    return chosen


# ---- captures and splats --------------------------------------------------------------------------


def capture_target(capture: Capture, look: Look, requested: SourceNames, *, lights: Path | None = None,
                   scene: Path | None = None, scene_is_background: bool = False) -> Target:
    """Return a target of a capture's views. lights: a lights.json instead of the capture's. scene: a 3DGS PLY in its
    world, which hides lights. scene_is_background: the scene is rendered in place of the frames. requested: source by
    light.

    Raises CaptureError without lights.
    """
    target_lights = read_lights(lights) if lights else capture.lights
    if lights and not lights.is_file():
        raise CaptureError(f"{lights} is missing.")
    if not target_lights:
        raise CaptureError(f"{capture.folder} has no lights; run lights on it, or name a lights.json with --lights.")
    lit_capture = capture.with_lights(target_lights)
    sources = assign_sources([light.name for light in target_lights], look.names, requested)
    views = {view.name: view for view in capture.views}
    frames = []
    for frame in number_views(views):
        view = views[frame.view]
        path = None if scene_is_background else capture.frame_path(view)
        file_matches_view = view.lens is None and not view.upright
        undistorted = None if file_matches_view or path is None else _undistorted_reader(capture, view)
        window = matching_window(view.camera, path) if undistorted is None and path is not None else None
        states = [lit_capture.light_state(light, view) for light in target_lights]
        # A light of unknown brightness counts as on.
        placed = tuple(PlacedLight(state.name, sources[state.name], state.xyz, 1.0 if state.on is None else state.on,
                                   light.extent) for light, state in zip(target_lights, states, strict=True))
        shot = ShotFrame(frame.number, str(Path(frame.view).parent), view.camera, placed)
        frames.append(TargetFrame(frame, shot, path, undistorted, window, space=capture.plate_space))
    return Target(_share_windows(frames), _read_scene_in_view(scene, frames) if scene else None, scene_is_background)


def _read_scene_in_view(path: Path, frames: Sequence[TargetFrame]) -> SceneGaussians:
    """Read a 3DGS PLY. Raises CaptureError where fewer than half of the cameras have any of its Gaussians in view."""
    scene = read_ply(path)
    check_in_view([frame.shot.camera for frame in frames], scene.means.detach().numpy(), str(path), "the cameras")
    return scene


def _undistorted_reader(capture: Capture, view: View) -> Callable[[ColourSpace | None], Picture]:
    """Return `TargetFrame.undistorted` for a view."""
    return lambda space: capture.frame(view) if space is None else capture.frame_in_space(view, space)


def cameras_target(capture: Capture, look: Look, scene: Path | None = None) -> Target:
    """Return a target of a capture's cameras without its frames, and the lights where the .flare has them: for a flare
    in the scene of its fit. scene: a 3DGS PLY that hides lights."""
    placed = tuple(PlacedLight(light.name, light.name, light.xyz) for light in look.lights)
    views = {view.name: view for view in capture.views}
    frames = tuple(
        TargetFrame(frame, ShotFrame(frame.number, str(Path(frame.view).parent), views[frame.view].camera, placed))
        for frame in number_views(views))
    return Target(frames, read_ply(scene) if scene else None)


# ---- shots ----------------------------------------------------------------------------------------


def shot_target(shot: Shot, look: Look, requested: SourceNames, *, plates: Path | None = None,
                scene: Path | None = None, required_frames: Container[int] | None = None) -> Target:
    """Return a target of a shot's frames. plates: a folder of pictures whose names end with the frames' numbers.
    requested: source by light. scene: a 3DGS PLY that hides lights.

    required_frames: frames that need a plate, None for all: a task of a farm may begin before the last plate exists.
    Raises SettingsError if one of them has no plate.
    """
    plates_by_frame = _plates_by_number(plates) if plates else {}
    # The shot's own sources are used, unless others are requested or this look lacks them.
    sources_by_light = {light.name: light.source for shot_frame in shot.frames for light in shot_frame.lights}
    available_sources = {name: source for name, source in sources_by_light.items() if source in look.names}
    sources = assign_sources(list(sources_by_light), look.names, {**available_sources, **requested})
    frames, folders = [], shot.folders
    for shot_frame in sorted(shot.frames, key=lambda each: (each.name, each.frame)):
        name, number = shot_frame.name, shot_frame.frame
        is_required = required_frames is None or number in required_frames
        if plates and is_required and number not in plates_by_frame:
            raise SettingsError(f"{plates} has no picture for frame {number}.")
        lights = tuple(replace(light, source=sources[light.name]) for light in shot_frame.lights)
        frame = NumberedFrame(f"{name}/{number}", number, layers_file(folders[name], number))
        plate = plates_by_frame.get(number)
        window = None
        if plate is not None:
            window = matching_window(shot_frame.camera, plate)
            _check_shape(plate, shot_frame.camera)
        frames.append(TargetFrame(frame, replace(shot_frame, lights=lights), plate, window=window))
    if not frames:
        raise SettingsError("The shot has no frames; export it again.")
    return Target(_share_windows(frames), read_ply(scene) if scene else None)


def _check_shape(plate: Path, camera: Camera) -> None:
    """Raise SettingsError for a plate of another aspect ratio than the frame, which would be stretched."""
    width, height = read_data_window(plate).frame
    if not same_aspect((width, height), camera.size):
        raise SettingsError(f"{plate} is {width} x {height} pixels and the shot {camera.width} x {camera.height}, "
                            "which is another shape; give the plates of this shot.")


def plate_window(plate: Path, orientation: int = UPRIGHT) -> DataWindow:
    """Return where a plate's pixels lie on its frame, as viewers show it.

    Raises FrameError for a stereo picture: one flare fits one eye.
    """
    window = read_data_window(plate)
    if is_exr(plate) and (views := views_of_file(plate)):
        raise FrameError(f"{plate} holds the views {' and '.join(view.name for view in views)}, and a flare lies "
                         "elsewhere in each; export each view as a file of its own, and transfer to one at a time.")
    return window.oriented(orientation)


def matching_window(camera: Camera, plate: Path) -> DataWindow | None:
    """Return the window of a plate whose frame has the camera's size; None for a plate of another size.

    Raises SettingsError for a plate of another size that stores more or fewer pixels than its frame."""
    window = plate_window(plate)
    if window.frame == camera.size:
        return window
    if window.is_frame:
        return None
    raise SettingsError(f"{plate} has pixels beyond its frame, or lacks some of it, and its frame of "
                        f"{window.frame[0]} x {window.frame[1]} is not the camera's {camera.width} x "
                        f"{camera.height}; give plates of the camera's size, or cut them to the frame.")


def _share_windows(frames: Sequence[TargetFrame]) -> tuple[TargetFrame, ...]:
    """Give all frames of a folder of layers one window that holds the frame and the pixels of every plate.

    Then a compositor that ignores data windows, as Blender's does, shows all layers in the right place.
    """
    windows: dict[tuple[str, tuple[int, int]], list[DataWindow]] = {}
    for frame in frames:
        if frame.window is not None:
            windows.setdefault((str(Path(frame.frame.file).parent), frame.window.frame), []).append(frame.window)
    shared = {key: union_window(group) for key, group in windows.items()}
    return tuple(frame if frame.window is None else _with_window(
        frame, shared[str(Path(frame.frame.file).parent), frame.window.frame]) for frame in frames)


def _with_window(frame: TargetFrame, window: DataWindow) -> TargetFrame:
    """Return a frame, whose camera is that of the whole frame, with the camera of a window."""
    camera = frame.shot.camera.cropped(*window.origin, *window.size)
    return replace(frame, shot=replace(frame.shot, camera=camera), window=window)


def _plates_by_number(folder: Path) -> dict[int, Path]:
    """Return the pictures of a folder by the number at the end of their names. Raises SettingsError for no pictures."""
    files = pictures_in(folder) if folder.is_dir() else []
    if not files:
        raise SettingsError(f"{folder} holds no pictures; name the folder of the plates.")
    return plates_by_number(files)


def resized(target: Target, width: int | None, height: int | None) -> Target:
    """Return the target with frames of another size, px, without the plates' overscan: without a height of the same
    aspect ratio, without a width unchanged."""
    if not width:
        return target
    frames = []
    for frame in target.frames:
        camera = frame.shot.camera
        if frame.window is not None:
            # The camera of the whole frame, from that of the window.
            (left, top), size = frame.window.origin, frame.window.frame
            camera = camera.cropped(-left, -top, *size)
        frames.append(replace(frame, shot=replace(frame.shot, camera=camera.scaled(width, height)), window=None))
    return replace(target, frames=tuple(frames))


def undistorted_background(frame: TargetFrame, size: tuple[int, int],
                           space: ColourSpace | None) -> NDArray[np.float32] | None:
    """Return the undistorted plate in linear Rec. 709 at `size`; None if the plate's file is not distorted. space: the
    plate's colour space, None to use that of its capture or file."""
    if frame.undistorted is None:
        return None
    return np.asarray(frame.undistorted(space).resized(*size).linear(), np.float32)
