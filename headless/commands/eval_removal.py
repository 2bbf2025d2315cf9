# SPDX-License-Identifier: GPL-3.0-or-later
"""eval-removal: scores the removal of flares on pairs of pictures."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import FrameError, SettingsError, join_failures
from ...core.system.progress import Progress
from .. import glow
from ..command import Command, Step, parse_seed, reject_unused_options

if TYPE_CHECKING:
    from ...core.removal.evaluation import Case

SHEET, SCORES = "worst.png", "eval.json"

SEED, SIZE = 7, (960, 640)
"""Defaults of --seed and --size, for --synthetic."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("pairs", type=Path, nargs="?", metavar="PAIRS",
                        help="folder with input/ and gt/ (and mask/), or a folder of such folders")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help=f"folder for {SCORES} and {SHEET}")
    parser.add_argument("--synthetic", type=int, metavar="N",
                        help="instead of PAIRS: N synthesised pictures of every flare class")
    parser.add_argument("--backgrounds", type=Path, nargs="+", default=[], metavar="DIR",
                        help="clean pictures for --synthetic; only the tenth that training holds out, by name, is "
                             "used")
    parser.add_argument("--lenses", type=Path, metavar="DIR",
                        help="lens prescriptions (.lens) for --synthetic; only the tenth that training holds out, by "
                             "name, is used (default: the six that come with the program)")
    parser.add_argument("--all-backgrounds", action="store_true",
                        help="use every clean picture, not only the held-out tenth")
    parser.add_argument("--seed", type=parse_seed, default=SEED, metavar="N",
                        help=f"random seed of --synthetic (default {SEED})")
    parser.add_argument("--size", type=int, nargs=2, default=SIZE, metavar=("W", "H"),
                        help="pixels of the pictures of --synthetic (default {} {})".format(*SIZE))
    glow.add_options(parser)
    parser.add_argument("--working-size", type=int, metavar="PIXELS", help="as for `remove`")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="as for `remove`")
    parser.add_argument("--lpips", type=Path, metavar="DIR", help="folder with the weights of LPIPS (AlexNet, v0.1)")


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Score the remover on all pairs, and write the scores and the sheet.

    Raises FrameError where some pairs could not be read, after the others are scored.
    """
    from ...core.images.write import write_png
    from ...core.removal import evaluation
    from ...core.removal.inference.remover import WORKING_SIZE, Remover
    from ...core.system.files import write_json

    size = WORKING_SIZE if args.working_size is None else args.working_size
    remover = Remover(args.weights, working_size=size, glow=glow.glow_mode(args))
    cases = _load_cases(args, progress)
    perceptual = None
    if args.lpips:
        from ...core.metrics.lpips import Lpips

        perceptual = Lpips(args.lpips)
    else:
        progress.say("LPIPS is not computed; name the folder of its weights with --lpips.")
    scores = evaluation.evaluate(cases, remover.clean_display, progress, lpips=perceptual)
    write_json(args.out / SCORES, scores)
    write_png(args.out / SHEET, evaluation.draw_worst_sheet(cases, remover.clean_display, scores))
    progress.say(evaluation.format_table(scores))
    if scores["failed"]:
        raise FrameError(f"{len(scores['failed'])} of {len(cases)} pairs could not be read; the scores of the others "
                         f"are in {args.out / SCORES}: {join_failures(scores['failed'])}")
    return {"eval": str(args.out / SCORES), "sheet": str(args.out / SHEET), "mean": scores["mean"],
            "categories": scores["categories"]}


def _load_cases(args: argparse.Namespace, progress: Progress) -> list[Case]:
    """Return the pairs of PAIRS, or the cases of --synthetic, that the arguments select. Raises SettingsError."""
    from ...core.optics.prescription import read_lenses
    from ...core.removal import evaluation
    from ...core.removal.training.backgrounds import describe_unusable, read_backgrounds

    if (args.pairs is None) == (args.synthetic is None):
        raise SettingsError("Give either a folder of pairs, or --synthetic with --backgrounds.")
    if args.pairs is not None:
        defaults: dict[str, Any] = {"backgrounds": [], "lenses": None, "all_backgrounds": False, "seed": SEED,
                                    "size": SIZE}
        reject_unused_options(args, defaults, "--synthetic")
        return evaluation.read_cases(args.pairs)
    if not args.backgrounds:
        raise SettingsError("--synthetic needs clean pictures; name folders of them with --backgrounds.")
    if args.synthetic < 1 or min(args.size) < 64:
        raise SettingsError("--synthetic needs at least one picture per class, and at least 64 pixels per side.")
    backgrounds = read_backgrounds(args.backgrounds, "all" if args.all_backgrounds else "test", max(args.size))
    if left_out := describe_unusable(backgrounds.unusable):
        progress.say(left_out)
    lenses = evaluation.held_out_lenses(read_lenses(args.lenses) if args.lenses else [])
    return evaluation.synthetic_cases(args.seed, args.synthetic, backgrounds, lenses, tuple(args.size))


COMMAND = Command(
    "eval-removal", "Scores the removal of flares on pairs of pictures.",
    f"""Writes DIR/{SCORES} and DIR/{SHEET} (the ten pictures with the smallest gain) and shows, by category, PSNR,
SSIM, LPIPS and FLIP against the clean pictures, and PSNR and SSIM of the unchanged input in brackets. {SCORES} has all
scores.

  run.py eval-removal Flare7Kpp/test_data/real --out build/eval
  run.py eval-removal --synthetic 25 --backgrounds photos hdri --lenses lenses --out build/eval""",
    arguments, (Step("eval-removal", "engine", run),))
