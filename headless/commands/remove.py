# SPDX-License-Identifier: GPL-3.0-or-later
"""remove: removes the flares from plates."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.errors import FrameError, RunError, SettingsError, join_failures
from ...core.system.progress import Progress
from .. import frames, glow, jobs, plate_space
from ..command import Command, Step, reject_unused_options

if TYPE_CHECKING:
    from ...core.capture import Capture
    from ...core.removal.inference.remover import Remover


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("plates", type=Path, nargs="*", metavar="PLATE",
                        help="pictures (PNG, JPEG, TIFF, EXR, DPX and others), folders of them (plates that `remove` "
                             "wrote are left out), or videos, whose frames are extracted to DIR/NAME.frames")
    parser.add_argument("--run", type=Path, metavar="RUN",
                        help="instead of PLATE: subtract the flare of this run from the frames that it was fitted to")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE", help="the run's capture, if it was moved")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR_OR_VIDEO",
                        help="folder for the clean plates, which keep the names of the plates; or, for one video, a "
                             "video (.mov, .mp4, .mkv) with its sound, tags and timing, beside its frames in "
                             "NAME.frames")
    parser.add_argument("--codec", choices=("prores", "prores4444", "h264", "h265", "ffv1"),
                        help="codec of the clean video: ProRes 422 HQ or 4444, H.264, H.265 or FFV1 (default: ProRes "
                             "in .mov, FFV1 in .mkv, H.264 or, for more than 8 bits, H.265 in .mp4)")
    frames.add_option(parser, "numbers of frames, as in the names of the plates, such as 1-20,31 or 1-99:2; of "
                               "several sequences, in each (default: all)")
    frames.add_job_option(parser)
    parser.add_argument("--flare", type=Path, metavar="DIR", help="also write the flares, as EXR in linear light")
    parser.add_argument("--matte", type=Path, metavar="PICTURE_OR_DIR",
                        help="where the flares are, white on black: one picture for all plates, or a folder with one "
                             "of the same name for each; nothing is removed outside, and inside faint flares are "
                             "removed too")
    plate_space.add_option(parser)
    glow.add_options(parser)
    parser.add_argument("--amount", type=float, metavar="FACTOR",
                        help="factor on the flare that is removed, 0 to 1.5 (default 1): 0.8 leaves a part of it, 1.2 "
                             "removes more than the network predicts")
    parser.add_argument("--sensitivity", choices=("low", "normal", "high"),
                        help="how much evidence the removal needs (default normal). high: the plates are known to "
                             "have flares, so faint and doubtful ones are removed too. low: only obvious ones are "
                             "removed")
    parser.add_argument("--stills", action="store_true",
                        help="clean each plate by itself, without the plates before and after it")
    parser.add_argument("--working-size", type=int, metavar="PIXELS",
                        help="long side of the largest picture that the network gets (default 480, slightly more than "
                             "in its training)")
    parser.add_argument("--weights", type=Path, metavar="FILE",
                        help="weights from `train-removal` (default: the file that FIT_FLARE_WEIGHTS names, else "
                             "those that come with the program)")
    parser.add_argument("--model", choices=("network", "diffusion"), default="network",
                        help="network: the one that comes with the program. diffusion: a base model with a LoRA from "
                             "`train-removal`; needs diffusers, transformers and peft (default network)")
    parser.add_argument("--base", metavar="FOLDER_OR_NAME", help="the base model, for diffusion")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda", "mps"), default="auto",
                        help="where the network runs (default auto: a GPU that torch finds, else the processor)")
    jobs.add_option(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace existing clean plates")


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Subtract the flare of a fitted run (--run), or clean a video or plates, the latter in `--jobs` processes.

    Raises SettingsError for options that do not go together, and FrameError for plates that failed, after the others
    are done.
    """
    from ...core.images.video import is_video

    if (args.run is None) == (not args.plates):
        raise SettingsError("remove needs either plates or a fitted run with --run.")
    if args.run is not None:
        reject_unused_options(args, {"codec": None}, "a video that is cleaned to a video")
        return _remove_fitted_flare(args, progress)
    reject_unused_options(args, {"capture": None}, "--run")
    if is_video(args.out) and not args.out.is_dir():
        return _clean_video(args, progress)
    reject_unused_options(args, {"codec": None}, "a video that is cleaned to a video")
    return _clean_plates(args, progress)


def _clean_video(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Clean the frames of one video, and write them as a video when all are clean."""
    from ...core.removal.jobs.clean_video import frames_folder, require_single_video, write_clean_video

    target = args.out
    source = require_single_video(args.plates, target, args.codec)
    args.out = frames_folder(target)
    result = _clean_plates(args, progress)
    if write_clean_video(source, target, args.codec, progress, overwrite=args.overwrite):
        result["video"] = str(target)
    return result


def _clean_plates(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Clean plates into a folder, in `--jobs` processes; return the command's result.

    Raises FrameError for plates that failed, after the others are done.
    """
    from ...core.conventions.frame_numbers import NumberedFrame, number_sequences
    from ...core.removal.jobs.batch import clean_plates, collect_plates
    from ...core.removal.jobs.mattes import Mattes
    from ...core.removal.jobs.video_frames import expand_videos

    named_space = plate_space.named_space(args)
    inputs, left_out = expand_videos(args.plates, args.out, progress, None if named_space is None else named_space.name)
    for sentence in left_out:
        progress.say(f"Left out: {sentence}")
    failed = left_out if args.frames is None else []  # reported by the whole command, not by each part
    selected_paths = None
    if args.frames is not None or args.jobs != 1:
        plates = dict(collect_plates(inputs, [args.out, args.flare, args.matte]))
        available = [NumberedFrame(str(path), number, "") for path, number in number_sequences(plates).items()]
        selected = frames.select_task(available, args, progress)
        if not selected:
            return {"plates": str(args.out), "made": 0, "kept": 0}
        selected_paths = {plates[Path(frame.view)] for frame in selected}
        if args.jobs != 1:
            jobs.run_jobs(args, "remove", [frame.number for frame in selected], progress, continue_on_failure=True)
            if failed:
                raise FrameError(f"The other clean plates are in {args.out}. {join_failures(failed)}")
            progress.say(f"The clean plates are in {args.out}.")
            return {"plates": str(args.out)}
    return clean_plates(inputs, args.out, _make_remover(args, progress), progress, flare_folder=args.flare,
                        mattes=Mattes(args.matte) if args.matte else None, overwrite=args.overwrite,
                        only=selected_paths, independent=args.stills, failed_inputs=failed)


def _remove_fitted_flare(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Subtract the flare of a run from the frames of its capture. Raises SettingsError and RunError."""
    from ...core.conventions.frame_numbers import number_views
    from ...core.fit import Run
    from ...core.removal.jobs.fitted import remove_fitted_flare

    uses_network = args.model != "network" or glow.is_set(args) or args.amount is not None or any(
        (args.weights, args.working_size, args.matte, args.stills, args.base, args.sensitivity))
    if args.jobs != 1 or uses_network:
        raise SettingsError("--run subtracts the fitted flare; only --out, --frames, --flare, --capture and "
                            "--overwrite go with it.")
    fitted = Run.open(args.run)
    plate_space.record(args, fitted.find_capture(args.capture))
    if fitted.settings.mode == "3dgs":
        raise RunError(fitted.missing_flare_message)
    capture = fitted.open_capture(args.capture)
    selected = frames.select_task(number_views([view.name for view in capture.views]), args, progress)
    if not selected:
        return {"plates": str(args.out), "made": 0, "kept": 0}
    selected_names = {frame.view for frame in selected}
    views = [view for view in capture.views if view.name in selected_names]
    return remove_fitted_flare(fitted, capture, views, args.out, progress, flare_folder=args.flare,
                               overwrite=args.overwrite, fit_digest=fitted.fingerprint,
                               above_white=fitted.settings.display_white > 1)


def _make_remover(args: argparse.Namespace, progress: Progress) -> Remover:
    """Return the remover that the options select. Raises SettingsError and CaptureError."""
    from ...core.removal.inference.remover import WORKING_SIZE

    remover = _make_remover_of_model(args, WORKING_SIZE if args.working_size is None else args.working_size)
    remover.use_device(args.device)
    remover.use_controls(1.0 if args.amount is None else args.amount, args.sensitivity or "normal")
    space = plate_space.space_of_plates(args, args.plates, progress)
    if space is not None:
        remover.use_plate_space(space)
    return remover


def _make_remover_of_model(args: argparse.Namespace, size: int) -> Remover:
    """Return the remover of the model that the options select. Raises SettingsError."""
    from ...core.removal.inference.remover import Remover

    if args.model == "network":
        if args.base is not None:
            raise SettingsError("--base is only for --model diffusion; leave it out.")
        return Remover(args.weights, working_size=size, glow=glow.glow_mode(args))
    from ...core.removal.inference.diffusion import DiffusionRemover, check_packages

    check_packages()
    if args.base is None or args.weights is None or glow.is_set(args):
        raise SettingsError("--model diffusion needs --base and --weights, and takes neither --keep-glow nor "
                            "--all-glow: that choice is made when the LoRA is trained.")
    return DiffusionRemover(args.base, args.weights, working_size=size)


def with_clean_frames(capture: Capture, progress: Progress, *, is_flared: bool = False) -> Capture:
    """Return the capture with clean frames; they are made and written to its folder where it has none.

    is_flared: the lights of the capture are known to flare, so predicted flares are removed wherever one is on. Raises
    CaptureError where its clean frames were made from other frames.
    """
    from ...core.removal.inference.remover import Remover
    from ...core.removal.jobs.capture import clean_capture
    from ...core.removal.jobs.provenance import check_clean_frames_current

    if capture.has_clean_frames:
        check_clean_frames_current(capture)
        return capture
    progress.say(f"{capture.folder} has no removed/; making clean frames there.")
    flared_views = [view.name for view in capture.views if is_flared and any(
        capture.light_state(light, view).on != 0 for light in capture.lights)]
    clean_capture(capture, Remover(glow="remove"), progress, flared_views)
    return capture.reopen()


COMMAND = Command(
    "remove", "Removes the flares from plates.",
    """Writes each plate without its flare to DIR, in its own file format and bit depth. The network gets a reduced
plate; its flare is upsampled and subtracted in linear light, and pixels without flare keep their code values. A plate
that cannot be read does not stop the others and is listed at the end.

  run.py remove plate.exr --out clean
  run.py remove shots/sh010 --out clean/sh010 --flare flares/sh010 --keep-glow
  run.py remove clip.mp4 --out clean/clip                               # the clean frames as PNG or EXR
  run.py remove clip.mov --out clean.mov                                # a video, with sound and tags of the original
  run.py remove shots/sh010 --matte roto/sh010 --out clean/sh010        # only where the artist has marked flares
  run.py remove --run my_run --out clean          # subtracts the fitted flare""",
    arguments, (Step("remove", "engine", run),), resume_rule="resumes")
