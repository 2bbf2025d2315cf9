# SPDX-License-Identifier: GPL-3.0-or-later
"""solve: frames or a video to a capture."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, get_args

from ...core.choices import Matching
from ...core.errors import CaptureError, SettingsError
from ...core.system.progress import Progress
from ..command import Command, Step, refuse_useless, seed

OF_A_SOLVE = {"frames": 0, "matching": "auto", "lens": "RADIAL", "work_size": 1000, "size": 0, "no_mask": False,
              "seed": 0}
"""Options that are for frames without cameras, as they are where nobody gives them."""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", type=Path, metavar="FRAMES_OR_VIDEO",
                        help="folder of frames (PNG, JPEG, TIFF, EXR), a video, or a .blend with an animated camera, "
                             "which is taken as it is")
    parser.add_argument("--plates", type=Path, metavar="DIR",
                        help="of a .blend: the frames as filmed or rendered, whose names end with their numbers")
    parser.add_argument("--lights", metavar="NAMES", help="of a .blend: objects that are lights (default: its lamps)")
    parser.add_argument("--out", type=Path, required=True, metavar="CAPTURE", help="folder for the capture")
    parser.add_argument("--frames", type=int, metavar="N",
                        help="choose N frames, evenly, the sharpest of each stretch (default: all of a folder, 150 of "
                             "a video)")
    parser.add_argument("--matching", choices=get_args(Matching),
                        help="which frames to match: all with all, neighbours, or look-alikes (default: what fits)")
    parser.add_argument("--lens", metavar="MODEL",
                        help="COLMAP camera model to solve for (default RADIAL; OPENCV_FISHEYE for fisheyes)")
    parser.add_argument("--work-size", type=int, metavar="PIXELS",
                        help="long side at which features are found (default 1000)")
    parser.add_argument("--size", type=int, metavar="PIXELS",
                        help="long side of the frames written (default: as filmed)")
    parser.add_argument("--no-mask", action="store_true",
                        help="take features from clipped pixels and the lines of ghosts too")
    parser.add_argument("--seed", type=seed, metavar="N", help="of all randomness (default 0)")
    parser.set_defaults(**OF_A_SOLVE)


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from ...core.capture.solve import PICTURE, REPORT, SolveSettings, solve

    if words.plates or words.lights:
        raise SettingsError(f"--{'plates' if words.plates else 'lights'} is for a .blend; leave it out.")
    settings = SolveSettings(frames=words.frames, matching=words.matching, lens=words.lens.upper(),
                             size=words.work_size, output_size=words.size, mask=not words.no_mask, seed=words.seed)
    report = solve(words.source, words.out, settings, progress)
    progress.say(f"{report['registered']} of {report['frames']} frames placed, {report['points']} points, reprojection "
                 f"error {report['reprojection_error_px']:.2f} px in pictures of {words.work_size} or less, "
                 f"{report['track_length']:.1f} frames a point. See {words.out / PICTURE}; next: `lights {words.out}`.")
    return {"capture": str(words.out), "report": str(words.out / REPORT), "picture": str(words.out / PICTURE),
            **{name: report[name] for name in ("frames", "registered", "points", "reprojection_error_px",
                                               "track_length")}}


def is_blend(words: argparse.Namespace) -> bool:
    """Whether the source has cameras already."""
    return bool(words.source.suffix.lower() == ".blend")


def of_blend(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Blender's part: the animated camera of a .blend as a capture."""
    from ...core.capture.colmap import find_model
    from ...core.capture.transforms import FILE as TRANSFORMS
    from ...core.conventions.frame_numbers import plates_by_number
    from ...core.images.listing import pictures_in
    from ...flare_addon.capture.blend_shot import capture_of, opened

    refuse_useless(words, OF_A_SOLVE, "frames or a video that have to be solved")
    if words.plates is None or not words.plates.is_dir():
        raise SettingsError(f"{words.source} has cameras but no pictures; name the folder of its frames with --plates.")
    if (words.out / TRANSFORMS).exists() or find_model(words.out) is not None:
        raise CaptureError(f"{words.out} holds a capture already; choose another folder.")
    scene = opened(words.source)
    plates = {number: path for number, path in plates_by_number(pictures_in(words.plates)).items()
              if scene.frame_start <= number <= scene.frame_end}
    if not plates:
        raise CaptureError(f"{words.plates} has no picture for the frames {scene.frame_start} to {scene.frame_end}.")
    progress.stage("look at the .blend", len(plates))
    names = [name.strip() for name in (words.lights or "").split(",") if name.strip()]
    count = capture_of(scene, plates, words.out.resolve(), names, progress.advance)
    progress.say(f"{count} frames with the cameras of {words.source} are in {words.out}; next: `fit {words.out}`.")
    return {"capture": str(words.out), "frames": count}


COMMAND = Command(
    "solve", "Finds the cameras of frames or a video, and makes a capture of them.",
    """Structure from motion by pycolmap: features (not from clipped pixels, nor where ghosts lie), matches,
incremental mapping. CAPTURE gets images/ (undistorted), sparse/0/ (COLMAP), solve.json and solve.png, a
picture of cameras and points. The world stands upright (+z up). Frames that find no place are left out and
named.

  run.py solve shot.mp4 --out captures/shot""",
    arguments, (Step("camera", "blender", of_blend, wanted=is_blend),
                Step("solve", "engine", run, wanted=lambda words: not is_blend(words))), after_a_stop="goes on")
