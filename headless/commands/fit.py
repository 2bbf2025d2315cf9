# SPDX-License-Identifier: GPL-3.0-or-later
"""fit: a capture, separated into scene and flare."""
from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ...core.choices import Blend, Mode, Model, Preset
from ...core.errors import SettingsError
from ...core.system.files import WRITTEN_BY_HAND
from ...core.system.progress import Progress
from ...core.typed import WHOLE_DIGITS
from .. import jobs
from ..command import Command, Step, from_1, refuse_useless, seed
from .lights import with_lights
from .remove import with_removed

if TYPE_CHECKING:
    from ...core.capture import Capture
    from ...core.fit import FitSettings

DECODED_BYTES = 1 << 26


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("capture", type=Path, metavar="CAPTURE", nargs="?",
                        help="folder with images/, sparse/0/ (or transforms.json), removed/ or truth/scene/, and "
                             "lights.json; lights are found and written there if it is missing")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder for the run")
    parser.add_argument("--list", type=Path, metavar="FILE", dest="listed",
                        help="a text file with a capture's folder on each line, instead of CAPTURE: --out is then the "
                             "folder of the runs, each under its capture's name")
    parser.add_argument("--entry", type=int, metavar="N", help="which line of --list, from 1 (default: all of them)")
    jobs.add_option(parser, "captures of a --list that are fitted at once on this machine")
    parser.add_argument("--resume", action="store_true",
                        help="go on with the run in --out, with the settings it was begun with; begin it if there is "
                             "none")
    parser.add_argument("--preset", choices=get_args(Preset), default="standard",
                        help="how long and how fine (default standard)")
    parser.add_argument("--model", choices=get_args(Model),
                        help="the flare's form: the paper's, or ours with rings and offsets")
    parser.add_argument("--mode", choices=get_args(Mode),
                        help="default: with flare-free frames that are taken for exact; estimated: with those that "
                             "`remove` makes, by which the scene is looked for, and parallax; split: by parallax "
                             "alone; unsup: as the paper does without; in-flare: scene supervised by frame less "
                             "flare; 2d: flare free on the plane; 3dgs: scene alone (if not given: default where the "
                             "capture has flare-free frames of its own, else estimated)")
    parser.add_argument("--blend", choices=get_args(Blend),
                        help="over: the flare covers, in display space; add: it adds, in linear light")
    parser.add_argument("--holdout", metavar="FILE|N",
                        help="views kept for eval: a split.json, or every Nth, 0 for none (default: the capture's "
                             "split.json, else every 8th)")
    parser.add_argument("--size", type=int, metavar="WIDTH", help="work at this width in pixels (default: the frames')")
    parser.add_argument("--iterations", type=int, metavar="N", help="length, with every schedule stretched to it")
    parser.add_argument("--seed", type=seed, metavar="N", help="of all randomness (default 0)")
    parser.add_argument("--scene", type=Path, metavar="PLY",
                        help="begin with this 3DGS scene, trained elsewhere in the capture's world (INRIA's layout, as "
                             "gsplat, nerfstudio, Brush and Postshot write it, or PlayCanvas's compressed one)")
    parser.add_argument("--freeze-scene", action="store_true",
                        help="leave the scene of --scene as it is and fit the flare alone; needs no flare-free frames")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="changes",
                        help="any other setting by its name in config.toml, e.g. flare.count=400; repeatable")


def run(words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from ...core.capture import Capture
    from ...core.conventions.run_files import CONFIG
    from ...core.fit import Run, fit

    if words.listed is not None and words.capture is not None:
        raise SettingsError("fit takes a capture, or a list of them with --list: the one or the other.")
    if words.listed is None:
        refuse_useless(words, {"entry": None, "jobs": 1}, "--list")
    from_1("--jobs", words.jobs)
    if words.listed is not None and words.entry is None:
        count = len(listed(words.listed))
        parts = [["--entry", str(entry), "--jobs", "1"] for entry in range(1, count + 1)]
        jobs.run_parts(words, "fit", parts, words.jobs, count, progress, past_failures=True)
        progress.say(f"{count} runs are in {words.out}.")
        return {"runs": str(words.out), "count": count}
    folder, out = place(words)
    goes_on = words.resume and (out / CONFIG).is_file()
    if not goes_on:
        Run.check_free(out)
    # The fit keeps pictures itself, and smaller.
    capture = Capture.open(folder, cache_bytes=DECODED_BYTES)
    settings = Run.open(out).settings if goes_on else chosen(words, capture, progress)
    if settings.mode != "3dgs":
        capture = with_lights(capture, progress)
    capture = with_what_teaches(capture, settings, progress)
    done = fit(capture, settings, out, progress, resume=words.resume)
    progress.say(f"The run is in {done.folder}: see preview.png there, then `eval` and `bake` it.")
    return {"run": str(done.folder)}


def chosen(words: argparse.Namespace, capture: Capture, progress: Progress) -> FitSettings:
    """The settings that the words ask for. Raises SettingsError."""
    from ...core.fit.settings import changed, preset

    given = {"model": words.model} if words.model else {}
    mode = words.mode or mode_for(capture, words.freeze_scene, progress)
    settings = preset(words.preset, mode=mode, blend=words.blend, iterations=words.iterations, **given)
    changes = {"width": words.size, "seed": words.seed, "holdout": holdout(words.holdout)}
    if words.scene:
        if not words.scene.is_file():
            raise SettingsError(f"--scene {words.scene} is missing.")
        changes["scene.start"] = str(words.scene.resolve())
    changes["scene.frozen"] = words.freeze_scene or None
    changes = {name: value for name, value in changes.items() if value is not None}
    return changed(settings, {**changes, **dict(map(change, words.changes))})


def with_what_teaches(capture: Capture, settings: FitSettings, progress: Progress) -> Capture:
    """The capture with the flare-free frames that a fit with these settings looks at, made where it has none."""
    exact = settings.supervised and capture.has_truth
    needed = settings.looks_at_removed and not settings.scene.frozen and not exact
    return with_removed(capture, progress) if needed else capture


def mode_for(capture: Capture, frozen: bool, progress: Progress) -> Mode:
    """What a fit goes by where nobody says: flare-free frames if there are any, exact ones before estimates."""
    from ...core.removal.jobs.provenance import has_exact

    if frozen or has_exact(capture):
        return "default"
    progress.say(f"{capture.folder} has no flare-free frames but those that `remove` makes (removed/): scene and flare "
                 "are told apart by these and by parallax, mode estimated.")
    return "estimated"


def place(words: argparse.Namespace) -> tuple[Path, Path]:
    """The capture's folder, and the run's."""
    if words.listed is None:
        if words.capture is None:
            raise SettingsError("fit needs a capture: name its folder, or a list of them with --list and --entry.")
        return words.capture, words.out
    folders = listed(words.listed)
    if not 1 <= words.entry <= len(folders):
        raise SettingsError(f"{words.listed} lists {len(folders)} captures; --entry {words.entry} is none of them.")
    names = [folder.resolve().name if folder.name in ("", "..") else folder.name for folder in folders]
    name, same = names[words.entry - 1], [other.casefold() for other in names]  # on Windows and macOS a is A
    alone = same.count(name.casefold()) == 1
    return folders[words.entry - 1], words.out / (name if alone else f"{words.entry:03d}_{name}")


def listed(path: Path) -> list[Path]:
    """The folders in a list of captures: one a line, relative to the list; lines that begin with # are comments."""
    try:
        lines = path.read_text(encoding=WRITTEN_BY_HAND).splitlines()
    except (OSError, UnicodeDecodeError) as problem:
        raise SettingsError(f"{path} cannot be read ({problem}); it should list a folder a line.") from problem
    found = [path.parent / line.strip() for line in lines if line.strip() and not line.startswith("#")]
    if not found:
        raise SettingsError(f"{path} lists no captures; write a folder on each line.")
    return found


def holdout(text: str | None) -> str | int | None:
    """A number, or a file's absolute path, since a run is opened again from anywhere."""
    if text is None:
        return None
    if text.isdecimal() and len(text) <= WHOLE_DIGITS:
        return int(text)
    path = Path(text)
    if text.isdecimal() or not path.is_file():
        raise SettingsError(f"--holdout {text:.80} is neither a number nor a file such as split.json.")
    return str(path.resolve())


def change(text: str) -> tuple[str, Any]:
    """"name=value" as a pair, the value read as TOML reads it, bare words as text."""
    import tomllib

    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise SettingsError(f"--set {text} is not of the form name=value.")
    try:
        return name.strip(), tomllib.loads(f"value = {value}")["value"]
    except (ValueError, RecursionError):  # no TOML, or a number that is too long to be one
        return name.strip(), value.strip()


COMMAND = Command(
    "fit", "Separates a capture into scene and flare.",
    """Fits 3D Gaussians to the scene and a flare model to each light, and writes the folder RUN: config.toml,
flare.flare, scene.ply, preview.png, metrics.jsonl. A fit that was stopped goes on with --resume.

  run.py fit sample_scenes/desk --out build/desk --preset draft
  run.py fit my_capture --out my_run --size 960 --holdout 0 --resume""",
    arguments, (Step("fit", "engine", run),), after_a_stop="goes on with --resume")
