# SPDX-License-Identifier: GPL-3.0-or-later
"""What a flare goes on to, and where it comes from: the words of `transfer`, and of `bake` for a .flare, as a target of
`core.transfer`."""
from __future__ import annotations

import argparse
import hashlib
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import CaptureError, RunError, SettingsError
from ..core.images.listing import SUFFIXES, pictures_in
from ..core.images.unsupported import unsupported_file

if TYPE_CHECKING:
    from ..core.capture.camera import Floats
    from ..core.look.look import LightLook
    from ..core.transfer.query import Seen
    from ..core.transfer.target import Target

OPTIONS = {"picture": ("light", "focal", "centre"), ".blend": ("lights", "scene", "plates", "radius"),
           ".json": ("scene", "plates"), ".ply": ("lights", "cameras"), "run": ("lights", "scene", "cameras"),
           "capture": ("lights", "scene")}
"""By kind of target those that it has a use for, of all that are for some alone."""


def is_blend(words: argparse.Namespace) -> bool:
    """Whether Blender has to be asked."""
    return bool(words.to[0].suffix.lower() == ".blend")


def shot_path(words: argparse.Namespace) -> Path:
    """Where Blender's part leaves the shot; chunks of one shot each have their own."""
    if words.shot:
        return Path(words.shot)
    part = words.frames or ""
    if not re.fullmatch(r"[\d,-]{0,60}", part):  # no file has such a name everywhere
        part = hashlib.sha256(part.encode()).hexdigest()[:8]
    part = f".{part.replace(',', '_')}" if part else ""
    return Path(words.out) / f"shot{part}.json"


def _kind(target: Path) -> str:
    """Of OPTIONS. FrameError for a file of no kind of those."""
    from ..core.conventions.run_files import CONFIG

    suffix = target.suffix.lower()
    if suffix in SUFFIXES:
        return "picture"
    if target.is_file() and suffix not in OPTIONS:
        raise unsupported_file(target)
    return suffix if suffix in OPTIONS else "run" if (target / CONFIG).is_file() else "capture"


def check_options(words: argparse.Namespace, kind: str) -> None:
    """Raises SettingsError for an option that the kind of target has no use for: who gives it believes that it does
    something."""
    for name in dict.fromkeys(name for names in OPTIONS.values() for name in names):
        if getattr(words, name) and name not in OPTIONS[kind]:
            raise SettingsError(f"--{name} is not for a {kind} as the target; leave it out.")


def source(words: argparse.Namespace) -> tuple[Path, list[Floats] | None]:
    """The .flare, and the poses of its training views where they can be had."""
    from ..core.capture import Capture
    from ..core.conventions.run_files import FLARE
    from ..core.fit.run import Run

    capture, holdout = words.capture, None
    flare = words.flare
    if flare.is_dir():
        made = Run.open(flare)
        if not (flare / FLARE).is_file():
            raise RunError(made.without_flare)
        flare, holdout = flare / FLARE, made.settings.holdout
        capture = capture or (made.capture_folder if made.capture_folder.is_dir() else None)
    if capture is None:
        return flare, None
    views, _ = Capture.open(capture, need_frames=False).split(holdout)
    return flare, [view.camera.world_to_camera for view in views]


def target_of(words: argparse.Namespace, flare: Path, training: list[Floats] | None = None) -> Target:
    """The target, by what --to names. training: poses, for a .flare that does not tell."""
    from ..core.capture import Capture
    from ..core.conventions.frame_numbers import Frame, chosen
    from ..core.conventions.run_files import SCENE
    from ..core.fit.run import Run
    from ..core.lights.detection import Detector
    from ..core.lights.exposure import Exposure
    from ..core.look import read
    from ..core.look.shot import Shot
    from ..core.transfer.query import seen_by
    from ..core.transfer.sources import parsed
    from ..core.transfer.target import of_capture, of_pictures, of_shot

    look, to, wanted = read(flare), words.to, parsed(words.use)
    if len(to) > 1 and not all(path.suffix.lower() in SUFFIXES for path in to):
        raise SettingsError("Several targets at once have to be pictures.")
    if missing := next((path for path in to if not path.exists()), None):
        raise CaptureError(f"{missing} is missing; name what the flare goes on to: pictures, a capture, a run, a "
                           ".blend, a PLY or a shot.")
    if len(to) == 1 and _kind(to[0]) == "capture" and _is_of_plates(to[0]):
        to = pictures_in(to[0])
    kind = _kind(to[0])
    check_options(words, kind)
    if kind == "picture":
        seen = seen_by(flare, look.lights, training)
        distances = {light.name: _usual_distance(light, seen.get(light.name)) for light in look.lights}
        detector: Detector | None = None if words.light else Exposure()
        return of_pictures(to, look, _points(words.light), wanted, distances, detector=detector, focal=words.focal,
                           centre=_point(words.centre) if words.centre else None, seen=seen)
    if kind in (".blend", ".json"):
        path = shot_path(words) if kind == ".blend" else to[0]
        shot = Shot.read(path)
        numbers = [Frame("", number, "") for number in sorted({one.frame for one in shot.frames})]
        return of_shot(shot, look, wanted, plates=words.plates, scene=words.scene,
                       wanted_frames={frame.number for frame in chosen(numbers, words.frames)})
    lights = Path(words.lights) if words.lights else None
    if kind == ".ply":
        if words.cameras is None:
            raise SettingsError(f"{to[0]} is a scene without cameras; name a capture that has them with --cameras.")
        return of_capture(Capture.open(words.cameras, need_frames=False), look, wanted, lights=lights, scene=to[0],
                          shown=True)
    if kind == "run":
        capture = (Capture.open(words.cameras, need_frames=False) if words.cameras else
                   Run.open(to[0]).capture(need_frames=False))
        return of_capture(capture, look, wanted, lights=lights, scene=words.scene or to[0] / SCENE, shown=True)
    if to[0].is_dir() and not any(to[0].iterdir()):
        raise CaptureError(f"{to[0]} is empty: neither pictures nor a capture; name what the flare goes on to.")
    return of_capture(Capture.open(to[0]), look, wanted, lights=lights, scene=words.scene)


def _is_of_plates(folder: Path) -> bool:
    """Whether it is a folder that holds pictures themselves, not a capture."""
    capture = any((folder / name).exists() for name in ("images", "sparse", "colmap", "transforms.json"))
    return folder.is_dir() and not capture and bool(pictures_in(folder))


def _usual_distance(light: LightLook, seen: Seen | None) -> float:
    """From which training saw a light, in the middle."""
    import numpy as np

    if seen is not None:
        return float(np.median(seen.distances))
    reach = light.query_range
    return float(np.linalg.norm((reach.camera_low + reach.camera_high) / 2 - light.xyz)) or 1.0


def _points(words: list[str]) -> dict[str, tuple[float, float]]:
    """"[name=]x,y" by name."""
    found: dict[str, tuple[float, float]] = {}
    for number, word in enumerate(words, 1):
        given, equals, place = word.rpartition("=")
        name = given.strip() if equals else f"light{number}"
        if name in found:
            raise SettingsError(f"--light names {name!r} twice; give each light a name of its own.")
        found[name] = _point(place)
    return found


def _point(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
        if not (math.isfinite(x) and math.isfinite(y)):
            raise ValueError(text)
    except ValueError:
        raise SettingsError(f"{text!r} is not a place in pixels such as 640,360.") from None
    return x, y
