# SPDX-License-Identifier: GPL-3.0-or-later
"""The flare and the target of a transfer, from the arguments of `transfer`, and of `bake` for a .flare.

Hands a `core.transfer` target to the commands, which render it.
"""
from __future__ import annotations

import argparse
import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.choices import Follows
from ..core.errors import CaptureError, RunError, SettingsError
from ..core.images.listing import SUFFIXES, pictures_in
from ..core.images.unsupported import unsupported_file_error

if TYPE_CHECKING:
    from ..core.capture.camera import Floats
    from ..core.look.look import LightLook, Look
    from ..core.transfer.query import TrainingViews
    from ..core.transfer.target import Target

TARGET_OPTIONS = {"picture": ("light", "focal", "centre", "highlights", "highlight_gain"),
                  ".blend": ("lights", "scene", "plates", "radius", "fall_off"),
                  ".json": ("scene", "plates", "fall_off"), ".ply": ("lights", "cameras", "fall_off"),
                  "run": ("lights", "scene", "cameras", "fall_off"), "capture": ("lights", "scene", "fall_off")}
"""The options that apply to a kind of target only, by that kind."""


@dataclass(frozen=True)
class TargetOptions:
    """The options of `transfer` that describe a target and how its flare is evaluated, with their defaults."""

    to: tuple[Path, ...]
    out: Path
    frames: str | None = None
    job_frames: str | None = None
    shot: Path | None = None
    query: Follows = "blend"
    use: tuple[str, ...] = ()
    light: tuple[str, ...] = ()
    lights: str | None = None
    smooth: int = 1
    radius: float = 0.0
    fall_off: float | None = None
    highlights: float | None = None
    highlight_gain: float | None = None
    scale: float = 1.0
    cameras: Path | None = None
    scene: Path | None = None
    focal: float | None = None
    centre: str | None = None
    plates: Path | None = None
    plate_space: str = "auto"
    ocio: str | None = None

    @classmethod
    def of_transfer(cls, args: argparse.Namespace) -> TargetOptions:
        """Return the options in the arguments of `transfer`."""
        values: dict[str, Any] = {entry.name: getattr(args, entry.name) for entry in fields(cls)}
        for name, value in values.items():
            values[name] = tuple(value) if isinstance(value, list) else value
        return cls(**values)


def is_blend(args: argparse.Namespace | TargetOptions) -> bool:
    """Return whether the target is a .blend, whose cameras and lights Blender has to read."""
    return bool(args.to[0].suffix.lower() == ".blend")


def is_shot_file(options: TargetOptions) -> bool:
    """Return whether the target is a shot file, which holds its own edits."""
    return bool(options.to[0].suffix.lower() == ".json")


def shot_path(options: TargetOptions) -> Path:
    """Return the file that the Blender step writes the shot to; each range of frames has its own."""
    if options.shot:
        return options.shot
    suffix = options.frames or ""
    if not re.fullmatch(r"[\d,-]{0,60}", suffix):  # not a valid file name on every system
        suffix = hashlib.sha256(suffix.encode()).hexdigest()[:8]
    suffix = f".{suffix.replace(',', '_')}" if suffix else ""
    return options.out / f"shot{suffix}.json"


def _target_kind(target: Path) -> str:
    """Return the kind of a target, a key of TARGET_OPTIONS. Raises FrameError for an unsupported file."""
    from ..core.conventions.run_files import CONFIG

    suffix = target.suffix.lower()
    if suffix in SUFFIXES:
        return "picture"
    if target.is_file() and suffix not in TARGET_OPTIONS:
        raise unsupported_file_error(target)
    return suffix if suffix in TARGET_OPTIONS else "run" if (target / CONFIG).is_file() else "capture"


def check_options(options: TargetOptions, kind: str) -> None:
    """Raise SettingsError for an option that has no effect on this kind of target."""
    for name in dict.fromkeys(name for names in TARGET_OPTIONS.values() for name in names):
        value = getattr(options, name)
        # 0 is a default, but for --fall-off without a DISTANCE.
        if (value or (value == 0.0 and name == "fall_off")) and name not in TARGET_OPTIONS[kind]:
            raise SettingsError(f"--{name.replace('_', '-')} does not apply to a {kind} as the target; leave it out.")


def find_flare(args: argparse.Namespace) -> tuple[Path, list[Floats] | None]:
    """Return the .flare of FLARE, a file or a run, and the poses (4, 4), world to camera, of its training views.

    The views are those of --capture, else of the run's capture; None where there is neither.
    """
    from ..core.capture import Capture
    from ..core.conventions.run_files import FLARE
    from ..core.fit.run import Run

    capture, holdout = args.capture, None
    flare = args.flare
    if flare.is_dir():
        run_ = Run.open(flare)
        if not (flare / FLARE).is_file():
            raise RunError(run_.missing_flare_message)
        flare, holdout = flare / FLARE, run_.settings.holdout
        capture = capture or (run_.capture_folder if run_.capture_folder.is_dir() else None)
    if capture is None:
        return flare, None
    views, _ = Capture.open(capture, need_frames=False).split(holdout)
    return flare, [view.camera.world_to_camera for view in views]


def open_target(options: TargetOptions, flare: Path, training: list[Floats] | None = None) -> Target:
    """Open the target that --to names. training: poses of training views, for a .flare that does not store its own.

    Pictures, and a folder of them, have lights in 2D: those of --light, else highlights or lights that are detected.
    Other targets have cameras and lights in 3D.

    Raises SettingsError, CaptureError, FrameError and RunError.
    """
    from ..core.capture import Capture
    from ..core.conventions.run_files import SCENE
    from ..core.fit.run import Run
    from ..core.look import read_look
    from ..core.transfer.sources import parse_assignments
    from ..core.transfer.target import capture_target

    look, paths, sources = read_look(flare), list(options.to), parse_assignments(options.use)
    if len(paths) > 1 and not all(path.suffix.lower() in SUFFIXES for path in paths):
        raise SettingsError("Several targets at once have to be pictures.")
    if missing := next((path for path in paths if not path.exists()), None):
        raise CaptureError(f"{missing} is missing; name a target for the flare: pictures, a capture, a run, a .blend, "
                           "a PLY or a shot.")
    if len(paths) == 1 and _target_kind(paths[0]) == "capture" and _is_plate_folder(paths[0]):
        paths = pictures_in(paths[0])
    kind = _target_kind(paths[0])
    check_options(options, kind)
    if options.highlight_gain is not None and options.highlights is None:
        raise SettingsError("--highlight-gain is for --highlights; give both.")
    if kind == "picture":
        return _open_pictures(options, paths, look, sources, training)
    if kind in (".blend", ".json"):
        # The Blender step has written the shot file of a .blend.
        return _open_shot(options, shot_path(options) if kind == ".blend" else paths[0], look, sources)
    lights = Path(options.lights) if options.lights else None
    if kind == ".ply":
        if options.cameras is None:
            raise SettingsError(f"{paths[0]} is a scene without cameras; name a capture that has them with --cameras.")
        return capture_target(Capture.open(options.cameras, need_frames=False), look, sources, lights=lights,
                              scene=paths[0], scene_is_background=True)
    if kind == "run":
        capture = (Capture.open(options.cameras, need_frames=False) if options.cameras else
                   Run.open(paths[0]).open_capture(need_frames=False))
        return capture_target(capture, look, sources, lights=lights, scene=options.scene or paths[0] / SCENE,
                              scene_is_background=True)
    if paths[0].is_dir() and not any(paths[0].iterdir()):
        raise CaptureError(f"{paths[0]} is empty: neither pictures nor a capture; name a target for the flare.")
    return capture_target(Capture.open(paths[0]), look, sources, lights=lights, scene=options.scene)


def _open_pictures(options: TargetOptions, paths: list[Path], look: Look, sources: Mapping[str, str],
                   training: list[Floats] | None) -> Target:
    """Return the target of pictures. sources: light of the flare by light of the target, from --use. training: poses of
    training views, for a .flare that does not store its own. Raises SettingsError."""
    from ..core.colour import colour_space
    from ..core.lights.detection import Detector
    from ..core.lights.exposure import ExposureDetector
    from ..core.transfer.highlights import HIGHLIGHTS_LIGHT
    from ..core.transfer.query import training_views
    from ..core.transfer.target import picture_target

    views = training_views(look.path, look.lights, training)
    distances = {light.name: _median_distance(light, views.get(light.name)) for light in look.lights}
    if options.highlights is not None and options.light:
        raise SettingsError("--highlights takes the lights from the plates; leave --light out.")
    # The transfer moves this one light to the highlights of each plate; its pixel here has no meaning.
    positions = {HIGHLIGHTS_LIGHT: (0.5, 0.5)} if options.highlights is not None else _parse_lights(options.light)
    detector: Detector | None = None if positions else ExposureDetector()
    centre = _parse_point(options.centre) if options.centre else None
    space = None if options.plate_space == "auto" else colour_space(options.plate_space, options.ocio)
    return picture_target(paths, look, positions, sources, distances, detector=detector, focal=options.focal,
                          centre=centre, space=space, training=views)


def _open_shot(options: TargetOptions, path: Path, look: Look, sources: Mapping[str, str]) -> Target:
    """Return the target of a shot file. sources: light of the flare by light of the target. Raises SettingsError."""
    from ..core.conventions.frame_numbers import NumberedFrame, select_task_frames
    from ..core.look.shot import Shot
    from ..core.transfer.target import shot_target

    shot = Shot.read(path)
    frames = [NumberedFrame(view="", number=number, file="")
              for number in sorted({shot_frame.frame for shot_frame in shot.frames})]
    selected = select_task_frames(frames, options.frames, options.job_frames)
    return shot_target(shot, look, sources, plates=options.plates, scene=options.scene,
                       required_frames={frame.number for frame in selected})


def left_out(options: TargetOptions, target: Target) -> list[tuple[str, list[str]]]:
    """Return the names of the pictures and files in the target that get no flare, by reason."""
    from ..core.images.listing import unlisted_entries

    folder = options.to[0]
    is_folder = len(options.to) == 1 and folder.is_dir() and _is_plate_folder(folder)
    unlit = [frame.plate.name for frame in target.frames if frame.plate is not None and not frame.shot.lights]
    return [*(unlisted_entries(folder) if is_folder else ()), ("shows no light, so it has no flare", unlit)]


def _is_plate_folder(folder: Path) -> bool:
    """Return whether a folder holds pictures themselves and is not a capture."""
    capture = any((folder / name).exists() for name in ("images", "sparse", "colmap", "transforms.json"))
    return folder.is_dir() and not capture and bool(pictures_in(folder))


def _median_distance(light: LightLook, views: TrainingViews | None) -> float:
    """Return the median distance of the training cameras to a light, in world units.

    views: None where they are unknown; then it is the distance from the middle of the training cameras' range.
    """
    import numpy as np

    if views is not None:
        return float(np.median(views.distances))
    query_range = light.query_range
    return float(np.linalg.norm((query_range.camera_low + query_range.camera_high) / 2 - light.xyz)) or 1.0


def _parse_lights(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Parse the values "[name=]x,y" of --light; return the positions, px, by the light's name. Raises SettingsError.

    A light without a name gets light1, light2, ... by its number among the values.
    """
    positions: dict[str, tuple[float, float]] = {}
    for number, text in enumerate(texts, 1):
        prefix, equals, position_text = text.rpartition("=")
        name = prefix.strip() if equals else f"light{number}"
        if name in positions:
            raise SettingsError(f"--light names {name!r} twice; give each light a name of its own.")
        positions[name] = _parse_point(position_text)
    return positions


def _parse_point(text: str) -> tuple[float, float]:
    """Parse "x,y" in pixels. Raises SettingsError."""
    try:
        x, y = (float(part) for part in text.split(","))
        if not (math.isfinite(x) and math.isfinite(y)):
            raise ValueError(text)
    except ValueError:
        raise SettingsError(f"{text!r} is not a position in pixels such as 640,360.") from None
    return x, y
