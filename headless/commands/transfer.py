# SPDX-License-Identifier: GPL-3.0-or-later
"""transfer: renders a flare for other footage."""
from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ...core.choices import Follows
from ...core.errors import SettingsError
from ...core.system.progress import Progress
from .. import device, frames, jobs, layers, targets
from ..command import Command, Step, check_at_least_one
from ..targets import TargetOptions

if TYPE_CHECKING:
    from ...core.capture.camera import Floats
    from ...core.transfer.target import Target

MAX_SMOOTH = 1000  # frames


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("flare", type=Path, metavar="FLARE", help="a .flare, or the folder of a run")
    parser.add_argument("--to", type=Path, nargs="+", required=True, metavar="TARGET",
                        help="the footage: pictures, a capture, a run (its scene is rendered), a 3DGS PLY with "
                             "--cameras, a .blend, or a shot (JSON)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR",
                        help="folder for layers.####.exr, and for frames/ with the flared plates under their names")
    parser.add_argument("--query", choices=get_args(Follows), default="blend",
                        help="which view the appearance of the flare is evaluated for. source: one training view. "
                             "target: the target's view. blend: the target's view, clamped to the range of the "
                             "training views (default)")
    frames.add_option(parser)
    frames.add_job_option(parser)
    parser.add_argument("--size", metavar="WIDTH[xHEIGHT]", help="pixels (default: the target's)")
    lights = parser.add_argument_group("lights")
    lights.add_argument("--light", action="append", default=[], metavar="[NAME=]X,Y",
                        help="for pictures: a light in pixels, inside the frame or outside; repeatable (default: found "
                             "by exposure)")
    lights.add_argument("--highlights", type=float, nargs="?", const=0.95, metavar="LEVEL",
                        help="for pictures: every spot brighter than LEVEL (linear, 1 is white; default 0.95) has a "
                             "flare with the spot's brightness and colour, all in one layer")
    lights.add_argument("--highlight-gain", type=float, metavar="FACTOR",
                        help="brightness of the flares of --highlights (default 1: that of the .flare for white on "
                             "1/2000 of the frame)")
    lights.add_argument("--lights", metavar="FILE|NAMES",
                        help="a lights.json instead of the capture's; or the names of objects of the .blend, with "
                             "commas between (default: its lamps)")
    lights.add_argument("--use", action="append", default=[], metavar="LIGHT=SOURCE",
                        help="give the target's LIGHT the flare of the .flare's light SOURCE; repeatable "
                             "(default: by name, else in turn)")
    lights.add_argument("--smooth", type=int, default=1, metavar="FRAMES",
                        help="frames over which a light fades where it becomes hidden, on camera paths (default 1, 0 "
                             "for none)")
    lights.add_argument("--radius", type=float, default=0.0, metavar="UNITS",
                        help="radius of the lights of a .blend, for soft edges (default: the lamp's, else 2%% of the "
                             "distance)")
    lights.add_argument("--fall-off", type=float, nargs="?", const=0.0, metavar="DISTANCE",
                        help="dim the flare with the square of the light's distance from the camera; DISTANCE is where "
                             "it keeps its brightness (default: the distance in the first frame)")
    lights.add_argument("--scale", type=float, default=1.0, metavar="X",
                        help="units of the target's world per unit of the source's (default 1)")
    cameras = parser.add_argument_group("cameras and scenes")
    cameras.add_argument("--cameras", type=Path, metavar="CAPTURE", help="capture whose cameras render the 3DGS PLY")
    cameras.add_argument("--scene", type=Path, metavar="PLY", help="3DGS scene in the target's world that hides lights")
    cameras.add_argument("--focal", type=float, metavar="PIXELS",
                         help="focal length of a picture (default: by the field of view of the source's camera)")
    cameras.add_argument("--centre", metavar="X,Y", help="principal point of a picture, pixels (default: the middle)")
    cameras.add_argument("--capture", type=Path, metavar="CAPTURE",
                         help="the capture that the flare was fitted to, for a .flare that does not store its training "
                              "views")
    plates = parser.add_argument_group("plates and layers")
    plates.add_argument("--plates", type=Path, metavar="DIR", help="pictures for the frames of a .blend or a shot")
    plates.add_argument("--plate-space", default="auto", metavar="NAME",
                        help="colour space of the plates: srgb, rec709, linear, acescg, … or one of an OpenColorIO "
                             "configuration (default: the one that the capture's plate_space.json names, else the one "
                             "that each file declares)")
    layers.add_options(plates, half="unless a plate has more", producer="transfer",
                       edits="an edit, as for `bake`, by the lights of the target; repeatable")
    parser.add_argument("--shot", type=Path, help=argparse.SUPPRESS)  # that the Blender step of --blend has written
    device.add_option(parser)
    jobs.add_option(parser)


def read_blend(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Blender step: write the camera, the lights and their visibility of a .blend as a shot for the engine."""
    _check_ranges(args)
    return write_shot(args, TargetOptions.of_transfer(args), args.flare, progress)


def write_shot(args: argparse.Namespace, options: TargetOptions, flare: Path, progress: Progress) -> dict[str, Any]:
    """Write the cameras, the lights and their visibility of the target, a .blend, as a shot.

    args: the command's, with --size and --jobs. flare: a .flare, or the folder of a run. Raises SettingsError.
    """
    from ...core.conventions.frame_numbers import NumberedFrame, select_task_frames
    from ...core.conventions.run_files import FLARE
    from ...core.look import read_look
    from ...flare_addon.capture.blend_shot import open_blend, read_shot

    if len(options.to) > 1:
        raise SettingsError("The target can be one .blend at a time.")
    targets.check_options(options, ".blend")
    layers.parse_size(args.size)
    check_at_least_one("--jobs", args.jobs)
    flare = flare.resolve()
    if flare.is_dir():
        flare /= FLARE
    read_look(flare)
    scene = open_blend(options.to[0])
    if scene.render.use_multiview:
        progress.say(f"The scene {scene.name!r} renders stereo; this flare is that of its camera, not of its views: "
                     "Bake Layers in Blender makes layers of each view.")
    all_numbers = range(scene.frame_start, scene.frame_end + 1)
    all_frames = [NumberedFrame(view="", number=number, file="") for number in all_numbers]
    selected = {frame.number for frame in select_task_frames(all_frames, options.frames, options.job_frames)}
    # Neighbours too: visibility is smoothed over them (`smooth_visibility`), and a part of the frames must give the
    # result of the whole range.
    neighbour_offsets = range(-2 * options.smooth, 2 * options.smooth + 1)
    numbers = [number for number in all_numbers if any(number + offset in selected for offset in neighbour_offsets)]
    if options.query == "source" or options.fall_off == 0 or not selected:
        # The middle frame selects the training view of --query source, and the first one the distance of --fall-off 0.
        # Where no frame is selected, the engine step reports it.
        numbers = list(all_numbers)
    names = [name.strip() for name in (options.lights or "").split(",") if name.strip()]
    progress.stage("read the .blend", len(numbers))
    shot = read_shot(scene, flare, names, numbers, radius=options.radius, done=progress.advance)
    shot.write(targets.shot_path(options))
    return {"shot": str(targets.shot_path(options))}


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Engine step: render the layers of the flare for the target."""
    _check_ranges(args)
    flare, training = targets.find_flare(args)
    options = TargetOptions.of_transfer(args)
    target = targets.open_target(options, flare, training)
    return make_layers(args, options, "transfer", target, flare, training, progress)


def _check_ranges(args: argparse.Namespace) -> None:
    """Raise SettingsError for numbers that are out of range."""
    if not 0 <= args.smooth <= MAX_SMOOTH or not 0 < args.scale < math.inf:
        raise SettingsError(f"--smooth has to be from 0 to {MAX_SMOOTH}, and --scale above 0.")
    if args.focal is not None and not 0 < args.focal < math.inf:
        raise SettingsError(f"--focal {args.focal} is not a length in pixels above 0.")
    if args.fall_off is not None and not 0 <= args.fall_off < math.inf:
        raise SettingsError(f"--fall-off {args.fall_off} is not a distance above 0.")
    if args.highlights is not None and not 0 < args.highlights < math.inf:
        raise SettingsError(f"--highlights {args.highlights} is not a level above 0.")
    if args.highlight_gain is not None and not 0 < args.highlight_gain < math.inf:
        raise SettingsError(f"--highlight-gain {args.highlight_gain} is not a factor above 0.")
    if not 0 <= args.radius < math.inf:
        raise SettingsError(f"--radius {args.radius} is not a length of 0 or more.")


def make_layers(args: argparse.Namespace, options: TargetOptions, step: str, target: Target, flare: Path,
                training_poses: list[Floats] | None, progress: Progress) -> dict[str, Any]:
    """Render the layers of a flare for a target, as a step of `transfer` or `bake`.

    args: the command's, with the options of layers, --frames, --size, --device and --jobs. step: name of the command's
    step, which --jobs starts. flare: the .flare. training_poses: of training views, for a .flare that does not store
    its own. Returns the command's result.
    """
    from ...core.transfer.target import resized
    from ...core.transfer.transfer import Transfer, TransferSettings

    for warning in target.warnings:
        progress.say(warning)
    target = resized(target, *layers.parse_size(args.size))
    plates = [target_frame for target_frame in target.frames if target_frame.plate is not None]
    if unwritten := sum(target_frame.plate_with_flare_path(args.out) is None for target_frame in plates):
        progress.say(f"For {unwritten} of {len(plates)} plates only the layers are written: the plates have another "
                     "size than is rendered, or lens distortion.")
    settings = TransferSettings(options.query, options.scale, options.smooth, options.plate_space,
                                fall_off=options.fall_off, highlights=options.highlights,
                                highlight_gain=1.0 if options.highlight_gain is None else options.highlight_gain)
    transfer = Transfer(flare, target, settings, training_poses, args.ocio, args.device)
    selected = frames.select_task([target_frame.frame for target_frame in target.frames], args, progress)
    if not selected:
        return layers.empty_result(args.out)
    if args.jobs != 1:
        extra = ["--shot", str(targets.shot_path(options))] if targets.is_blend(options) else []
        jobs.run_jobs(args, step, [frame.number for frame in selected], progress, extra)
    bake_settings = layers.bake_settings(args)
    sources = {light.name: light.source for frame in target.frames for light in frame.shot.lights}
    stored_edits = () if targets.is_shot_file(options) else transfer.look.edits.for_placed_lights(sources).texts()
    if stored_edits:
        progress.say(f"The edits that {flare} stores are applied: {', '.join(stored_edits)}.")
        bake_settings = replace(bake_settings, edits=(*stored_edits, *bake_settings.edits))
    # After `run_jobs`, this skips the frames that the jobs finished, and returns the record of all.
    record = transfer.bake(args.out, selected, bake_settings, progress, overwrite=args.overwrite)
    return layers.report_layers(selected, args.out, len(record["frames"]), progress, targets.left_out(options, target))


COMMAND = Command(
    "transfer", "Renders a flare for other footage: pictures, captures, 3DGS scenes, Blender scenes.",
    """Writes EXR layers as `bake` does, and the plates with the flare added to DIR/frames; pixels without flare keep
their code values. Hidden lights, and lights behind the camera, give no flare. The scene of a run, or of a PLY with
--cameras, is rendered. Blender reads a .blend for its camera, its lights and the objects that hide them.

  run.py transfer lamp.flare --to plate.exr --light 1210,340 --out build/plate
  run.py transfer lamp.flare --to shots/sh010 --scene sh010.ply --out build/sh010 --use sun=lamp
  run.py transfer lamp.flare --to shot.blend --plates renders --out build/shot --jobs 2""",
    arguments, (Step("look", "blender", read_blend, is_needed=targets.is_blend), Step("transfer", "engine", run)),
    resume_rule="resumes")
