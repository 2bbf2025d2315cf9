# SPDX-License-Identifier: GPL-3.0-or-later
"""demo: the whole chain on the sample capture, from frames to composited frames."""
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
from .remove import with_removed

if TYPE_CHECKING:
    from ...core.capture import Capture
    from ...core.fit import FitSettings

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "sample_scenes" / "desk"
SHEET = "contact_sheet.png"
ROWS = 6


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "demo", metavar="DIR",
                        help="folder for everything (default build/demo in the repository)")
    parser.add_argument("--capture", type=Path, metavar="CAPTURE",
                        help="another capture than the sample; what it lacks, lights.json and removed/, is written "
                             "into it")
    without = parser.add_mutually_exclusive_group()
    without.add_argument("--split", action="store_true",
                         help="do without flare-free frames: tell scene and flare apart by parallax alone")
    without.add_argument("--remove", action="store_true",
                         help="take the flares out of the frames as `remove` does, and `fit` where there are no "
                              "flare-free frames, in place of the sample's exact ones")
    parser.add_argument("--model", choices=get_args(Model), help="the flare's form, as of `fit`")
    parser.add_argument("--iterations", type=int, metavar="N", help="length of the fit (default: the preset's)")
    parser.add_argument("--preset", choices=OUR_PRESETS, default="draft",
                        help="how long and how fine (default draft)")


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Fit, score, bake, and the contact sheet."""
    from ...core.bake.bake import bake
    from ...core.capture import Capture
    from ...core.conventions.frame_numbers import numbered
    from ...core.fit import fit as fit_capture
    from ...core.fit import preset

    source, out = words.capture or SAMPLE, words.out
    if not source.is_dir():
        raise CaptureError(f"There is no capture in {source}; the sample comes with the repository, "
                           "or name another with --capture.")
    began = time.monotonic()
    capture = with_lights(Capture.open(words.capture or _copy_of_sample(out, words.remove)), progress)
    if words.remove:
        capture = with_removed(capture, progress)
    mode: Mode = "split" if words.split else fit.mode_for(capture, False, progress)
    given = {"model": words.model} if words.model else {}
    settings = preset(words.preset, mode=mode, iterations=words.iterations, **given)
    capture = fit.with_what_teaches(capture, settings, progress)
    progress.say(f"{source.name}: {len(capture.views)} frames, {len(capture.lights)} lights. "
                 f"{_supervision(capture, mode)}")
    _check_earlier(out / "run", settings, capture)
    made = fit_capture(capture, settings, out / "run", progress, resume=True)
    result = evaluate.scores_of(made.folder, progress)
    cameras = {view.name: view.camera for view in made.capture(need_frames=False).views}
    bake(made, numbered(cameras), cameras, out / "layers", progress=progress, overwrite=True)
    _write_sheet(capture, made.settings.holdout, out)
    progress.say(f"In {out} there are now the run, the layers of {len(cameras)} frames (EXR), and {SHEET}; "
                 f"{time.monotonic() - began:.0f} s.")
    return {**result, "run": str(made.folder), "layers": str(out / "layers"), "sheet": str(out / SHEET)}


def _copy_of_sample(out: Path, remove: bool) -> Path:
    """The sample's frames and cameras in DIR/capture, where what is found in them can be written; without its
    lights, which are to be found, and, to `remove`, without its flare-free frames, which are to be made."""
    copy = out / ("capture-removal" if remove else "capture")
    left_out = [LIGHTS, REMOVED] if remove else [LIGHTS]
    if not copy.exists():
        with atomic_folder(copy) as temporary:
            shutil.copytree(SAMPLE, temporary, ignore=shutil.ignore_patterns(*left_out), dirs_exist_ok=True)
    return copy


def _check_earlier(folder: Path, settings: FitSettings, capture: Capture) -> None:
    """An earlier run is gone on with, so it must be the one that is asked for now."""
    from ...core.conventions.run_files import CONFIG
    from ...core.fit.run import Run

    if (folder / CONFIG).exists():
        earlier = Run.open(folder)
        asked = replace(earlier.settings, white=settings.white)  # which the fit has found by itself
        if asked != settings or earlier.capture_folder != capture.folder.resolve():
            raise RunError(f"{folder} holds a fit with other settings or of another capture; remove it, or choose "
                           "another folder with --out.")


def _supervision(capture: Capture, mode: Mode) -> str:
    """Where the flare-free frames come from, which the scene is learned from."""
    if mode == "split":
        return "No flare-free frame is looked at."
    if mode == "estimated":
        return f"The flare-free frames are estimates, those that `remove` made in {capture.folder / REMOVED}."
    if capture.has_removed:
        return f"The flare-free frames are those in {capture.folder / REMOVED}; no flare is removed here."
    if capture.has_truth:
        return f"The flare-free frames are the exact ones in {capture.folder / 'truth' / 'scene'}."
    return "There are no flare-free frames."


def _write_sheet(capture: Capture, holdout: str | int | None, out: Path) -> None:
    """Some held-out views (or some of all), from the files that were baked."""
    from ...core.bake.bake import read_record
    from ...core.bake.exr import read_layers
    from ...core.bake.sheet import contact_sheet

    views = capture.split(holdout)[1] or capture.views
    step = max(len(views) // ROWS, 1)
    files = {entry["view"]: out / "layers" / entry["file"] for entry in read_record(out / "layers")["frames"]}
    contact_sheet(out / SHEET, ((view.name, capture.frame(view), read_layers(files[view.name]))
                                for view in views[::step][:ROWS]))


def frames(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """The compositor's frames."""
    done = compose.frames_of(words.out / "layers", words.out / "frames", progress)
    progress.say(f"Blender {done['blender']} composited the frames in {done['frames']}; {done['blend']} opens there.")
    return done


COMMAND = Command(
    "demo", "Runs the whole chain on the sample capture: lights, fit, eval, bake, composited frames.",
    f"""Writes DIR/capture (a copy of the sample; DIR/capture-removal with --remove), DIR/run, DIR/layers (EXR),
DIR/frames (through Blender's compositor), DIR/{SHEET} (frame | composite | scene | flare), and shows the
table of scores. Given again, it goes on where it was; other settings want a folder of their own.

  run.py demo
  blender -b -P headless/run.py -- demo""",
    arguments, (Step("chain", "engine", run), Step("frames", "blender", frames, optional=True)), after_a_stop="goes on")
