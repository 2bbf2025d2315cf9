# SPDX-License-Identifier: GPL-3.0-or-later
"""demo: runs all steps on the sample capture, from frames to composited frames."""
from __future__ import annotations

import argparse
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ...core.capture import LIGHTS, REMOVED
from ...core.choices import OUR_PRESETS, Mode, Model
from ...core.errors import CaptureError, RunError
from ...core.system.files import atomic_folder
from ...core.system.progress import Progress
from ..command import Command, Step
from . import compose, evaluate, fit
from .lights import with_lights
from .remove import with_clean_frames

if TYPE_CHECKING:
    from ...core.capture import Capture
    from ...core.fit import FitSettings

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "sample_scenes" / "desk"
SHEET = "contact_sheet.png"
SHEET_ROWS = 6


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "demo", metavar="DIR",
                        help="folder for all results (default build/demo in the repository)")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE",
                        help="a capture in place of the sample; lights.json and removed/ are written into it where "
                             "they are missing")
    supervision = parser.add_mutually_exclusive_group()
    supervision.add_argument("--split", action="store_true",
                             help="use no clean frames: separate scene and flare by parallax alone")
    supervision.add_argument("--remove", action="store_true",
                             help="estimate the clean frames with the removal network, in place of the sample's exact "
                                  "ones")
    parser.add_argument("--model", choices=get_args(Model), help="form of the flare model, as for `fit`")
    parser.add_argument("--iterations", type=int, metavar="N", help="length of the fit (default: from the preset)")
    parser.add_argument("--preset", choices=OUR_PRESETS, default="draft",
                        help="length and size of the fit (default draft)")


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Engine step: fit, evaluate and bake the capture, and write the contact sheet."""
    from ...core.bake.bake import bake
    from ...core.capture import Capture
    from ...core.conventions.frame_numbers import number_views
    from ...core.fit import fit as fit_capture
    from ...core.fit import preset

    source, out = args.capture or SAMPLE, args.out
    if not source.is_dir():
        raise CaptureError(f"There is no capture in {source}; the sample comes with the repository, "
                           "or name another with --capture.")
    start = time.monotonic()
    capture = with_lights(Capture.open(args.capture or _copy_sample(out, args.remove)), progress)
    if args.remove:
        capture = with_clean_frames(capture, progress)
    mode: Mode = "split" if args.split else fit.default_mode(capture, False, progress)
    overrides = {"model": args.model} if args.model else {}
    settings = preset(args.preset, mode=mode, iterations=args.iterations, **overrides)
    capture = fit.with_supervision(capture, settings, progress)
    capture, settings = fit.adapt_to_absent_flare(capture, settings, progress)
    progress.say(f"{source.name}: {len(capture.views)} frames, {len(capture.lights)} lights. "
                 f"{_describe_supervision(capture, settings.mode)}")
    _check_resumable(out / "run", settings, capture)
    run_ = fit_capture(capture, settings, out / "run", progress, resume=True)
    result = evaluate.score_run(run_.folder, progress)
    cameras = {view.name: view.camera for view in run_.open_capture(need_frames=False).views}
    bake(run_, number_views(cameras), cameras, out / "layers", progress=progress, overwrite=True)
    write_sheet(capture, run_.settings.holdout, out)
    progress.say(f"The run, the layers of {len(cameras)} frames (EXR) and {SHEET} are in {out}; "
                 f"{time.monotonic() - start:.0f} s.")
    return {**result, "run": str(run_.folder), "layers": str(out / "layers"), "sheet": str(out / SHEET)}


def _copy_sample(out: Path, without_clean_frames: bool) -> Path:
    """Copy the sample to `out`/capture, or without its clean frames to `out`/capture-removal; return that folder. An
    existing copy is used again.

    The demo finds the lights, so lights.json is left out. without_clean_frames: leave out removed/ too, which the demo
    estimates.
    """
    copy = out / ("capture-removal" if without_clean_frames else "capture")
    left_out = [LIGHTS, REMOVED] if without_clean_frames else [LIGHTS]
    if not copy.exists():
        with atomic_folder(copy) as temporary:
            shutil.copytree(SAMPLE, temporary, ignore=shutil.ignore_patterns(*left_out), dirs_exist_ok=True)
    return copy


def _check_resumable(folder: Path, settings: FitSettings, capture: Capture) -> None:
    """Raise RunError where `folder` holds a run of other settings or of another capture, which cannot be resumed."""
    from ...core.conventions.run_files import CONFIG
    from ...core.fit.run import Run

    if (folder / CONFIG).exists():
        earlier = Run.open(folder)
        stored = replace(earlier.settings, white=settings.white)  # the fit sets it
        if stored != settings or earlier.capture_folder != capture.folder.resolve():
            raise RunError(f"{folder} holds a fit with other settings or of another capture; remove it, or choose "
                           "another folder with --out.")


def _describe_supervision(capture: Capture, mode: Mode) -> str:
    """Return a sentence on the source of the clean frames that supervise the scene."""
    if mode == "split":
        return "No clean frames are used."
    if mode == "estimated":
        return f"The clean frames are estimates that `remove` made in {capture.folder / REMOVED}."
    if capture.has_clean_frames:
        return f"The clean frames are those in {capture.folder / REMOVED}; the removal network does not run."
    if capture.has_truth:
        return f"The clean frames are the exact ones in {capture.folder / 'truth' / 'scene'}."
    return "There are no clean frames."


def write_sheet(capture: Capture, holdout: str | int | None, out: Path) -> None:
    """Write the contact sheet of up to SHEET_ROWS held-out views (of all views where none is held out).

    The layers are those in `out`/layers. holdout: as in the settings of a fit.
    """
    from ...core.bake.bake import read_manifest
    from ...core.bake.exr import read_layers
    from ...core.bake.sheet import contact_sheet

    views = capture.split(holdout)[1] or capture.views
    step = max(len(views) // SHEET_ROWS, 1)
    files = {entry["view"]: out / "layers" / entry["file"] for entry in read_manifest(out / "layers")["frames"]}
    contact_sheet(out / SHEET, ((view.name, capture.frame(view), read_layers(files[view.name]))
                                for view in views[::step][:SHEET_ROWS]))


def composite_frames(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Blender step: composite the baked layers."""
    from ...core.bake.folder import LayerFolder

    result = compose.compose_frames(LayerFolder.open(args.out / "layers"), args.out / "frames", progress)
    progress.say(f"Blender {result['blender']} composited the frames in {result['frames']}; {result['blend']} opens "
                 "there.")
    return result


COMMAND = Command(
    "demo", "Runs all steps on the sample capture: lights, fit, eval, bake, composited frames.",
    f"""Writes DIR/capture (a copy of the sample; DIR/capture-removal with --remove), DIR/run, DIR/layers (EXR),
DIR/frames (through Blender's compositor) and DIR/{SHEET} (frame | composite | scene | flare), and shows the
table of scores. If you run it again, it resumes. Other
settings need another folder.

  run.py demo
  blender -b -P headless/run.py -- demo""",
    arguments, (Step("chain", "engine", run), Step("frames", "blender", composite_frames, optional=True)),
    resume_rule="resumes")
