# SPDX-License-Identifier: GPL-3.0-or-later
"""solve: makes a capture from frames or a video."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, get_args

from ...core.choices import Matching
from ...core.errors import CaptureError, SettingsError
from ...core.system.progress import Progress
from .. import plate_space, tallies
from ..command import Command, Step, parse_seed, reject_unused_options

SOLVE_DEFAULTS = {"frames": 0, "matching": "auto", "lens": "RADIAL", "work_size": 1000, "size": 0, "no_mask": False,
                  "seed": 0, "plate_space": None, "ocio": None}
"""Defaults of the options that apply to frames without cameras only."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("source", type=Path, metavar="FRAMES_OR_VIDEO",
                        help="folder of frames (PNG, JPEG, TIFF, EXR, DPX and others), a video, or a .blend, a Nuke "
                             "script (.nk) or a .chan file, whose animated camera is used without a solve")
    parser.add_argument("--plates", type=Path, metavar="DIR",
                        help="for a .blend, .nk or .chan: the frames as filmed or rendered, whose names end with their "
                             "numbers")
    parser.add_argument("--lights", metavar="NAMES", help="for a .blend: objects that are lights (default: its lamps)")
    parser.add_argument("--out", type=Path, required=True, metavar="CAPTURE", help="folder for the capture")
    parser.add_argument("--frames", type=int, metavar="N",
                        help="use N frames: the sharpest of each of N equal intervals (default: all of a folder, 150 "
                             "of a video)")
    parser.add_argument("--matching", choices=get_args(Matching),
                        help="which pairs of frames to match: all, neighbours, or similar ones (default: chosen by the "
                             "number of frames)")
    parser.add_argument("--lens", metavar="MODEL",
                        help="COLMAP camera model to solve for (default RADIAL; OPENCV_FISHEYE for fisheyes)")
    parser.add_argument("--work-size", type=int, metavar="PIXELS",
                        help="long side of the pictures that features are found in (default 1000)")
    parser.add_argument("--size", type=int, metavar="PIXELS",
                        help="long side of the written frames (default: as filmed)")
    parser.add_argument("--no-mask", action="store_true",
                        help="also use features on clipped pixels and on the lines of ghosts")
    parser.add_argument("--seed", type=parse_seed, metavar="N", help="random seed (default 0)")
    plate_space.add_option(parser)
    parser.set_defaults(**SOLVE_DEFAULTS)


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Engine step: solve the cameras of frames or a video."""
    from ...core.capture.solve import PICTURE, REPORT, SolveSettings, solve

    if args.plates or args.lights:
        message = "--plates is only for a .blend, .nk or .chan" if args.plates else "--lights is only for a .blend"
        raise SettingsError(f"{message}; leave it out.")
    settings = SolveSettings(frames=args.frames, matching=args.matching, lens=args.lens.upper(),
                             size=args.work_size, output_size=args.size, mask=not args.no_mask, seed=args.seed,
                             plate_space="" if plate_space.named_space(args) is None else args.plate_space,
                             ocio=args.ocio)
    report = solve(args.source, args.out, settings, progress)
    progress.say(f"{report['registered']} of {report['frames']} frames placed, {report['points']} points, reprojection "
                 f"error {report['reprojection_error_px']:.2f} px in pictures of {args.work_size} or less, "
                 f"{report['track_length']:.1f} frames a point. See {args.out / PICTURE}; next: `lights {args.out}`.")
    return {"capture": str(args.out), "report": str(args.out / REPORT), "picture": str(args.out / PICTURE),
            **{name: report[name] for name in ("frames", "registered", "points", "reprojection_error_px",
                                               "track_length")},
            **tallies.report_tally(tallies.tally_solve(report, args.source), progress)}


def is_blend(args: argparse.Namespace) -> bool:
    """Return whether the source is a .blend, which has a camera already."""
    return bool(args.source.suffix.lower() == ".blend")


def is_nuke(args: argparse.Namespace) -> bool:
    """Return whether the source is a camera of Nuke."""
    return args.source.suffix.lower() in (".nk", ".chan")


def import_nuke(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Engine step: write a capture from the camera of a Nuke script or a .chan file."""
    from ...core.capture.nuke_camera import read_nuke_camera, write_nuke_capture
    from ...core.conventions.frame_numbers import plates_by_number
    from ...core.images.listing import pictures_in

    if args.lights:
        raise SettingsError("--lights is only for a .blend; leave it out, and run `lights` on the capture.")
    _check_camera_source(args)
    plates = plates_by_number(pictures_in(args.plates))
    if not plates:
        raise CaptureError(f"{args.plates} holds no pictures; name the folder of the camera's frames.")
    tally = write_nuke_capture(read_nuke_camera(args.source), plates, args.out, progress)
    progress.say(f"{tally.used} frames with the camera of {args.source} are in {args.out}; next: `lights {args.out}`.")
    return {"capture": str(args.out), "frames": tally.used, **tallies.report_tally(tally, progress)}


def _check_camera_source(args: argparse.Namespace) -> None:
    """Raise SettingsError without plates or with options of a solve, CaptureError where CAPTURE holds a capture."""
    from ...core.capture.layout import find_model
    from ...core.capture.transforms import FILE as TRANSFORMS

    reject_unused_options(args, SOLVE_DEFAULTS, "frames or a video that have to be solved")
    if args.plates is None or not args.plates.is_dir():
        raise SettingsError(f"{args.source} has a camera but no pictures; name the folder of its frames with --plates.")
    if (args.out / TRANSFORMS).exists() or find_model(args.out) is not None:
        raise CaptureError(f"{args.out} holds a capture already; choose another folder.")


def import_blend(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Blender step: write a capture from the animated camera of a .blend."""
    from ...core.conventions.frame_numbers import plates_by_number
    from ...core.images.listing import pictures_in
    from ...flare_addon.capture.blend_shot import open_blend, write_capture

    _check_camera_source(args)
    scene = open_blend(args.source)
    plates = {number: path for number, path in plates_by_number(pictures_in(args.plates)).items()
              if scene.frame_start <= number <= scene.frame_end}
    if not plates:
        raise CaptureError(f"{args.plates} has no picture for the frames {scene.frame_start} to {scene.frame_end}.")
    progress.stage("read the .blend", len(plates))
    names = [name.strip() for name in (args.lights or "").split(",") if name.strip()]
    count = write_capture(scene, plates, args.out.resolve(), names, progress.advance)
    progress.say(f"{count} frames with the cameras of {args.source} are in {args.out}; next: `fit {args.out}`.")
    return {"capture": str(args.out), "frames": count}


COMMAND = Command(
    "solve", "Solves the cameras of frames or a video and writes a capture.",
    """Structure from motion by pycolmap: features (not from clipped pixels, nor where ghosts lie), matches,
incremental mapping. CAPTURE gets images/ (undistorted), sparse/0/ (COLMAP), solve.json and solve.png, a
picture of cameras and points. The world stands upright (+z up). Frames that cannot be placed are left out and
listed.

  run.py solve shot.mp4 --out captures/shot
  run.py solve camera.nk --plates plates/sh010 --out captures/sh010""",
    arguments, (Step("camera", "blender", import_blend, is_needed=is_blend),
                Step("Nuke camera", "engine", import_nuke, is_needed=is_nuke),
                Step("solve", "engine", run, is_needed=lambda args: not is_blend(args) and not is_nuke(args))),
    resume_rule="resumes")
