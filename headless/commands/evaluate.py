# SPDX-License-Identifier: GPL-3.0-or-later
"""eval: scores how well a run separates scene and flare."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ...core.choices import Device
from ...core.errors import RunError
from ...core.system.progress import Progress
from .. import device, plate_space, tallies
from ..command import Command, Step

VIEWS = ("held-out", "train", "all")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("run", type=Path, metavar="RUN", help="a run, the folder that `fit` writes")
    parser.add_argument("--views", choices=VIEWS, default="held-out", help="which views to score (default held-out)")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE", help="the capture, if it was moved")
    plate_space.add_option(parser)
    device.add_option(parser)
    parser.add_argument("--lpips", type=Path, metavar="DIR", help="folder with the weights of LPIPS (AlexNet, v0.1)")


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Score the run, and write its eval.json."""
    if args.plate_space is not None:
        from ...core.fit.run import Run

        plate_space.record(args, Run.open(args.run).find_capture(args.capture))
    return score_run(args.run, progress, view_set=args.views, capture_folder=args.capture,
                     lpips_folder=args.lpips, device_name=args.device)


def score_run(folder: Path, progress: Progress, *, view_set: str = "held-out",
              capture_folder: Path | None = None, lpips_folder: Path | None = None,
              device_name: Device = "auto") -> dict[str, Any]:
    """Score the views of a run, write its eval.json and report the table; return the file and the scores.

    view_set: one of VIEWS. capture_folder: None for the run's. lpips_folder: None to leave LPIPS out. device_name: what
    renders the views. Raises RunError and EngineError.
    """
    from ...core.conventions.run_files import EVALUATION
    from ...core.fit.frames import Frames
    from ...core.fit.run import Run
    from ...core.metrics.evaluation import evaluate, format_table, is_worse_than_empty
    from ...core.system.files import write_json

    perceptual = None
    if lpips_folder is not None:
        from ...core.metrics.lpips import Lpips

        perceptual = Lpips(lpips_folder)
    run_ = Run.open(folder, device=device_name)
    capture = run_.open_capture(capture_folder)
    tallies.report_capture(capture, progress)
    train, held_out = capture.split(run_.settings.holdout)
    views = {"held-out": held_out, "train": train, "all": capture.views}[view_set]
    if not views:
        raise RunError(f"{folder} has no held-out view; score others with --views train or all.")
    frames = Frames(capture, run_.settings.width)
    scores = evaluate(run_, capture, {view: frames.camera(view) for view in views}, progress, frames.picture_area,
                      perceptual)
    progress.say(format_table(scores))  # first, since the folder may be read-only
    if is_worse_than_empty(scores):
        progress.say("This flare matches the frames worse than no flare would: look at preview.png before you use it. "
                     "docs/handbook/first_fit.md describes the footage that a fit needs.")
    write_json(run_.folder / EVALUATION, scores)
    return {"eval": str(run_.folder / EVALUATION),
            "scores": {layer: part for layer, part in scores.items() if isinstance(part, dict)},
            **tallies.report_tally(tallies.tally_capture(capture, "scored", len(views)), progress)}


COMMAND = Command(
    "eval", "Scores a run: composite, scene and flare against reference frames.",
    """Writes RUN/eval.json and shows its means: PSNR, SSIM (11x11 window, sigma 1.5, inside the picture), FLIP, and
LPIPS where --lpips names its weights. Scene and flare are scored against truth/ where the capture has it, else against
removed/. "empty" is the score of an empty flare. Views without flare are left out of the flare's PSNR, "empty" and
relative error, and are listed.

  run.py eval build/desk""",
    arguments, (Step("eval", "engine", run),))
