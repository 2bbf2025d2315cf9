# SPDX-License-Identifier: GPL-3.0-or-later
"""solve: frames or a video to a capture."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ...core.progress import Progress
from ..command import Command, Step

MATCHING = ("auto", "exhaustive", "sequential", "similar")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", type=Path, metavar="FRAMES_OR_VIDEO",
                        help="folder of frames (PNG, JPEG, TIFF, EXR) or a video")
    parser.add_argument("--out", type=Path, required=True, metavar="CAPTURE", help="folder for the capture")
    parser.add_argument("--frames", type=int, default=0, metavar="N",
                        help="choose N frames, evenly, the sharpest of each stretch (default: all of a folder, 150 of "
                             "a video)")
    parser.add_argument("--matching", choices=MATCHING, default="auto",
                        help="which frames to match: all with all, neighbours, or look-alikes (default: what fits)")
    parser.add_argument("--lens", default="RADIAL", metavar="MODEL",
                        help="COLMAP camera model to solve for (default RADIAL; OPENCV_FISHEYE for fisheyes)")
    parser.add_argument("--work-size", type=int, default=1000, metavar="PIXELS",
                        help="long side at which features are found (default 1000)")
    parser.add_argument("--size", type=int, default=0, metavar="PIXELS",
                        help="long side of the frames written (default: as filmed)")
    parser.add_argument("--no-mask", action="store_true",
                        help="take features from clipped pixels and the lines of ghosts too")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of all randomness (default 0)")


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from ...core.capture.solve import PICTURE, REPORT, SolveSettings, solve

    settings = SolveSettings(frames=words.frames, matching=words.matching, lens=words.lens.upper(),
                             size=words.work_size, output_size=words.size, mask=not words.no_mask, seed=words.seed)
    report = solve(words.source, words.out, settings, progress)
    progress.say(f"{report['registered']} of {report['frames']} frames placed, {report['points']} points, reprojection "
                 f"error {report['reprojection_error_px']:.2f} px at {words.work_size}, {report['track_length']:.1f} "
                 f"frames a point. See {words.out / PICTURE}; next: `lights {words.out}`.")
    return {"capture": str(words.out), "report": str(words.out / REPORT), "picture": str(words.out / PICTURE),
            **{name: report[name] for name in ("frames", "registered", "points", "reprojection_error_px",
                                               "track_length")}}


COMMAND = Command(
    "solve", "Finds the cameras of frames or a video, and makes a capture of them.",
    """Structure from motion by pycolmap: features (not from clipped pixels, nor where ghosts lie), matches,
incremental mapping. CAPTURE gets images/ (undistorted), sparse/0/ (COLMAP), solve.json and solve.png, a
picture of cameras and points. The world stands upright (+z up). Frames that find no place are left out and
named.

  run.py solve shot.mp4 --out captures/shot""",
    arguments, (Step("solve", "engine", run),))
