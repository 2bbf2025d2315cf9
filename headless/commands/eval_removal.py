# SPDX-License-Identifier: GPL-3.0-or-later
"""eval-removal: how good the removal of flares is, in figures."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import FrameError, SettingsError, spelled_out
from ...core.system.progress import Progress
from .. import glow
from ..command import Command, Step, refuse_useless, seed

if TYPE_CHECKING:
    from ...core.removal.evaluation import Case

SHEET, SCORES = "worst.png", "eval.json"

SEED, SIZE = 7, (960, 640)
"""Of --synthetic."""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("pairs", type=Path, nargs="?", metavar="PAIRS",
                        help="folder with input/ and gt/ (and mask/), or a folder of such folders")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help=f"folder for {SCORES} and {SHEET}")
    parser.add_argument("--synthetic", type=int, metavar="N",
                        help="in place of PAIRS: N synthesised pictures of every class of flare")
    parser.add_argument("--backgrounds", type=Path, nargs="+", default=[], metavar="DIR",
                        help="clean pictures for --synthetic, of which one in ten, by name, is used: those that "
                             "training leaves out")
    parser.add_argument("--lenses", type=Path, metavar="DIR",
                        help="lens prescriptions (.lens) for --synthetic, of which one in ten, by name, is used: those "
                             "that training leaves out (default: the six that come with the program)")
    parser.add_argument("--all-backgrounds", action="store_true", help="use every clean picture, not one in ten")
    parser.add_argument("--seed", type=seed, default=SEED, metavar="N", help=f"of --synthetic (default {SEED})")
    parser.add_argument("--size", type=int, nargs=2, default=SIZE, metavar=("W", "H"),
                        help="of --synthetic's pictures (default {} {})".format(*SIZE))
    glow.add_options(parser)
    parser.add_argument("--working-size", type=int, metavar="PIXELS", help="as for `remove`")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="as for `remove`")
    parser.add_argument("--lpips", type=Path, metavar="DIR", help="folder with the weights of LPIPS (AlexNet, v0.1)")


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from ...core.images.write import write_png
    from ...core.removal import evaluation
    from ...core.removal.inference.remover import WORKING_SIZE, Remover
    from ...core.system.files import write_json

    size = WORKING_SIZE if words.working_size is None else words.working_size
    remover = Remover(words.weights, working_size=size, glow=glow.asked(words))
    cases = _cases(words, progress)
    perceptual = None
    if words.lpips:
        from ...core.metrics.lpips import Lpips

        perceptual = Lpips(words.lpips)
    else:
        progress.say("LPIPS is left out: no folder with its weights was given (--lpips).")
    scores = evaluation.evaluate(cases, remover.clean_display, progress, lpips=perceptual)
    write_json(words.out / SCORES, scores)
    write_png(words.out / SHEET, evaluation.worst_sheet(cases, remover.clean_display, scores))
    progress.say(evaluation.table(scores))
    if scores["failed"]:
        raise FrameError(f"{len(scores['failed'])} of {len(cases)} pairs could not be read, the scores of the others "
                         f"are in {words.out / SCORES}: {spelled_out(scores['failed'])}")
    return {"eval": str(words.out / SCORES), "sheet": str(words.out / SHEET), "mean": scores["mean"],
            "categories": scores["categories"]}


def _cases(words: argparse.Namespace, progress: Progress) -> list[Case]:
    from ...core.removal import evaluation
    from ...core.removal.synthesis.prescription import read_lenses
    from ...core.removal.training.backgrounds import read_backgrounds, told_left_out

    if (words.pairs is None) == (words.synthetic is None):
        raise SettingsError("Give either a folder of pairs, or --synthetic with --backgrounds.")
    if words.pairs is not None:
        refuse_useless(words, {"backgrounds": [], "lenses": None, "all_backgrounds": False, "seed": SEED, "size": SIZE},
                       "--synthetic")
        return evaluation.paired(words.pairs)
    if not words.backgrounds:
        raise SettingsError("--synthetic needs clean pictures; name folders of them with --backgrounds.")
    if words.synthetic < 1 or min(words.size) < 64:
        raise SettingsError("--synthetic wants one picture a class at least, of 64 pixels a side at least.")
    backgrounds = read_backgrounds(words.backgrounds, "all" if words.all_backgrounds else "test", max(words.size))
    if left_out := told_left_out(backgrounds.left_out):
        progress.say(left_out)
    lenses = evaluation.held_out(read_lenses(words.lenses) if words.lenses else [])
    return evaluation.synthetic(words.seed, words.synthetic, backgrounds, lenses, tuple(words.size))


COMMAND = Command(
    "eval-removal", "Scores the removal of flares on pairs of pictures.",
    f"""Writes DIR/{SCORES} and DIR/{SHEET} (the ten pictures that gain least) and shows, by category, PSNR, SSIM,
LPIPS and FLIP against the flare-free pictures, with the first two of the untouched input in brackets; the file has all.

  run.py eval-removal Flare7Kpp/test_data/real --out build/eval
  run.py eval-removal --synthetic 25 --backgrounds photos hdri --lenses lenses --out build/eval""",
    arguments, (Step("eval-removal", "engine", run),))
