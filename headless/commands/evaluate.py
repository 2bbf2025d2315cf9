# SPDX-License-Identifier: GPL-3.0-or-later
"""eval: how well a run separates, in figures."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ...core.errors import RunError
from ...core.system.progress import Progress
from ..command import Command, Step

VIEWS = ("held-out", "train", "all")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", type=Path, metavar="RUN", help="folder that `fit` has written")
    parser.add_argument("--views", choices=VIEWS, default="held-out", help="which views to score (default held-out)")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE", help="where the capture is, if it was moved")
    parser.add_argument("--lpips", type=Path, metavar="DIR", help="folder with the weights of LPIPS (AlexNet, v0.1)")


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    return scores_of(words.run, progress, which=words.views, capture_folder=words.capture,
                     lpips_folder=words.lpips)


def scores_of(folder: Path, progress: Progress, *, which: str = "held-out",
              capture_folder: Path | None = None, lpips_folder: Path | None = None) -> dict[str, Any]:
    """Score a run's views, write its eval.json, show the table."""
    from ...core.conventions.run_files import EVALUATION
    from ...core.fit.frames import Frames
    from ...core.fit.run import Run
    from ...core.metrics.evaluation import evaluate, table, worse_than_none
    from ...core.system.files import write_json

    perceptual = None
    if lpips_folder is not None:
        from ...core.metrics.lpips import Lpips

        perceptual = Lpips(lpips_folder)
    made = Run.open(folder)
    capture = made.capture(capture_folder)
    train, held_out = capture.split(made.settings.holdout)
    views = {"held-out": held_out, "train": train, "all": capture.views}[which]
    if not views:
        raise RunError(f"{folder} held no view out; score others with --views train or all.")
    frames = Frames(capture, made.settings.width)
    scores = evaluate(made, capture, {view: frames.camera(view) for view in views}, progress, frames.inside,
                      perceptual)
    progress.say(table(scores))  # first, since the folder may be one that is not to be written
    if worse_than_none(scores):
        progress.say("The flare is farther from what was filmed than none at all would be: look at preview.png before "
                     "anything is made of it; docs/handbook/first_fit.md says what footage a fit can use.")
    write_json(made.folder / EVALUATION, scores)
    return {"eval": str(made.folder / EVALUATION),
            "scores": {layer: part for layer, part in scores.items() if isinstance(part, dict)}}


COMMAND = Command(
    "eval", "Scores a run: composite, scene and flare, against what is known.",
    """Writes RUN/eval.json and shows its means: PSNR, SSIM (11x11 window, sigma 1.5, inside the picture), FLIP
where the flip-evaluator package is installed, LPIPS where --lpips names its weights. Scene and flare are
scored against truth/ where the capture has it, else against removed/; "empty" is what no flare at all would
score. Views that show no flare do not count in its PSNR, "empty" and relative error, and are told.

  run.py eval build/desk""",
    arguments, (Step("eval", "engine", run),))
