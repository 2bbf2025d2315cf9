# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands under attack, on a toy capture, and what their results have to be like."""
from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from core.images.read import read_picture
from core.look.container import read_tensors
from core.ply import read_header
from core.system.reading import parse_json, parse_toml

Snapshot = dict[str, str]
"""Hash of each file by its path below a folder."""


class Case(NamedTuple):
    """A command. argv: its arguments for a folder that takes all it writes. prepare: fills that folder before.
    weight: its part of the attempts."""

    name: str
    argv: Callable[[Path], list[str]]
    prepare: Callable[[Path], None] = lambda _: None
    weight: int = 1


class Inputs(NamedTuple):
    """What the commands read."""

    capture: Path
    run: Path
    layers: Path
    weights: Path
    shot: Path


def fit_argv(capture: Path, run: Path) -> list[str]:
    """Return the arguments of a tiny fit that saves its state at every iteration."""
    return ["fit", str(capture), "--out", str(run), "--resume", "--iterations", "4", "--preset", "draft", "--holdout",
            "3", *(word for change in ("flare.count=24", "checkpoint_every_s=1") for word in ("--set", change))]


def cases(inputs: Inputs) -> list[Case]:
    """Return the commands, the quick ones first."""
    capture, run, layers, weights, shot = map(str, inputs)
    flare = str(inputs.run / "flare.flare")
    plates = str(inputs.capture / "images")

    def copy_run(folder: Path) -> None:
        shutil.copytree(run, folder / "run")

    return [
        Case("export", lambda out: ["export", run, "--as", "preset", "--out", f"{out}/lamp.json"], weight=4),
        Case("export ply", lambda out: ["export", run, "--as", "ply", "--out", f"{out}/ply", "--frames", "1-3"],
             weight=4),
        Case("bake", lambda out: ["bake", run, "--out", f"{out}/layers", "--frames", "1-3"], weight=3),
        Case("remove", lambda out: ["remove", plates, "--out", f"{out}/clean", "--flare", f"{out}/flares", "--weights",
                                    weights, "--frames", "1-2", "--stills", "--working-size", "256"], weight=2),
        Case("remove --run", lambda out: ["remove", "--run", run, "--out", f"{out}/clean", "--frames", "1-3"],
             weight=2),
        Case("transfer", lambda out: ["transfer", flare, "--to", capture, "--out", f"{out}/layers", "--frames", "1-3"],
             weight=2),
        Case("eval", lambda out: ["eval", f"{out}/run"], copy_run, weight=2),
        Case("fit", lambda out: fit_argv(inputs.capture, out / "run")),
        Case("solve", lambda out: ["solve", shot, "--out", f"{out}/capture", "--work-size", "320", "--no-mask"]),
        Case("compose", lambda out: ["compose", layers, "--out", f"{out}/frames", "--frames", "1-2"]),
    ]


def snapshot(folder: Path) -> Snapshot:
    """Hash the files below a folder; hidden ones, which are no results, are left out."""
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(folder.rglob("*")) if path.is_file() and not is_hidden(path.relative_to(folder))}


def leftovers(folder: Path) -> list[str]:
    """Return the hidden files below a folder, except those of a solve, which keeps its work."""
    return [str(path.relative_to(folder)) for path in folder.rglob("*")
            if path.is_file() and is_hidden(path.relative_to(folder))]


def is_hidden(path: Path) -> bool:
    """True if a part of a relative path begins with a dot."""
    return any(part.startswith(".") for part in path.parts)


def why_not_whole(path: Path) -> str:
    """Return why a file is not whole by its format, or "". Logs, which are appended to, may end in half a line."""
    try:
        match path.suffix:
            case ".json":
                parse_json(path.read_bytes())
            case ".toml":
                parse_toml(path.read_text())
            case ".jsonl":
                for line in path.read_text().splitlines()[:-1]:
                    json.loads(line)
            case ".png" | ".exr":
                read_picture(path)
            case ".flare" | ".safetensors":
                read_tensors(path)
            case ".ply":
                header = read_header(path.read_bytes())
                if header is None or any(element.rows < 0 for element in header.elements):
                    return "no PLY"
    except Exception as problem:  # whatever a reader raises
        return f"{type(problem).__name__}: {problem}"
    return ""
