# SPDX-License-Identifier: GPL-3.0-or-later
"""train-removal: trains the removal network on synthesised flares over clean pictures."""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import SettingsError, join_failures
from ...core.system.progress import Progress
from ..command import Command, Step, check_at_least_one, reject_unused_options
from .fit import parse_setting

if TYPE_CHECKING:
    from ...core.colour.srgb import Pixels
    from ...core.optics.prescription import Prescription
    from ...core.removal.model.recipe import Recipe
    from ...core.removal.training.backgrounds import Backgrounds
    from ...core.removal.training.flare_bank import UserFlares

MAX_LENSES = 180


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("--backgrounds", type=Path, nargs="+", required=True, metavar="DIR",
                        help="clean photographs and environment maps (.hdr, or .exr twice as wide as high)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR",
                        help="folder for the weights, the checkpoint and the log")
    parser.add_argument("--lenses", type=Path, metavar="DIR",
                        help="lens prescriptions (.lens) in addition to the six that come with the program")
    parser.add_argument("--flares", type=Path, metavar="DIR",
                        help="your own flares on black, added to the synthesised ones: pictures, videos, or the "
                             "folders of Flare7K++")
    parser.add_argument("--iterations", type=int, metavar="N", help="length of the training (default: the recipe's)")
    parser.add_argument("--resume", action="store_true",
                        help="resume the training in --out with its own recipe, except for what --iterations and --set "
                             "change")
    parser.add_argument("--start", type=Path, metavar="FILE",
                        help='weights to start from; "box" for those that come with the program')
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="changes",
                        help="any other setting of the recipe, such as learning_rate=3e-4; repeatable")
    parser.add_argument("--max-lenses", type=int, default=MAX_LENSES, metavar="N",
                        help=f"use at most N of the lenses, evenly spaced; each is traced once (default {MAX_LENSES})")
    parser.add_argument("--model", choices=("network", "diffusion"), default="network",
                        help="network: the architecture that comes with the program. diffusion: a LoRA for one-step "
                             "diffusion; needs diffusers, transformers and peft (default network)")
    parser.add_argument("--base", metavar="FOLDER_OR_NAME",
                        help="for diffusion: a base model such as SD-Turbo, in the layout of diffusers")
    parser.add_argument("--keep-glow", action="store_true", help="for diffusion: keep the glow around the lights")
    parser.add_argument("--lpips", type=Path, metavar="DIR",
                        help="for diffusion: folder with the weights of LPIPS, which is then added to the loss")
    parser.add_argument("--threads", type=int, metavar="N", help="processor threads (default: all)")
    parser.add_argument("--processes", type=int, metavar="N",
                        help="number of processes; with a GPU all but one make scenes and flares (default: one per "
                             "processor core, at most four without a GPU)")


def _check_options(args: argparse.Namespace) -> None:
    """Raise SettingsError for options without an effect and for numbers below 1."""
    if args.model == "network":
        reject_unused_options(args, {"base": None, "keep_glow": False, "lpips": None}, "--model diffusion")
    else:
        reject_unused_options(args, {"start": None, "processes": None}, "--model network")
    if args.lenses is None:
        reject_unused_options(args, {"max_lenses": MAX_LENSES}, "--lenses")
    check_at_least_one("--max-lenses", args.max_lenses)
    if args.threads is not None:
        check_at_least_one("--threads", args.threads)


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Train the network, or the LoRA of the diffusion model. Raises SettingsError."""
    import torch

    from ...core.optics.prescription import built_in_lenses, read_lenses
    from ...core.removal.evaluation import held_out_lenses
    from ...core.removal.model.weights_file import default_weights
    from ...core.removal.training.backgrounds import (
        describe_unusable,
        is_held_out,
        open_shared_backgrounds,
    )
    from ...core.removal.training.run import train

    _check_options(args)
    if args.threads is not None:
        torch.set_num_threads(args.threads)
    recipe = _make_recipe(args, progress)
    lenses = read_lenses(args.lenses, args.max_lenses) if args.lenses else []
    train_lenses = [lens for lens in lenses if not is_held_out(lens.name)] + built_in_lenses()
    with open_shared_backgrounds(args.backgrounds, "train", augmented=True) as backgrounds:
        validation = _read_validation(args.backgrounds, held_out_lenses(lenses), progress)
        unusable = [*backgrounds.unusable, *(validation[0].unusable if validation else ())]
        if warning := describe_unusable(unusable):
            progress.say(warning)
        user_flares = _read_user_flares(args.flares, recipe, progress) if args.flares else None
        if args.model == "diffusion":
            return _train_diffusion(args, recipe, backgrounds, train_lenses, user_flares, progress)
        start = default_weights() if str(args.start) == "box" else args.start
        progress.say(f"{len(backgrounds.photos)} photographs, {len(backgrounds.maps)} environment maps, "
                     f"{len(train_lenses)} lenses, {len(user_flares) if user_flares else 'no'} flares of your own.")
        path = train(recipe, args.out, backgrounds, train_lenses, validation=validation, user_flares=user_flares,
                     resume=args.resume, start=start, processes=args.processes, progress=progress)
        progress.say(f"The weights are in {path}; use them with `remove --weights`.")
        return {"weights": str(path)}


def _read_validation(folders: Sequence[Path], lenses: Sequence[Prescription],
                     progress: Progress) -> tuple[Backgrounds, Sequence[Prescription]] | None:
    """Return backgrounds and lenses that are held out for validation; None, with a message, for too few pictures."""
    from ...core.removal.training.backgrounds import read_backgrounds

    try:
        return read_backgrounds(folders, "test"), lenses
    except SettingsError:
        progress.say("There are too few clean pictures for a validation set; the log will have no validation scores.")
        return None


def _make_recipe(args: argparse.Namespace, progress: Progress) -> Recipe:
    """Return the recipe of a resumed training, else the default one, with the changes of --iterations and --set.

    Raises SettingsError.
    """
    from ...core.removal.model import recipe as recipes
    from ...core.removal.training.run import read_recipe

    changes = dict(map(parse_setting, args.changes))
    if args.iterations is not None:
        changes["iterations"] = args.iterations
    stored_recipe = None
    if args.resume and args.model == "network":
        stored_recipe = read_recipe(args.out)
        if stored_recipe is None:
            progress.say(f"{args.out} holds no training to resume; a new one starts there.")
    return recipes.from_dict({**recipes.as_dict(stored_recipe or recipes.Recipe()), **changes})


def _read_user_flares(folder: Path, recipe: Recipe, progress: Progress) -> UserFlares:
    """Read the user's flares, and report which are left out or lack their light. Raises SettingsError."""
    from ...core.removal.training.flare_bank import UserFlares

    user_flares = UserFlares(folder, recipe.canvas_size)
    if user_flares and user_flares.unreadable:
        progress.say(f"Left out of your flares: {join_failures(user_flares.unreadable)}")
    if user_flares and user_flares.missing_light:
        progress.say(f"{len(user_flares.missing_light)} of your {len(user_flares)} flares have no picture of their "
                     f"light in Light_Source, {user_flares.missing_light[0].name} first; it is learned as a part "
                     "of the flare.")
    return user_flares


def _train_diffusion(args: argparse.Namespace, recipe: Recipe, backgrounds: Backgrounds,
                     lenses: Sequence[Prescription], user_flares: UserFlares | None,
                     progress: Progress) -> dict[str, Any]:
    """Train a LoRA for one-step diffusion on synthesised pairs; return the command's result.

    user_flares: None without --flares. Raises SettingsError, and EngineError without the packages.
    """
    from ...core.metrics.lpips import Lpips
    from ...core.removal.inference import diffusion
    from ...core.removal.training.batches import Batches

    diffusion.check_packages()
    if args.base is None:
        raise SettingsError("--model diffusion needs a base model; name its folder with --base.")
    perceptual = Lpips(args.lpips).distance if args.lpips else None
    if perceptual is None:
        progress.say("The loss is L2 alone; name the folder with the weights of LPIPS (--lpips) to add it.")
    batches = Batches(recipe, backgrounds, lenses, user_flares)

    def draw(number: int) -> tuple[Pixels, Pixels]:
        # SD-Turbo was trained with pictures of 512 pixels.
        pair = batches.draw_pair(number, 0, 512, 512)
        return pair.frame, pair.scene_with_glow if args.keep_glow else pair.scene

    path = diffusion.train_diffusion(diffusion.DiffusionRemoval(args.base), args.out, draw,
                                     args.iterations or diffusion.ITERATIONS, progress, resume=args.resume,
                                     perceptual=perceptual)
    progress.say(f"The LoRA is in {path}; use it with `remove --model diffusion --base {args.base} --weights {path}`.")
    return {"weights": str(path)}


COMMAND = Command(
    "train-removal", "Trains the network that removes flares.",
    """Flares are synthesised during the training (dirty apertures, ghosts through lens prescriptions, streaks, halos,
glow, rings) and added to the clean pictures. A tenth of the pictures and lenses, by name, is held out for validation.
--resume continues a training that was stopped; --start box starts from the weights that come with the program.

  run.py train-removal --backgrounds photos hdri --lenses lenses --out build/removal
  run.py train-removal --backgrounds photos --flares my_flares --start box --out build/mine --iterations 4000""",
    arguments, (Step("train-removal", "engine", run),), resume_rule="resumes with --resume")
