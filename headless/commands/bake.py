# SPDX-License-Identifier: GPL-3.0-or-later
"""bake: a run's views as multilayer EXR files."""
from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from ...core.errors import RunError, SettingsError
from ...core.progress import Progress
from .. import frames, jobs
from ..command import Command, Step


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN_OR_FLARE",
                        help="folder that `fit` has written; or a .flare, with --capture or --blend; or a shot: a JSON "
                             "file of cameras and lights by frame, as the add-on writes it (core/look/shot.py)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for layers.####.exr")
    frames.add_option(parser)
    parser.add_argument("--size", metavar="WIDTH[xHEIGHT]", help="pixels (default: the frames')")
    parser.add_argument("--set", action="append", default=[], metavar="LIGHT.WHAT=VALUE", dest="edits",
                        help="lamp.intensity=2, lamp.tint=1,0.8,0.6, lamp.tint=#ffcc88, lamp.scale=1.5; * for all "
                             "lights, lamp/ghost for one element; also saturation, spread, rotation (degrees), streak, "
                             "mute, solo; repeatable")
    parser.add_argument("--edits", type=Path, metavar="FILE", dest="keyed",
                        help='edits by frame (JSON or TOML): {"frames": {"1": ["lamp.intensity=0"], '
                             '"25": ["lamp.intensity=1"]}}')
    parser.add_argument("--float", action="store_true", help="32 bit floats (default: 16 bit, depth always 32)")
    parser.add_argument("--overwrite", action="store_true",
                        help="replace layers of another bake in DIR (whole ones of the same settings are kept)")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE",
                        help="where the capture is, if it was moved; of a .flare: whose cameras see it, the lights "
                             "where it was learned")
    parser.add_argument("--blend", type=Path, metavar="FILE",
                        help="of a .flare: a .blend, whose camera and lights it is shown for, behind what hides them")
    parser.add_argument("--scene", type=Path, metavar="PLY", help="of a .flare: a 3DGS scene that hides its lights")
    parser.add_argument("--lights", metavar="NAMES", help="objects of the .blend that are lights (default: its lamps)")
    parser.add_argument("--shot", type=Path, help=argparse.SUPPRESS)
    space_options(parser)
    jobs.add_option(parser)


def space_options(parser: argparse.ArgumentParser) -> None:
    """--space and --ocio."""
    parser.add_argument("--space", default="linear", metavar="NAME",
                        help="linear colour space of the layers: linear (Rec. 709, the default), acescg, aces2065-1, "
                             "rec2020, p3-d65, or one of an OpenColorIO configuration")
    parser.add_argument("--ocio", metavar="CONFIG",
                        help="OpenColorIO configuration to look names up in (else the variable OCIO, for other names)")


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from ...core.bake.bake import BakeSettings, bake
    from ...core.bake.frames import numbered
    from ...core.fit.run import Run
    from ...core.look import KeyedEdits

    if words.run.suffix.lower() == ".json":
        return run_shot(words, progress)
    if words.run.suffix.lower() == ".flare":
        from .transfer import bake_flare

        return bake_flare(words, progress)
    if words.scene or words.lights:
        raise SettingsError(f"--{'scene' if words.scene else 'lights'} is for a .flare: name the run's flare.flare.")
    made = Run.open(words.run)
    if not made.finished:
        raise RunError(f"{words.run} is not finished; go on with it by `fit --resume` first.")
    capture = made.capture(words.capture, need_frames=False)
    cameras = {view.name: view.camera for view in capture.views}
    wanted = frames.asked(numbered(cameras), words.frames, progress)
    if words.jobs != 1:
        jobs.run_jobs(words, "bake", [frame.number for frame in wanted], progress)
    settings = BakeSettings(*size(words.size), half=not words.float, edits=tuple(words.edits),
                            keyed=KeyedEdits.read(words.keyed) if words.keyed else KeyedEdits(), space=words.space,
                            config=words.ocio)
    record = bake(made, wanted, cameras, words.out, settings, progress, overwrite=words.overwrite)
    return frames.layers_made(wanted, words.out, len(record["frames"]), progress)


def look(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Blender's part of a bake for a .blend."""
    from .transfer import look_at_blend, words_of_bake

    if words.run.suffix.lower() != ".flare":
        raise SettingsError("--blend is for a .flare: name the run's flare.flare.")
    return look_at_blend(words_of_bake(words), progress)


def run_shot(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """A shot's layers; its edits are in the file."""
    from ...core.bake.frames import Frame
    from ...core.bake.shot import bake_shot
    from ...core.look.shot import Shot

    if words.edits or words.keyed:
        raise SettingsError("The edits of a shot stand in its file; --set and --edits are for runs.")
    for name in ("scene", "lights", "capture", "blend"):
        if getattr(words, name):
            raise SettingsError(f"--{name} is not for a shot, whose file says all; leave it out.")
    shot = Shot.read(words.run).sized(*size(words.size))
    wanted = frames.asked([Frame("", one.frame, "") for one in shot.frames], words.frames, progress)
    if words.jobs != 1:
        jobs.run_jobs(words, "bake", [frame.number for frame in wanted], progress)
    record = bake_shot(shot, words.out, half=not words.float, overwrite=words.overwrite, progress=progress,
                       wanted={frame.number for frame in wanted}, space=words.space, config=words.ocio)
    return frames.layers_made(wanted, words.out, len(record["frames"]), progress)


def size(text: str | None) -> tuple[int | None, int | None]:
    """"960x540" as (960, 540), "960" as (960, None), None as (None, None)."""
    if text is None:
        return None, None
    match = re.fullmatch(r"([1-9]\d{0,4})(?:x([1-9]\d{0,4}))?", text)
    if not match:
        raise SettingsError(f"--size {text} is not a width such as 960, or a size such as 960x540.")
    return int(match[1]), int(match[2]) if match[2] else None


COMMAND = Command(
    "bake", "Renders a run, a .flare or a shot to EXR layers.",
    """Writes one multilayer EXR a frame, scene-linear Rec. 709: composite at the root, scene, flare,
flare_<light>, depth. scene + flare = composite, and the lights sum to the flare, so add them up in any
compositor. Frames already made with the same settings are kept.

  run.py bake build/desk --out build/layers --frames 1-20 --set lamp.intensity=2""",
    arguments, (Step("look", "blender", look, wanted=lambda words: words.blend is not None),
                Step("bake", "engine", run)), after_a_stop="goes on")
