# SPDX-License-Identifier: GPL-3.0-or-later
"""bake: renders the layers of a run, a .flare or a shot as multilayer EXR files."""
from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import RunError, SettingsError
from ...core.system.progress import Progress
from .. import device, frames, jobs, layers, targets
from ..command import Command, Step
from . import transfer

if TYPE_CHECKING:
    from ...core.bake.shot_frames import ShotSource
    from ...core.look.shot import Shot


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("run", type=Path, metavar="RUN_OR_FLARE",
                        help="a run, the folder that `fit` writes; or a .flare, with --capture or --blend; or a shot, "
                             "the JSON file of cameras and lights by frame that the add-on writes "
                             "(core/look/shot.py)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for layers.####.exr")
    frames.add_option(parser)
    frames.add_job_option(parser)
    parser.add_argument("--size", metavar="WIDTH[xHEIGHT]", help="pixels (default: the frames')")
    layers.add_options(
        parser, half="depth always 32", producer="bake",
        edits="an edit: lamp.intensity=2, lamp.tint=1,0.8,0.6, lamp.tint=#ffcc88, lamp.scale=1.5; * for all "
              "lights, lamp/ghost for one element; also saturation, spread, rotation (degrees), streak, mute, solo; "
              "repeatable")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE",
                        help="for a run: the capture, if it was moved; for a .flare: the capture whose cameras to "
                             "use, with the lights where the flare was learned")
    parser.add_argument("--blend", type=Path, metavar="FILE",
                        help="for a .flare: a .blend whose camera and lights to use, with the objects that hide them")
    parser.add_argument("--scene", type=Path, metavar="PLY", help="for a .flare: a 3DGS scene that hides its lights")
    parser.add_argument("--lights", metavar="NAMES", help="objects of the .blend that are lights (default: its lamps)")
    parser.add_argument("--without-engine", action="store_true",
                        help="for a shot: draw it with numpy in this Python, slower, and without the scene of a fit")
    parser.add_argument("--shot", type=Path, help=argparse.SUPPRESS)  # that the Blender step of --blend has written
    device.add_option(parser)
    jobs.add_option(parser)


def draw_shot(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Bake a shot by numpy, without an engine."""
    from ...core.bake.shot_frames import LookRenderer

    if args.run.suffix.lower() != ".json":
        raise SettingsError("--without-engine is for a shot; leave it out.")
    if args.device == "cuda":
        raise SettingsError("--without-engine draws on the processor; leave out --device cuda.")
    return _bake_shot(args, progress, "draw", LookRenderer)


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Engine step: bake a run, a .flare or a shot, whichever the argument names; return the command's result."""
    from ...core.bake.bake import bake
    from ...core.conventions.frame_numbers import number_views
    from ...core.fit.run import Run

    if args.run.suffix.lower() == ".json":
        return run_shot(args, progress)
    if args.run.suffix.lower() == ".flare":
        return run_flare(args, progress)
    if args.scene or args.lights:
        raise SettingsError(f"--{'scene' if args.scene else 'lights'} is for a .flare; name the run's flare.flare.")
    run_ = Run.open(args.run, device=args.device)
    if not run_.finished:
        raise RunError(f"{args.run} is not finished; resume it with `fit --resume` first.")
    capture = run_.open_capture(args.capture, need_frames=False)
    cameras = {view.name: view.camera for view in capture.views}
    selected = frames.select_task(number_views(cameras), args, progress)
    if not selected:
        return layers.empty_result(args.out)
    if args.jobs != 1:
        jobs.run_jobs(args, "bake", [frame.number for frame in selected], progress)
    # After jobs, this keeps their finished frames and returns the record of all.
    settings = layers.bake_settings(args, *layers.parse_size(args.size))
    record = bake(run_, selected, cameras, args.out, settings, progress, overwrite=args.overwrite)
    return layers.report_layers(selected, args.out, len(record["frames"]), progress)


def read_blend(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Blender step of a bake for a .blend: writes its cameras and lights as a shot."""
    if args.run.suffix.lower() != ".flare":
        raise SettingsError("--blend is for a .flare; name the run's flare.flare.")
    return transfer.write_shot(args, _target_options(args), args.run, progress)


def run_flare(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Bake a .flare: for the cameras of a capture, with the lights where the .flare has them, or for a .blend."""
    from ...core.capture import Capture
    from ...core.look import read_look
    from ...core.transfer.target import cameras_target

    if args.blend is None and args.capture is None:
        raise SettingsError(f"{args.run} has no cameras of its own; name a capture with --capture, or a .blend with "
                            "--blend.")
    if args.lights and args.blend is None:
        raise SettingsError("--lights names objects of a .blend; give it with --blend.")
    options = _target_options(args)
    if args.blend is not None:
        target = targets.open_target(options, args.run)
    else:
        target = cameras_target(Capture.open(args.capture, need_frames=False), read_look(args.run), args.scene)
    return transfer.make_layers(args, options, "bake", target, args.run, None, progress)


def _target_options(args: argparse.Namespace) -> targets.TargetOptions:
    """Return the options of the target of a .flare. Raises SettingsError if two options name cameras."""
    if args.blend is not None and args.capture is not None:
        raise SettingsError("--capture and --blend each name cameras for the flare; give one of them.")
    return targets.TargetOptions((args.blend or args.capture,), args.out, args.frames, args.job_frames, args.shot,
                                 lights=args.lights, scene=args.scene)


def run_shot(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Bake a shot, whose file holds its edits, in the engine."""
    from ...core.bake.shot import ShotRenderer

    return _bake_shot(args, progress, "bake", partial(ShotRenderer, device=args.device))


def _bake_shot(args: argparse.Namespace, progress: Progress, step: str,
               make_renderer: Callable[[Shot], ShotSource]) -> dict[str, Any]:
    """Bake the selected frames of a shot with this renderer; step: the name of the command's step, for --jobs."""
    from ...core.bake.shot_frames import bake_shot_frames
    from ...core.conventions.frame_numbers import NumberedFrame
    from ...core.look.shot import Shot

    if args.edit_texts or args.keyed_edits:
        raise SettingsError("A shot holds its edits in its file; --set and --edits are for runs.")
    for name in ("scene", "lights", "capture", "blend"):
        if getattr(args, name):
            raise SettingsError(f"--{name} does not apply to a shot, which has its own cameras and lights; leave it "
                                "out.")
    shot = Shot.read(args.run).resized(*layers.parse_size(args.size))
    numbered = [NumberedFrame(view="", number=shot_frame.frame, file="") for shot_frame in shot.frames]
    selected = frames.select_task(numbered, args, progress)
    if not selected:
        return layers.empty_result(args.out)
    if args.jobs != 1:
        jobs.run_jobs(args, step, [frame.number for frame in selected], progress)
    # After jobs, this keeps their finished frames and returns the record of all.
    record = bake_shot_frames(make_renderer(shot), args.out, half=not args.float, overwrite=args.overwrite,
                              progress=progress, frame_numbers={frame.number for frame in selected}, space=args.space,
                              config=args.ocio)
    return layers.report_layers(selected, args.out, len(record["frames"]), progress)


COMMAND = Command(
    "bake", "Renders a run, a .flare or a shot to EXR layers.",
    """Writes one multilayer EXR per frame, scene-linear Rec. 709: composite at the root, scene, flare, flare_<light>,
depth. scene + flare = composite, and the layers of the lights sum to the flare, so any compositor can add them up.
Frames that exist with the same settings are kept.

  run.py bake build/desk --out build/layers --frames 1-20 --set lamp.intensity=2""",
    arguments, (Step("look", "blender", read_blend, is_needed=lambda args: args.blend is not None),
                Step("draw", "any", draw_shot, is_needed=lambda args: args.without_engine),
                Step("bake", "engine", run, is_needed=lambda args: not args.without_engine)), resume_rule="resumes")
