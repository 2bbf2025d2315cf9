# SPDX-License-Identifier: GPL-3.0-or-later
"""transfer: a flare on to other footage."""
from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ...core.choices import Follows
from ...core.errors import SettingsError
from ...core.system.progress import Progress
from .. import frames, jobs, layers, targets
from ..command import Command, Step, from_1

if TYPE_CHECKING:
    from ...core.capture.camera import Floats
    from ...core.transfer.target import Target

MOST_SMOOTH = 1000  # frames


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flare", type=Path, metavar="FLARE", help="a .flare, or the folder of a run")
    parser.add_argument("--to", type=Path, nargs="+", required=True, metavar="TARGET",
                        help="pictures; or a capture; a run (its scene is shown); a 3DGS PLY with --cameras; a .blend; "
                             "a shot (JSON)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR",
                        help="folder for layers.####.exr, and frames/ with the plates under their own names")
    parser.add_argument("--query", choices=get_args(Follows), default="blend",
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


def look_at_blend(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Blender's part: the .blend's camera, lights and what hides them, written down for the engine."""
    from ...core.conventions.frame_numbers import Frame, chosen
    from ...core.conventions.run_files import FLARE
    from ...core.look import read
    from ...flare_addon.capture.blend_shot import opened, shot_of

    if len(words.to) > 1:
        raise SettingsError("One .blend at a time can be the target.")
    _check_numbers(words)
    targets.check_options(words, ".blend")
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
    shot.write(targets.shot_path(words))
    return {"shot": str(targets.shot_path(words))}


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    _check_numbers(words)
    flare, training = targets.source(words)
    return make_layers(words, "transfer", targets.target_of(words, flare, training), flare, training, progress)


def _check_numbers(words: argparse.Namespace) -> None:
    """Raises SettingsError for what is no sensible number."""
    if not 0 <= words.smooth <= MOST_SMOOTH or not 0 < words.scale < math.inf:
        raise SettingsError(f"--smooth is from 0 to {MOST_SMOOTH}, and --scale a number above 0.")
    if words.focal is not None and not 0 < words.focal < math.inf:
        raise SettingsError(f"--focal {words.focal} is not a length in pixels above 0.")
    if not 0 <= words.radius < math.inf:
        raise SettingsError(f"--radius {words.radius} is not a length of 0 or more.")


def make_layers(words: argparse.Namespace, step: str, target: Target, flare: Path, training: list[Floats] | None,
                progress: Progress) -> dict[str, Any]:
    """Of a target, under a command's step of that name. training: as of `targets.target_of`."""
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
        extra = ["--shot", str(targets.shot_path(words))] if targets.is_blend(words) else []
        jobs.run_jobs(words, step, [frame.number for frame in wanted], progress, extra)
    record = transfer.bake(words.out, wanted, layers.settings(words), progress, overwrite=words.overwrite)
    return layers.told(wanted, words.out, len(record["frames"]), progress)


COMMAND = Command(
    "transfer", "Puts a flare on to other footage: pictures, captures, splats, Blender scenes.",
    """Writes EXR layers as `bake` does, and DIR/frames with the plates as they are, flare added; where the flare does
not reach, a plate keeps its own numbers to the last bit. Hidden lights, and lights behind the camera, give no
flare. A run as the target, or a PLY with --cameras, is rendered; a .blend is looked at by Blender, for its
camera, its lights, and what hides them.

  run.py transfer lamp.flare --to plate.exr --light 1210,340 --out build/plate
  run.py transfer lamp.flare --to shots/sh010 --scene sh010.ply --out build/sh010 --use sun=lamp
  run.py transfer lamp.flare --to shot.blend --plates renders --out build/shot --jobs 2""",
    arguments, (Step("look", "blender", look_at_blend, wanted=targets.is_blend), Step("transfer", "engine", run)),
    after_a_stop="goes on")
