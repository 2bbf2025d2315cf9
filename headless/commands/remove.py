# SPDX-License-Identifier: GPL-3.0-or-later
"""remove: plates without their flares."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import FrameError, RunError, SettingsError, spelled_out
from ...core.system.progress import Progress
from .. import frames, glow, jobs
from ..command import Command, Step, refuse_useless

if TYPE_CHECKING:
    from ...core.capture import Capture
    from ...core.removal.inference.remover import Remover


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plates", type=Path, nargs="*", metavar="PLATE",
                        help="pictures (PNG, JPEG, TIFF, EXR), folders of them, where clean plates are left out, "
                             "or videos, whose frames are taken out into DIR/NAME.frames")
    parser.add_argument("--run", type=Path, metavar="RUN",
                        help="instead of PLATE: the frames of the capture that this run was fitted to, less the flare "
                             "that it found in them")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE", help="where the run's capture is, if it was moved")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR",
                        help="folder for the clean plates, under the names that the plates have")
    frames.add_option(parser, "frame numbers, such as 1-20,31 or 1-99:2, of those in the plates' names; all where not "
                               "given")
    parser.add_argument("--flare", type=Path, metavar="DIR", help="write the flares too, as EXR in linear light")
    parser.add_argument("--matte", type=Path, metavar="PICTURE_OR_DIR",
                        help="where the flares are, white on black: one picture for all plates, or a folder with one "
                             "for each, of its name; nothing is taken elsewhere, and what is faint is taken too")
    glow.add_options(parser)
    parser.add_argument("--stills", action="store_true",
                        help="clean each plate by itself, in place of in line with those before and after it in its "
                             "folder")
    parser.add_argument("--working-size", type=int, metavar="PIXELS",
                        help="long side of the largest view that the network sees (default 480, a little more than it "
                             "was trained at)")
    parser.add_argument("--weights", type=Path, metavar="FILE",
                        help="weights of train-removal's (default: those that come with the program)")
    parser.add_argument("--model", choices=("network", "diffusion"), default="network",
                        help="network: the one that comes with the program; diffusion: a base model and a LoRA of "
                             "train-removal's, if diffusers, transformers and peft are at hand")
    parser.add_argument("--base", metavar="FOLDER_OR_NAME", help="the base model, for diffusion")
    jobs.add_option(parser)
    parser.add_argument("--overwrite", action="store_true", help="make again what is there")


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from ...core.conventions.frame_numbers import numbered
    from ...core.removal.jobs.batch import plates_of, remove_all
    from ...core.removal.jobs.mattes import Mattes
    from ...core.removal.jobs.video_frames import with_frames

    if (words.run is None) == (not words.plates):
        raise SettingsError("remove needs plates, or a fitted run with --run: the one or the other.")
    if words.run is not None:
        return _by_run(words, progress)
    refuse_useless(words, {"capture": None}, "--run")
    given, left_out = with_frames(words.plates, words.out, progress)
    for sentence in left_out:
        progress.say(f"Left out: {sentence}")
    failed = left_out if words.frames is None else []  # a share of the frames does not fail by a video without any
    wanted = None
    if words.frames is not None or words.jobs != 1:
        names = [name.as_posix() for _, name in plates_of(given, [words.out, words.flare, words.matte])]
        chosen = frames.asked(numbered(names), words.frames, progress)
        wanted = {Path(frame.view) for frame in chosen}
        if words.jobs != 1:
            jobs.run_jobs(words, "remove", [frame.number for frame in chosen], progress, past_failures=True)
            if failed:
                raise FrameError(f"The other clean plates are in {words.out}. {spelled_out(failed)}")
            progress.say(f"The clean plates are in {words.out}.")
            return {"plates": str(words.out)}
    return remove_all(given, words.out, _remover(words), progress, flare_folder=words.flare,
                      mattes=Mattes(words.matte) if words.matte else None, overwrite=words.overwrite, wanted=wanted,
                      stills=words.stills, left_out=failed)


def _by_run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from ...core.conventions.frame_numbers import numbered
    from ...core.fit import Run
    from ...core.removal.jobs.fitted import remove_fitted

    network = (words.weights, words.working_size, words.matte, words.stills, words.base)
    if words.jobs != 1 or words.model != "network" or glow.is_asked(words) or any(network):
        raise SettingsError("--run takes away the flare that was fitted: of the other options only --out, --frames, "
                            "--flare, --capture and --overwrite go with it.")
    fitted = Run.open(words.run)
    if fitted.settings.mode == "3dgs":
        raise RunError(fitted.without_flare)
    capture = fitted.capture(words.capture)
    chosen = frames.asked(numbered([view.name for view in capture.views]), words.frames, progress)
    wanted = {frame.view for frame in chosen}
    return remove_fitted(fitted, capture, [view for view in capture.views if view.name in wanted], words.out, progress,
                         flare_folder=words.flare, overwrite=words.overwrite, made_by=fitted.fingerprint,
                         above_white=fitted.settings.display_white > 1)


def _remover(words: argparse.Namespace) -> Remover:
    from ...core.removal.inference.remover import WORKING_SIZE, Remover

    size = WORKING_SIZE if words.working_size is None else words.working_size
    if words.model == "network":
        if words.base is not None:
            raise SettingsError("--base is for --model diffusion; leave it out.")
        return Remover(words.weights, working_size=size, glow=glow.asked(words))
    from ...core.removal.inference.diffusion import DiffusionRemover, need

    need()
    if words.base is None or words.weights is None or glow.is_asked(words):
        raise SettingsError("--model diffusion wants --base and --weights, and knows no --keep-glare and no "
                            "--all-glare: a LoRA is trained for the one or the other.")
    return DiffusionRemover(words.base, words.weights, working_size=size)


def with_removed(capture: Capture, progress: Progress) -> Capture:
    """The capture with its flare-free frames, which are made and written into its folder if it has none. Raises
    CaptureError where it has some that were made of other frames."""
    from ...core.removal.inference.remover import Remover
    from ...core.removal.jobs.capture import remove_from
    from ...core.removal.jobs.provenance import check_removed

    if capture.has_removed:
        check_removed(capture)
        return capture
    progress.say(f"{capture.folder} has no removed/: the flares are taken out of its frames, and what comes of that is "
                 "kept there.")
    remove_from(capture, Remover(glow="taken"), progress)
    return capture.reopened()


COMMAND = Command(
    "remove", "Takes the flares out of plates.",
    """Writes each plate without its flare to DIR, in the kind and depth it came in. The network sees a reduced
plate; the flare is carried up to full size and taken away in linear light, and where there is none the plate
is kept to the last bit. A plate that cannot be read is told at the end, and does not stop the others.

  run.py remove plate.exr --out clean
  run.py remove shots/sh010 --out clean/sh010 --flare flares/sh010 --keep-glare
  run.py remove clip.mp4 --out clean/clip                               # the clean frames as PNG
  run.py remove shots/sh010 --matte roto/sh010 --out clean/sh010        # where the artist says that they are
  run.py remove --run my_run --out clean          # what `fit` found, out of the frames it was fitted to""",
    arguments, (Step("remove", "engine", run),), after_a_stop="goes on")
