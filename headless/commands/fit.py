# SPDX-License-Identifier: GPL-3.0-or-later
"""fit: separates a capture into scene and flare."""
from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ...core.capture import REMOVED
from ...core.choices import Blend, Mode, Model, Preset
from ...core.errors import CaptureError, SettingsError
from ...core.system.progress import Progress
from ...core.system.reading import UTF8_SIG, read_text
from ...core.typed import MAX_INT_DIGITS
from .. import device, jobs, plate_space, tallies
from ..command import Command, Step, check_at_least_one, parse_seed, reject_unused_options
from .lights import with_lights
from .remove import with_clean_frames

if TYPE_CHECKING:
    from ...core.capture import Capture
    from ...core.fit import FitSettings

DECODED_CACHE_BYTES = 1 << 26
SCENE_KINDS = ("gaussians", "plates")
"""Values of --scene that name no file."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments to a parser."""
    parser.add_argument("capture", type=Path, metavar="CAPTURE", nargs="?",
                        help="folder with images/, sparse/0/ (or transforms.json), lights.json, and removed/ or "
                             "truth/scene/; a missing lights.json is made from the frames; without a camera solve, "
                             "the frames of a shot")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder for the run")
    parser.add_argument("--list", type=Path, metavar="FILE", dest="list_file",
                        help="instead of CAPTURE: a text file with the folder of a capture on each line; --out is then "
                             "the folder of the runs, each under the name of its capture")
    parser.add_argument("--entry", type=int, metavar="N",
                        help="fit only this line of --list, from 1 (default: all lines)")
    jobs.add_option(parser, "captures of --list to fit at once on this machine")
    parser.add_argument("--resume", action="store_true",
                        help="resume the run in --out with its own settings; start it if there is none")
    parser.add_argument("--preset", choices=get_args(Preset), default="standard",
                        help="length and size of the fit (default standard)")
    parser.add_argument("--model", choices=get_args(Model),
                        help="form of the flare model: the paper's, or ours with rings and offsets")
    parser.add_argument("--mode", choices=get_args(Mode),
                        help="what supervises scene and flare. default: clean frames, taken as exact. estimated: clean "
                             "frames made by `remove`, and parallax. split: parallax alone. unsup: the paper's "
                             "variant without clean frames. in-flare: the scene is supervised by frame minus flare. "
                             "2d: flare Gaussians anywhere on the image plane. 3dgs: no flare. If omitted: default "
                             "for a capture with its own clean frames, else estimated")
    parser.add_argument("--blend", choices=get_args(Blend),
                        help="how the flare is combined with the scene. over: it covers, in display space. add: it "
                             "adds, in linear light")
    parser.add_argument("--holdout", metavar="FILE|N",
                        help="held-out views for `eval`: a split.json, or every Nth view, 0 for none (default: the "
                             "capture's split.json, else every 8th)")
    parser.add_argument("--size", type=int, metavar="WIDTH", help="width in pixels to fit at (default: the frames')")
    parser.add_argument("--iterations", type=int, metavar="N", help="length of the fit; every schedule scales with it")
    parser.add_argument("--seed", type=parse_seed, metavar="N", help="random seed (default 0)")
    parser.add_argument("--scene", type=Path, metavar="PLY_OR_KIND",
                        help="start from this 3DGS scene, trained elsewhere in the capture's world (INRIA's layout, as "
                             "gsplat, nerfstudio, Brush and Postshot write it, or PlayCanvas's compressed one); or "
                             "the kind of scene: gaussians, or plates (one clean frame per frame), which need no "
                             "cameras (default: plates if CAPTURE has no camera solve)")
    parser.add_argument("--freeze-scene", action="store_true",
                        help="keep the scene of --scene unchanged and fit the flare alone; needs no clean frames")
    plate_space.add_option(parser)
    device.add_option(parser, default=None)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="changes",
                        help="any other setting by its name in config.toml, such as flare.count=400; repeatable")


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Fit the capture, or every capture of the list in processes of their own.

    Raises SettingsError, CaptureError and RunError.
    """
    from ...core.capture import Capture
    from ...core.conventions.run_files import CONFIG
    from ...core.fit import Run, fit

    if args.list_file is not None and args.capture is not None:
        raise SettingsError("fit needs either a capture or a list of captures with --list, not both.")
    if args.list_file is None:
        reject_unused_options(args, {"entry": None, "jobs": 1}, "--list")
    check_at_least_one("--jobs", args.jobs)
    if args.list_file is not None and args.entry is None:
        return _fit_list(args, progress)
    folder, out = resolve_folders(args)
    is_resumed = args.resume and (out / CONFIG).is_file()
    if not is_resumed:
        Run.check_free(out)
    plate_space.record(args, folder)
    # The fit has its own cache, of smaller pictures.
    capture = Capture.open(folder, cache_bytes=DECODED_CACHE_BYTES, need_cameras=False)
    tallies.report_capture(capture, progress)
    settings = Run.open(out).settings if is_resumed else fit_settings(args, capture, progress)
    if settings.mode != "3dgs":
        capture = with_lights(capture, progress)
    capture = with_supervision(capture, settings, progress)
    capture, settings = adapt_to_absent_flare(capture, settings, progress, is_resumed=is_resumed)
    result = fit(capture, settings, out, progress, resume=args.resume, device=args.device)
    progress.say(f"The run is in {result.folder}: look at preview.png there, then run `eval` and `bake`.")
    used = {view.name for part in capture.split(settings.holdout) for view in part}
    tally = tallies.tally_capture(capture, used=len(used))
    tally.skip("in no list of the capture", *(view.name for view in capture.views if view.name not in used))
    return {"run": str(result.folder), **tallies.report_tally(tally, progress)}


def _fit_list(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Fit every capture of the list in a process of its own, --jobs at a time; return the command's result."""
    count = len(read_capture_list(args.list_file))
    part_options = [["--entry", str(entry), "--jobs", "1"] for entry in range(1, count + 1)]
    jobs.run_parts(args, "fit", part_options, args.jobs, count, progress, continue_on_failure=True)
    progress.say(f"{count} runs are in {args.out}.")
    return {"runs": str(args.out), "count": count}


def fit_settings(args: argparse.Namespace, capture: Capture, progress: Progress) -> FitSettings:
    """Return the settings from the arguments. Raises SettingsError."""
    from ...core.fit.overrides import override_settings
    from ...core.fit.settings import adapt_to_plates, adapt_to_trained_scene, preset

    kind = scene_kind(args.scene, capture, progress)
    overrides = {"model": args.model} if args.model else {}
    mode = args.mode or default_mode(capture, args.freeze_scene, progress)
    settings = preset(args.preset, mode=mode, blend=args.blend, iterations=args.iterations, **overrides)
    if kind == "plates":
        settings = adapt_to_plates(settings)
    changes = {"width": args.size, "seed": args.seed, "holdout": parse_holdout(args.holdout),
               "device": args.device}
    if args.scene and str(args.scene) not in SCENE_KINDS:
        if not args.scene.is_file():
            raise SettingsError(f"--scene {args.scene} is missing.")
        changes["scene.start"] = str(args.scene.resolve())
        settings = adapt_to_trained_scene(settings)
    changes["scene.frozen"] = args.freeze_scene or None
    changes = {name: value for name, value in changes.items() if value is not None}
    return override_settings(settings, {**changes, **dict(map(parse_setting, args.changes))}, progress)


def scene_kind(scene: Path | None, capture: Capture, progress: Progress) -> str:
    """Return the kind of scene of a fit, "gaussians" or "plates", by the option or by the capture; report plates that
    the capture requires.

    Raises CaptureError for Gaussians without a camera solve.
    """
    if not capture.has_cameras:
        if scene is not None and str(scene) != "plates":
            raise CaptureError(f"{capture.folder} has no camera solve, which a scene of Gaussians needs; run solve "
                               "first, or leave out --scene.")
        progress.say(f"{capture.folder} has no camera solve: its scene is plates, one clean frame per frame. The "
                     f"focal length is {capture.views[0].camera.focal_length:.0f} pixels, {capture.focal_source}.")
        return "plates"
    return "plates" if str(scene) == "plates" else "gaussians"


def with_supervision(capture: Capture, settings: FitSettings, progress: Progress) -> Capture:
    """Return the capture with the clean frames that a fit with these settings needs; they are made where missing."""
    # The exact scene of a rendered capture serves as its clean frames; a frozen scene needs none.
    has_exact = settings.supervised and capture.has_truth
    needs_clean_frames = settings.needs_clean_frames and not settings.scene.frozen and not has_exact
    return with_clean_frames(capture, progress, is_flared=settings.uses_plates) if needs_clean_frames else capture


def adapt_to_absent_flare(capture: Capture, settings: FitSettings, progress: Progress, *,
                          is_resumed: bool = False) -> tuple[Capture, FitSettings]:
    """Return capture and settings unchanged, or, if `remove` has found no flare in any frame, those of a fit that
    uses the frames as exact clean frames and has one light; report the latter.

    capture: with the clean frames that a fit with these settings needs. A resumed run keeps its mode.
    """
    from ...core.removal.jobs.provenance import has_exact_clean_frames, has_no_visible_flare

    modes = ("default",) if is_resumed else ("default", "estimated")
    if settings.mode not in modes or settings.scene.frozen or has_exact_clean_frames(capture):
        return capture, settings
    if not has_no_visible_flare(capture, progress):
        return capture, settings
    names = [light.name for light in capture.lights]
    others = f" Of the {len(names)} lights, the fit uses only {names[0]}." if len(names) > 1 else ""
    hint = (f"If the frames do show a flare, put clean frames from elsewhere into {capture.folder / REMOVED}."
            if settings.uses_plates else "To search for a flare all the same, use --mode split.")
    progress.say(f"`remove` has found no flare in the frames of {capture.folder}, so the fit takes these for exact "
                 f"clean frames, and its flare stays dark.{others} {hint}")
    return capture.with_lights(capture.lights[:1]), replace(settings, mode="default")


def default_mode(capture: Capture, frozen: bool, progress: Progress) -> Mode:
    """Return the mode of a fit without --mode.

    It is "default" with exact clean frames or a frozen scene, else "estimated", which is reported for a capture with
    cameras.
    """
    from ...core.removal.jobs.provenance import has_exact_clean_frames

    if frozen or has_exact_clean_frames(capture):
        return "default"
    if capture.has_cameras:
        progress.say(f"{capture.folder} has no exact clean frames: the mode is estimated, which separates scene and "
                     "flare by the clean frames that `remove` makes (removed/) and by parallax.")
    return "estimated"


def resolve_folders(args: argparse.Namespace) -> tuple[Path, Path]:
    """Return the folders of the capture and of the run. Raises SettingsError.

    With --list the run has the name of its capture, after the number of its entry where several have that name.
    """
    if args.list_file is None:
        if args.capture is None:
            raise SettingsError("fit needs a capture: name its folder, or a list of them with --list and --entry.")
        return args.capture, args.out
    folders = read_capture_list(args.list_file)
    if not 1 <= args.entry <= len(folders):
        raise SettingsError(f"{args.list_file} lists {len(folders)} captures; --entry {args.entry} is none of them.")
    names = [folder.resolve().name if folder.name in ("", "..") else folder.name for folder in folders]
    name, casefolded_names = names[args.entry - 1], [each.casefold() for each in names]  # "A" is "a" on Windows, macOS
    is_unique = casefolded_names.count(name.casefold()) == 1
    return folders[args.entry - 1], args.out / (name if is_unique else f"{args.entry:03d}_{name}")


def read_capture_list(path: Path) -> list[Path]:
    """Read a list of captures: one folder per line, relative to the list; # begins a comment. Raises SettingsError."""
    try:
        lines = read_text(path, encoding=UTF8_SIG).splitlines()
    except (OSError, UnicodeDecodeError) as problem:
        raise SettingsError(f"{path} cannot be read ({problem}); it should have a folder on each line.") from problem
    folders = [path.parent / line.strip() for line in lines if line.strip() and not line.startswith("#")]
    if not folders:
        raise SettingsError(f"{path} lists no captures; write a folder on each line.")
    return folders


def parse_holdout(text: str | None) -> str | int | None:
    """Parse --holdout as a number or as the absolute path of a file. Raises SettingsError."""
    if text is None:
        return None
    if text.isdecimal() and len(text) <= MAX_INT_DIGITS:
        return int(text)
    path = Path(text)
    if text.isdecimal() or not path.is_file():
        raise SettingsError(f"--holdout {text:.80} is neither a number nor a file such as split.json.")
    return str(path.resolve())


def parse_setting(text: str) -> tuple[str, Any]:
    """Parse "name=value"; the value is TOML, or else text. Raises SettingsError."""
    import tomllib

    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise SettingsError(f"--set {text} is not of the form name=value.")
    try:
        return name.strip(), tomllib.loads(f"value = {value}")["value"]
    except (ValueError, RecursionError):  # not TOML, or a number with too many digits
        return name.strip(), value.strip()


COMMAND = Command(
    "fit", "Separates a capture into scene and flare.",
    """Fits 3D Gaussians to the scene and a flare model to each light, and writes the folder RUN: config.toml,
flare.flare, scene.ply, preview.png, metrics.jsonl. --resume continues a fit that was stopped.

  run.py fit sample_scenes/desk --out build/desk --preset draft
  run.py fit my_capture --out my_run --size 960 --holdout 0 --resume
  run.py fit my_shot --out my_run             # frames without a camera solve: the scene is plates""",
    arguments, (Step("fit", "engine", run),), resume_rule="resumes with --resume")
