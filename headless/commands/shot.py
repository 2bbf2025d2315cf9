# SPDX-License-Identifier: GPL-3.0-or-later
"""shot: runs all steps from a clip to the layers of its flare."""
from __future__ import annotations

import argparse
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core.capture import LIGHTS
from ...core.choices import OUR_PRESETS
from ...core.errors import CaptureError, EngineError, FrameError, RunError, SettingsError
from ...core.system.files import atomic_folder, write_json
from ...core.system.progress import Progress
from ..command import Command, Step
from . import compose, fit
from .demo import SHEET, write_sheet
from .evaluate import score_run
from .lights import with_lights

if TYPE_CHECKING:
    from ...core.capture import Capture
    from ...core.fit import Run

SCENES = ("auto", "gaussians", "plates")
FRAMES, SOLVED, RUN, LAYERS, CLEAN = "shot", "capture", "run", "layers", "clean"
"""Folders below DIR: frames without cameras, frames with solved cameras, and the results."""
MIN_SOLVED_SHARE = 0.95
"""Share of the frames that a camera solve has to place; below it, the scene is plates."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("source", type=Path, metavar="CLIP_OR_FRAMES",
                        help="a video, a folder of frames, or a capture")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for all results")
    parser.add_argument("--scene", choices=SCENES, default="auto",
                        help="gaussians: solve the camera and fit a 3D scene. plates: one clean frame per frame, "
                             "without cameras. auto: gaussians if the camera can be solved and the lights stand, else "
                             "plates (default auto)")
    parser.add_argument("--focal", type=float, metavar="PIXELS",
                        help="focal length of the frames without a camera solve (default: from Exif data, or a usual "
                             "one)")
    parser.add_argument("--preset", choices=OUR_PRESETS, default="standard",
                        help="length and size of the fit (default standard)")
    parser.add_argument("--iterations", type=int, metavar="N", help="length of the fit (default: from the preset)")
    parser.add_argument("--size", type=int, metavar="PIXELS",
                        help="largest width of the frames that the fit sees (default 480)", default=480)
    parser.add_argument("--holdout", metavar="N_OR_FILE", default="0",
                        help="hold out every Nth frame, or those of a split file, and score them (default 0: none)")


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Engine step: capture, lights, clean frames, fit, layers, clean frames by the fit, contact sheet."""
    from ...core.bake.bake import bake
    from ...core.conventions.frame_numbers import number_views
    from ...core.fit import fit as fit_capture
    from ...core.removal.jobs.fitted import remove_fitted_flare

    start, out = time.monotonic(), args.out
    capture, kind = _open_capture(args, progress)
    settings = _fit_settings(args, kind, capture, progress)
    capture = fit.with_supervision(capture, settings, progress)
    capture, settings = fit.adapt_to_absent_flare(capture, settings, progress, is_resumed=_has_run(args))
    run_ = fit_capture(capture, settings, out / RUN, progress, resume=True)
    scores = _score_held_out(run_, progress)
    capture = run_.open_capture()
    cameras = {view.name: view.camera for view in capture.views}
    bake(run_, number_views(cameras), cameras, out / LAYERS, progress=progress, overwrite=True)
    remove_fitted_flare(run_, capture, capture.views, out / CLEAN, progress, fit_digest=run_.fingerprint,
                        above_white=run_.settings.display_white > 1)
    write_sheet(capture, run_.settings.holdout, out)
    progress.say(f"The run, the layers of {len(cameras)} frames (EXR), the clean frames and {SHEET} are in {out}; "
                 f"{time.monotonic() - start:.0f} s.")
    return {**scores, "scene": kind, "run": str(run_.folder), "layers": str(out / LAYERS), "clean": str(out / CLEAN),
            "sheet": str(out / SHEET)}


def _open_capture(args: argparse.Namespace, progress: Progress) -> tuple[Capture, str]:
    """Return the capture with its lights, and the kind of its scene, "gaussians" or "plates"; report the choice.

    Raises CaptureError where --scene gaussians is asked for and the camera cannot be solved.
    """
    from ...core.capture import Capture

    source: Path = args.source
    if not source.exists():
        raise CaptureError(f"{source} is missing; name a video or a folder of frames.")
    if args.scene != "plates":
        solved, reason = _try_solve(args, progress)
        if solved is not None:
            capture = with_lights(solved, progress)
            moving_lights = [light.name for light in capture.lights if light.moves]
            if not moving_lights or args.scene == "gaussians":
                progress.say("The camera is solved: the scene is Gaussians in 3D.")
                return capture, "gaussians"
            reason = f"lights move ({', '.join(moving_lights)})."
        elif args.scene == "gaussians":
            raise CaptureError(f"The camera cannot be solved: {reason}")
        progress.say(f"The scene is plates, one clean frame per frame: {reason}")
    folder = _prepare_frames_folder(args, progress)
    if args.focal is not None:
        width = Capture.open(folder, need_cameras=False).views[0].camera.width
        write_json(folder / "camera.json", {"focal_px": args.focal, "width": width})
    return with_lights(Capture.open(folder, need_cameras=False), progress), "plates"


def _try_solve(args: argparse.Namespace, progress: Progress) -> tuple[Capture | None, str]:
    """Return the source as a capture with cameras, solved if necessary, and ""; or None, and the reason as a
    sentence."""
    from ...core.capture import Capture
    from ...core.capture.solve import SolveSettings, solve

    if args.source.is_dir():
        try:
            return Capture.open(args.source), ""
        except (CaptureError, FrameError):
            pass  # frames alone
    try:
        report = solve(args.source, args.out / SOLVED, SolveSettings(), progress)
    except (CaptureError, FrameError, RunError, EngineError) as problem:
        return None, str(problem)
    if report["registered"] < MIN_SOLVED_SHARE * report["frames"]:
        return None, f"a solve places {report['registered']} of {report['frames']} frames."
    return Capture.open(args.out / SOLVED), ""


def _prepare_frames_folder(args: argparse.Namespace, progress: Progress) -> Path:
    """Return DIR/shot with the frames of the source in images/: extracted from a video, or copied."""
    from ...core.images.listing import pictures_below
    from ...core.images.video import is_video
    from ...core.removal.jobs.video_frames import extract_frames

    source, folder = args.source, args.out / FRAMES
    if source.is_file():
        if not is_video(source):
            raise SettingsError(f"{source} is neither a video nor a folder of frames; name one.")
        frames = extract_frames(source, args.out, progress)
        source = frames
    if not folder.exists():
        images = source / "images" if (source / "images").is_dir() else source
        with atomic_folder(folder) as temporary:
            for path in pictures_below(images):
                copy_path = temporary / "images" / path.relative_to(images)
                copy_path.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copy_path)
            for name in ("camera.json", LIGHTS):
                if (source / name).is_file():
                    shutil.copyfile(source / name, temporary / name)
    return folder


def _fit_settings(args: argparse.Namespace, kind: str, capture: Capture, progress: Progress) -> Any:
    """Return the settings of the fit: of an existing run, which is then resumed, else new ones. kind: "plates" for a
    scene of plates."""
    from ...core.fit import Run, preset
    from ...core.fit.overrides import override_settings
    from ...core.fit.settings import adapt_to_plates

    if _has_run(args):
        return Run.open(args.out / RUN).settings
    mode = fit.default_mode(capture, False, progress)
    settings = preset(args.preset, mode=mode, iterations=args.iterations)
    if kind == "plates":
        settings = adapt_to_plates(settings)
    return override_settings(settings, {"width": args.size, "holdout": fit.parse_holdout(args.holdout)})


def _has_run(args: argparse.Namespace) -> bool:
    """Return whether the fit has begun before, and is resumed."""
    from ...core.conventions.run_files import CONFIG

    return (args.out / RUN / CONFIG).is_file()


def _score_held_out(run_: Run, progress: Progress) -> dict[str, Any]:
    """Score the held-out views, if there are any."""
    held_out = run_.open_capture().split(run_.settings.holdout)[1]
    return score_run(run_.folder, progress) if held_out else {}


def build_compositor(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Blender step: build the compositor over the layers; it renders no frame."""
    from ...core.bake.folder import LayerFolder

    if (args.out / "compositor" / compose.BLEND).is_file():
        return {"blend": str(args.out / "compositor" / compose.BLEND)}
    result = compose.compose_frames(LayerFolder.open(args.out / LAYERS), args.out / "compositor", progress, numbers=[])
    progress.say(f"{result['blend']} opens in Blender, with the layers in its compositor.")
    return {"blend": result["blend"]}


COMMAND = Command(
    "shot", "Runs all steps on a clip: frames, lights, clean frames, fit, layers, compositor.",
    f"""Makes a flare and its layers from any shot: a still or moving camera, lights that stand, move, dim or go out.
Writes DIR/{RUN} (with flare.flare), DIR/{LAYERS} (EXR), DIR/{CLEAN} (frames without the flare), DIR/{SHEET} and
DIR/compositor/{compose.BLEND}, and says what it chose. If it is run again, it continues where it stopped.

  run.py shot clip.mp4 --out build/clip
  run.py shot frames/sh010 --out build/sh010 --scene plates --focal 1800""",
    arguments, (Step("chain", "engine", run), Step("compositor", "blender", build_compositor, optional=True)),
    resume_rule="resumes")
