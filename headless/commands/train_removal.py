# SPDX-License-Identifier: GPL-3.0-or-later
"""train-removal: the network that takes flares out, trained on synthesised flares over clean pictures."""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import SettingsError, spelled_out
from ...core.system.progress import Progress
from ..command import Command, Step, from_1, refuse_useless
from .fit import change

if TYPE_CHECKING:
    from ...core.colour.srgb import Pixels
    from ...core.removal.model.recipe import Recipe
    from ...core.removal.synthesis.prescription import Prescription
    from ...core.removal.training.backgrounds import Backgrounds
    from ...core.removal.training.flare_bank import OwnFlares

MOST_LENSES = 180


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--backgrounds", type=Path, nargs="+", required=True, metavar="DIR",
                        help="clean photographs and environment maps (.hdr, or .exr twice as wide as high)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR",
                        help="folder for the weights, the checkpoint and the log")
    parser.add_argument("--lenses", type=Path, metavar="DIR",
                        help="more lens prescriptions (.lens), besides the six that come with the program")
    parser.add_argument("--flares", type=Path, metavar="DIR",
                        help="your own flares on black, mixed in: pictures, clips, or Flare7K++'s folders")
    parser.add_argument("--iterations", type=int, metavar="N", help="length (default: the recipe's)")
    parser.add_argument("--resume", action="store_true",
                        help="go on with the training in --out, by the recipe it has but for what --iterations and "
                             "--set change")
    parser.add_argument("--start", type=Path, metavar="FILE",
                        help='weights to begin with; "box" for those that come with the program')
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="changes",
                        help="any other number of the recipe, e.g. learning_rate=3e-4; repeatable")
    parser.add_argument("--most-lenses", type=int, default=MOST_LENSES, metavar="N",
                        help=f"so many of the lenses, evenly spread; each is traced once (default {MOST_LENSES})")
    parser.add_argument("--model", choices=("network", "diffusion"), default="network",
                        help="network: the one that comes with the program; diffusion: a LoRA for one-step diffusion, "
                             "if diffusers, transformers and peft are at hand")
    parser.add_argument("--base", metavar="FOLDER_OR_NAME",
                        help="for diffusion: a base model such as SD-Turbo, in the layout of diffusers")
    parser.add_argument("--keep-glare", action="store_true", help="for diffusion: the glow round the lights is to stay")
    parser.add_argument("--lpips", type=Path, metavar="DIR",
                        help="for diffusion: weights of LPIPS, which then is a part of the loss")
    parser.add_argument("--threads", type=int, metavar="N", help="processor threads (default: all)")
    parser.add_argument("--processes", type=int, metavar="N",
                        help="to share the work among; beside a GPU all but one draw scenes and flares (default: one "
                             "for each processor core, without a GPU four at most)")


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    import torch

    from ...core.removal.evaluation import held_out
    from ...core.removal.model import recipe as recipes
    from ...core.removal.model import weights
    from ...core.removal.synthesis.prescription import built_in, read_lenses
    from ...core.removal.training.backgrounds import kept_for_test, mapped_backgrounds, read_backgrounds, told_left_out
    from ...core.removal.training.flare_bank import OwnFlares
    from ...core.removal.training.run import recipe_in, train

    if words.model == "network":
        refuse_useless(words, {"base": None, "keep_glare": False, "lpips": None}, "--model diffusion")
    else:
        refuse_useless(words, {"start": None, "processes": None}, "--model network")
    if words.lenses is None:
        refuse_useless(words, {"most_lenses": MOST_LENSES}, "--lenses")
    from_1("--most-lenses", words.most_lenses)
    if words.threads is not None:
        from_1("--threads", words.threads)
        torch.set_num_threads(words.threads)
    changes = dict(map(change, words.changes))
    if words.iterations is not None:
        changes["iterations"] = words.iterations
    before = None
    if words.resume and words.model == "network":
        before = recipe_in(words.out)
        if before is None:
            progress.say(f"{words.out} holds no training to go on with; one begins there.")
    recipe = recipes.from_dict({**recipes.as_dict(before or recipes.Recipe()), **changes})
    lenses = read_lenses(words.lenses, words.most_lenses) if words.lenses else []
    train_on = [lens for lens in lenses if not kept_for_test(lens.name)] + built_in()
    test_on = held_out(lenses)
    with mapped_backgrounds(words.backgrounds, "train", varied=True) as backgrounds:
        try:
            tests = read_backgrounds(words.backgrounds, "test"), test_on
        except SettingsError:
            tests = None
            progress.say("There are too few clean pictures to keep some for checks; the log will have none.")
        left_out = [*backgrounds.left_out, *(tests[0].left_out if tests else ())]
        if sentence := told_left_out(left_out):
            progress.say(sentence)
        own = OwnFlares(words.flares, recipe.canvas) if words.flares else None
        if own and own.left_out:
            progress.say(f"Left out of your flares: {spelled_out(own.left_out)}")
        if own and own.without_light:
            progress.say(f"{len(own.without_light)} of your {len(own)} flares have no picture of their light in "
                         f"Light_Source, {own.without_light[0].name} first; it is learned as a part of the flare.")
        if words.model == "diffusion":
            return _diffusion(words, recipe, backgrounds, train_on, own, progress)
        start = weights.IN_THE_BOX if str(words.start) == "box" else words.start
        progress.say(f"{len(backgrounds.photos)} photographs, {len(backgrounds.maps)} environment maps, "
                     f"{len(train_on)} lenses, {len(own) if own else 'no'} flares of your own.")
        path = train(recipe, words.out, backgrounds, train_on, tests=tests, own=own, resume=words.resume, start=start,
                     processes=words.processes, progress=progress)
        progress.say(f"The weights are in {path}; use them with `remove --weights`.")
        return {"weights": str(path)}


def _diffusion(words: argparse.Namespace, recipe: Recipe, backgrounds: Backgrounds,
               lenses: Sequence[Prescription], own: OwnFlares | None, progress: Progress) -> dict[str, Any]:
    from ...core.metrics.lpips import Lpips
    from ...core.removal.inference import diffusion
    from ...core.removal.training.batches import Batches

    diffusion.need()
    if words.base is None:
        raise SettingsError("--model diffusion wants a base model; name its folder with --base.")
    perceptual = Lpips(words.lpips).distance if words.lpips else None
    if perceptual is None:
        progress.say("The loss is L2 alone: no folder with the weights of LPIPS was given (--lpips).")
    batches = Batches(recipe, backgrounds, lenses, own)

    def draw(number: int) -> tuple[Pixels, Pixels]:
        one = batches.pair(number, 0, 512, 512)
        return one.frame, one.gentle if words.keep_glare else one.scene

    path = diffusion.train_diffusion(diffusion.DiffusionRemoval(words.base), words.out, draw,
                                     words.iterations or diffusion.ITERATIONS, progress, resume=words.resume,
                                     perceptual=perceptual)
    progress.say(f"The LoRA is in {path}; use it with `remove --model diffusion --base {words.base} --weights {path}`.")
    return {"weights": str(path)}


COMMAND = Command(
    "train-removal", "Trains the network that takes flares out.",
    """Flares are synthesised as the training goes (dirty apertures, ghosts through lens prescriptions, streaks,
halos, glare, rings) and laid over the clean pictures. One picture and one lens in ten, by name, are kept out
for checks. Stopped, it goes on with --resume; --start box begins with the weights that come with the program.

  run.py train-removal --backgrounds photos hdri --lenses lenses --out build/removal
  run.py train-removal --backgrounds photos --flares my_flares --start box --out build/mine --iterations 4000""",
    arguments, (Step("train-removal", "engine", run),), after_a_stop="goes on with --resume")
