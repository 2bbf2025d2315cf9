# SPDX-License-Identifier: GPL-3.0-or-later
"""transfer: a flare on to other footage."""
from __future__ import annotations

import argparse
import hashlib
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import CaptureError, RunError, SettingsError
from ...core.progress import Progress
from .. import frames, jobs, layers
from ..command import Command, Step, from_1

if TYPE_CHECKING:
    from ...core.capture.camera import Floats
    from ...core.look.look import LightLook
    from ...core.transfer.query import Seen
    from ...core.transfer.target import Target

MOST_SMOOTH = 1000  # frames
QUERIES = ("source", "target", "blend")
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flare", type=Path, metavar="FLARE", help="a .flare, or the folder of a run")
    parser.add_argument("--to", type=Path, nargs="+", required=True, metavar="TARGET",
                        help="pictures; or a capture; a run (its scene is shown); a 3DGS PLY with --cameras; a .blend; "
                             "a shot (JSON)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR",
                        help="folder for layers.####.exr, and frames/ with the plates under their own names")
    parser.add_argument("--query", choices=QUERIES, default="blend",
                        help="what the flare's appearance follows: one training view (source), the target's view "
                             "(target), or the target's view kept inside what was trained (blend, the default)")
    frames.add_option(parser)
    parser.add_argument("--size", metavar="WIDTH[xHEIGHT]", help="pixels (default: the target's)")
    looks = parser.add_argument_group("lights")
    looks.add_argument("--light", action="append", default=[], metavar="[NAME=]X,Y",
                       help="on to a picture: a light in pixels, in the frame or not; repeatable (default: found by "
                            "exposure)")
    looks.add_argument("--lights", metavar="FILE|NAMES",
                       help="a lights.json instead of the capture's; or names of objects of the .blend, with commas "
                            "between (default: its lamps)")
    looks.add_argument("--use", action="append", default=[], metavar="LIGHT=SOURCE",
                       help="the light of the target that shows the look of this light of the flare; repeatable "
                            "(default: by name, else in turn)")
    looks.add_argument("--smooth", type=int, default=1, metavar="FRAMES",
                       help="frames over which a light fades where it is hidden, on paths (default 1, 0 for none)")
    looks.add_argument("--radius", type=float, default=0.0, metavar="UNITS",
                       help="of the lights of a .blend, for the soft edge (default: the lamp's, else 2%% of the "
                            "distance)")
    looks.add_argument("--scale", type=float, default=1.0, metavar="X",
                       help="units of the target's world to one of the source's (default 1)")
    cameras = parser.add_argument_group("cameras and scenes")
    cameras.add_argument("--cameras", type=Path, metavar="CAPTURE", help="whose cameras see the 3DGS PLY")
    cameras.add_argument("--scene", type=Path, metavar="PLY", help="3DGS scene in the target's world that hides lights")
    cameras.add_argument("--focal", type=float, metavar="PIXELS",
                         help="of a picture (default: the field of view of the source's camera)")
    cameras.add_argument("--centre", metavar="X,Y", help="principal point of a picture, pixels (default: the middle)")
    cameras.add_argument("--capture", type=Path, metavar="CAPTURE",
                         help="what the flare was fitted to, for a .flare that does not tell what it was trained on")
    plates = parser.add_argument_group("plates and layers")
    plates.add_argument("--plates", type=Path, metavar="DIR", help="pictures for the frames of a .blend or a shot")
    plates.add_argument("--plate-space", default="auto", metavar="NAME",
                        help="colour space of the plates: srgb, rec709, linear, acescg, … or one of an OpenColorIO "
                             "configuration (default: an EXR's by its chromaticities, linear for float TIFFs, sRGB for "
                             "other files)")
    layers.add_options(plates, halfs="if no plate has more", overwritten="transfer",
                       edited="edits of the look, as of `bake`, by the target's lights; repeatable")
    parser.add_argument("--shot", type=Path, help=argparse.SUPPRESS)
    jobs.add_option(parser)


def is_blend(words: argparse.Namespace) -> bool:
    """Whether Blender has to be asked."""
    return bool(words.to[0] is not None and words.to[0].suffix.lower() == ".blend")


def look_at_blend(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Blender's part: the .blend's camera, lights and what hides them, written down for the engine."""
    from ...core.bake.frames import Frame, chosen
    from ...core.look import read
    from ...flare_addon.blend_shot import opened, shot_of
    from ...flare_addon.fits import FLARE

    if len(words.to) > 1:
        raise SettingsError("One .blend at a time can be the target.")
    _check_numbers(words)
    _check_options(words, ".blend")
    layers.size(words.size)
    from_1("--jobs", words.jobs)
    flare = words.flare.resolve()
    if flare.is_dir():
        flare /= FLARE
    read(flare)
    scene = opened(words.to[0])
    every = range(scene.frame_start, scene.frame_end + 1)
    # Neighbours too: the share of a light is smoothed over them, and a chunk must come out as the whole does.
    wanted = {frame.number for frame in chosen([Frame("", number, "") for number in every], words.frames)}
    around = range(-2 * words.smooth, 2 * words.smooth + 1)
    looked_at = [number for number in every if any(number + step in wanted for step in around)]
    if words.query == "source":
        looked_at = list(every)  # whose middle chooses the training view
    names = [name.strip() for name in (words.lights or "").split(",") if name.strip()]
    progress.stage("look at the .blend", len(looked_at))
    shot = shot_of(scene, flare, names, looked_at, radius=words.radius, done=progress.advance)
    shot.write(shot_path(words))
    return {"shot": str(shot_path(words))}


def shot_path(words: argparse.Namespace) -> Path:
    """Where Blender's part leaves the shot; chunks of one shot each have their own."""
    if words.shot:
        return Path(words.shot)
    part = words.frames or ""
    if not re.fullmatch(r"[\d,-]{0,60}", part):  # no file has such a name everywhere
        part = hashlib.sha256(part.encode()).hexdigest()[:8]
    part = f".{part.replace(',', '_')}" if part else ""
    return Path(words.out) / f"shot{part}.json"


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    _check_numbers(words)
    flare, training = source(words)
    return make_layers(words, "transfer", target_of(words, flare, training), flare, training, progress)


def _check_numbers(words: argparse.Namespace) -> None:
    """Raises SettingsError for what is no sensible number."""
    if not 0 <= words.smooth <= MOST_SMOOTH or not 0 < words.scale < math.inf:
        raise SettingsError(f"--smooth is from 0 to {MOST_SMOOTH}, and --scale a number above 0.")
    if words.focal is not None and not 0 < words.focal < math.inf:
        raise SettingsError(f"--focal {words.focal} is not a length in pixels above 0.")
    if not 0 <= words.radius < math.inf:
        raise SettingsError(f"--radius {words.radius} is not a length of 0 or more.")


OPTIONS = {"picture": ("light", "focal", "centre"), ".blend": ("lights", "scene", "plates", "radius"),
           ".json": ("scene", "plates"), ".ply": ("lights", "cameras"), "run": ("lights", "scene", "cameras"),
           "capture": ("lights", "scene")}
"""By kind of target those that it has a use for, of all that are for some alone."""


def _kind(target: Path) -> str:
    """Of OPTIONS."""
    from ...core.fit.run import CONFIG

    suffix = target.suffix.lower()
    if suffix in PICTURES:
        return "picture"
    return suffix if suffix in OPTIONS else "run" if (target / CONFIG).is_file() else "capture"


def _check_options(words: argparse.Namespace, kind: str) -> None:
    """Raises SettingsError for an option that the kind of target has no use for: who gives it believes that it does
    something."""
    for name in dict.fromkeys(name for names in OPTIONS.values() for name in names):
        if getattr(words, name) and name not in OPTIONS[kind]:
            raise SettingsError(f"--{name} is not for a {kind} as the target; leave it out.")


def make_layers(words: argparse.Namespace, step: str, target: Target, flare: Path, training: list[Floats] | None,
          progress: Progress) -> dict[str, Any]:
    """The layers of a target."""
    from ...core.transfer.target import sized
    from ...core.transfer.transfer import Transfer, TransferSettings

    for sentence in target.says:
        progress.say(sentence)
    target = sized(target, *layers.size(words.size))
    plates = [one for one in target.frames if one.plate is not None]
    if unwritten := sum(one.flared(words.out) is None for one in plates):
        progress.say(f"{unwritten} of {len(plates)} plates are not written with their flare, only its layers are: they "
                     "are of another size than is rendered, or distorted by a lens.")
    settings = TransferSettings(words.query, words.scale, words.smooth, words.plate_space)
    transfer = Transfer(flare, target, settings, training, words.ocio)
    wanted = frames.asked([one.frame for one in target.frames], words.frames, progress)
    if words.jobs != 1:
        extra = ["--shot", str(shot_path(words))] if is_blend(words) else []
        jobs.run_jobs(words, step, [frame.number for frame in wanted], progress, extra)
    record = transfer.bake(words.out, wanted, layers.settings(words), progress, overwrite=words.overwrite)
    return layers.told(wanted, words.out, len(record["frames"]), progress)


def source(words: argparse.Namespace) -> tuple[Path, list[Floats] | None]:
    """The .flare, and the poses of its training views where they can be had."""
    from ...core.capture import Capture
    from ...core.fit.run import FLARE, Run

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
    from ...core.bake.frames import Frame, chosen
    from ...core.capture import Capture
    from ...core.fit.run import SCENE, Run
    from ...core.lights.detection import Detector
    from ...core.lights.exposure import Exposure
    from ...core.look import read
    from ...core.look.shot import Shot
    from ...core.pictures import pictures_in
    from ...core.transfer import target as targets
    from ...core.transfer.query import seen_by
    from ...core.transfer.sources import parsed

    look, to, wanted = read(flare), words.to, parsed(words.use)
    if len(to) > 1 and not all(path.suffix.lower() in PICTURES for path in to):
        raise SettingsError("Several targets at once have to be pictures.")
    if missing := next((path for path in to if not path.exists()), None):
        raise CaptureError(f"{missing} is missing; name what the flare goes on to: pictures, a capture, a run, a "
                           ".blend, a PLY or a shot.")
    if len(to) == 1 and _kind(to[0]) == "capture" and _is_of_plates(to[0]):
        to = pictures_in(to[0])
    kind = _kind(to[0])
    _check_options(words, kind)
    if kind == "picture":
        seen = seen_by(flare, look.lights, training)
        distances = {light.name: _usual_distance(light, seen.get(light.name)) for light in look.lights}
        detector: Detector | None = None if words.light else Exposure()
        return targets.of_pictures(to, look, _points(words.light), wanted, distances, detector=detector,
                                   focal=words.focal, centre=_point(words.centre) if words.centre else None, seen=seen)
    if kind in (".blend", ".json"):
        path = shot_path(words) if kind == ".blend" else to[0]
        shot = Shot.read(path)
        numbers = [Frame("", number, "") for number in sorted({one.frame for one in shot.frames})]
        return targets.of_shot(shot, look, wanted, plates=words.plates, scene=words.scene,
                               wanted_frames={frame.number for frame in chosen(numbers, words.frames)})
    lights = Path(words.lights) if words.lights else None
    if kind == ".ply":
        if words.cameras is None:
            raise SettingsError(f"{to[0]} is a scene without cameras; name a capture that has them with --cameras.")
        return targets.of_capture(Capture.open(words.cameras, need_frames=False), look, wanted, lights=lights,
                                  scene=to[0], shown=True)
    if kind == "run":
        capture = (Capture.open(words.cameras, need_frames=False) if words.cameras else
                   Run.open(to[0]).capture(need_frames=False))
        return targets.of_capture(capture, look, wanted, lights=lights, scene=words.scene or to[0] / SCENE, shown=True)
    if to[0].is_dir() and not any(to[0].iterdir()):
        raise CaptureError(f"{to[0]} is empty: neither pictures nor a capture; name what the flare goes on to.")
    return targets.of_capture(Capture.open(to[0]), look, wanted, lights=lights, scene=words.scene)


def _is_of_plates(folder: Path) -> bool:
    """Whether it is a folder that holds pictures themselves, not a capture."""
    from ...core.pictures import pictures_in

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


COMMAND = Command(
    "transfer", "Puts a flare on to other footage: pictures, captures, splats, Blender scenes.",
    """Writes EXR layers as `bake` does, and DIR/frames with the plates as they are, flare added; where the flare does
not reach, a plate keeps its own numbers to the last bit. Hidden lights, and lights behind the camera, give no
flare. A run as the target, or a PLY with --cameras, is rendered; a .blend is looked at by Blender, for its
camera, its lights, and what hides them.

  run.py transfer lamp.flare --to plate.exr --light 1210,340 --out build/plate
  run.py transfer lamp.flare --to shots/sh010 --scene sh010.ply --out build/sh010 --use sun=lamp
  run.py transfer lamp.flare --to shot.blend --plates renders --out build/shot --jobs 2""",
    arguments, (Step("look", "blender", look_at_blend, wanted=is_blend), Step("transfer", "engine", run)),
    after_a_stop="goes on")
