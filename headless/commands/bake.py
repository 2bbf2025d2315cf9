# SPDX-License-Identifier: GPL-3.0-or-later
"""bake: a run's views as multilayer EXR files."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ...core.errors import RunError, SettingsError
from ...core.system.progress import Progress
from .. import frames, jobs, layers, targets
from ..command import Command, Step
from . import transfer


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN_OR_FLARE",
                        help="folder that `fit` has written; or a .flare, with --capture or --blend; or a shot: a JSON "
                             "file of cameras and lights by frame, as the add-on writes it (core/look/shot.py)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for layers.####.exr")
    frames.add_option(parser)
    parser.add_argument("--size", metavar="WIDTH[xHEIGHT]", help="pixels (default: the frames')")
    layers.add_options(
        parser, halfs="depth always 32", overwritten="bake",
        edited="lamp.intensity=2, lamp.tint=1,0.8,0.6, lamp.tint=#ffcc88, lamp.scale=1.5; * for all lights, lamp/ghost "
               "for one element; also saturation, spread, rotation (degrees), streak, mute, solo; repeatable")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE",
                        help="where the capture is, if it was moved; of a .flare: whose cameras see it, the lights "
                             "where it was learned")
    parser.add_argument("--blend", type=Path, metavar="FILE",
                        help="of a .flare: a .blend, whose camera and lights it is shown for, behind what hides them")
    parser.add_argument("--scene", type=Path, metavar="PLY", help="of a .flare: a 3DGS scene that hides its lights")
    parser.add_argument("--lights", metavar="NAMES", help="objects of the .blend that are lights (default: its lamps)")
    parser.add_argument("--shot", type=Path, help=argparse.SUPPRESS)
    jobs.add_option(parser)


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from ...core.bake.bake import bake
    from ...core.conventions.frame_numbers import numbered
    from ...core.fit.run import Run

    if words.run.suffix.lower() == ".json":
        return run_shot(words, progress)
    if words.run.suffix.lower() == ".flare":
        return run_flare(words, progress)
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
    settings = layers.settings(words, *layers.size(words.size))
    record = bake(made, wanted, cameras, words.out, settings, progress, overwrite=words.overwrite)
    return layers.told(wanted, words.out, len(record["frames"]), progress)


def look(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Blender's part of a bake for a .blend."""
    if words.run.suffix.lower() != ".flare":
        raise SettingsError("--blend is for a .flare: name the run's flare.flare.")
    return transfer.look_at_blend(_as_transfer(words), progress)


def run_flare(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """A .flare's layers: with the cameras of a capture, the lights where it was learned; or for a .blend."""
    from ...core.capture import Capture
    from ...core.look import read
    from ...core.transfer.target import of_cameras

    if words.blend is None and words.capture is None:
        raise SettingsError(f"{words.run} has no cameras of its own; name a capture with --capture, or a .blend with "
                            "--blend.")
    if words.lights and words.blend is None:
        raise SettingsError("--lights names objects of a .blend: it goes with --blend.")
    asked = _as_transfer(words)
    if words.blend is not None:
        target = targets.target_of(asked, words.run)
    else:
        target = of_cameras(Capture.open(words.capture, need_frames=False), read(words.run), words.scene)
    return transfer.make_layers(asked, "bake", target, words.run, None, progress)


def _as_transfer(words: argparse.Namespace) -> argparse.Namespace:
    """What is asked of a .flare, in transfer's words. Raises SettingsError where two things name cameras."""
    if words.blend is not None and words.capture is not None:
        raise SettingsError("--capture and --blend each name cameras for the flare; give one of them.")
    parser = argparse.ArgumentParser()
    transfer.arguments(parser)
    usual = parser.parse_args([str(words.run), "--to", str(words.blend or words.capture), "--out", str(words.out)])
    return argparse.Namespace(**{**vars(usual), **vars(words)})


def run_shot(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """A shot's layers; its edits are in the file."""
    from ...core.bake.shot import bake_shot
    from ...core.conventions.frame_numbers import Frame
    from ...core.look.shot import Shot

    if words.edits or words.keyed:
        raise SettingsError("The edits of a shot stand in its file; --set and --edits are for runs.")
    for name in ("scene", "lights", "capture", "blend"):
        if getattr(words, name):
            raise SettingsError(f"--{name} is not for a shot, whose file says all; leave it out.")
    shot = Shot.read(words.run).sized(*layers.size(words.size))
    wanted = frames.asked([Frame("", one.frame, "") for one in shot.frames], words.frames, progress)
    if words.jobs != 1:
        jobs.run_jobs(words, "bake", [frame.number for frame in wanted], progress)
    record = bake_shot(shot, words.out, half=not words.float, overwrite=words.overwrite, progress=progress,
                       wanted={frame.number for frame in wanted}, space=words.space, config=words.ocio)
    return layers.told(wanted, words.out, len(record["frames"]), progress)


COMMAND = Command(
    "bake", "Renders a run, a .flare or a shot to EXR layers.",
    """Writes one multilayer EXR a frame, scene-linear Rec. 709: composite at the root, scene, flare,
flare_<light>, depth. scene + flare = composite, and the lights sum to the flare, so add them up in any
compositor. Frames already made with the same settings are kept.

  run.py bake build/desk --out build/layers --frames 1-20 --set lamp.intensity=2""",
    arguments, (Step("look", "blender", look, wanted=lambda words: words.blend is not None),
                Step("bake", "engine", run)), after_a_stop="goes on")
