# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands under attack, on a toy capture, and what their results have to be like."""
from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import av

from core.capture.colmap import read_model
from core.images.read import read_picture
from core.look.container import read_tensors
from core.ply import read_header
from core.system.reading import parse_json, parse_toml

Snapshot = dict[str, str]
"""Hash of each file by its path below a folder."""


class Case(NamedTuple):
    """A command. argv: its arguments for a folder that takes all it writes. prepare: fills that folder before.
    resumed: files that an interruption may change, by docs/reproducibility.md."""

    name: str
    argv: Callable[[Path], list[str]]
    prepare: Callable[[Path], None] = lambda _: None
    resumed: frozenset[str] = frozenset()


class Inputs(NamedTuple):
    """Folder of what the commands read, and its parts."""

    folder: Path

    @property
    def capture(self) -> Path:
        """Capture with a flare, clean frames and lights."""
        return self.folder / "capture"

    @property
    def lit(self) -> Path:
        """Capture with lamps in its frames, and no lights.json."""
        return self.folder / "lit"

    @property
    def run(self) -> Path:
        """Fit of `capture`."""
        return self.folder / "run"

    @property
    def layers(self) -> Path:
        """Bake of `run`."""
        return self.folder / "layers"

    @property
    def weights(self) -> Path:
        """Weights of a tiny network."""
        return self.folder / "weights.safetensors"

    @property
    def shot(self) -> Path:
        """Frames to solve."""
        return self.folder / "shot"

    @property
    def clip(self) -> Path:
        """Video of a few frames."""
        return self.folder / "clip.mkv"

    @property
    def backgrounds(self) -> Path:
        """Pictures without flare."""
        return self.folder / "backgrounds"

    @property
    def pairs(self) -> Path:
        """Pictures with flare and without, for eval-removal."""
        return self.folder / "pairs"


def fit_argv(capture: Path, run: Path) -> list[str]:
    """Return the arguments of a tiny fit that saves its state at every iteration."""
    return ["fit", str(capture), "--out", str(run), "--resume", "--iterations", "4", "--preset", "draft", "--holdout",
            "3", *changes("flare.count=24", "checkpoint_every_s=1")]


def changes(*settings: str) -> list[str]:
    """Return `--set` for each setting."""
    return [word for setting in settings for word in ("--set", setting)]


def cases(inputs: Inputs) -> list[Case]:
    """Return the commands, the quick ones first."""
    run, weights = str(inputs.run), str(inputs.weights)

    def copy(source: Path, name: str) -> Callable[[Path], None]:
        return lambda folder: shutil.copytree(source, folder / name) and None

    trained = [*changes("widths=[8,8,8,8,8]", "size_stages=[[1.0,64,64]]", "pixels_per_iteration=1", "bank_size=2",
                        "canvas_size=64"), "--iterations", "2", "--processes", "1", "--threads", "1", "--resume"]
    traced = changes("tracing.width=48", "tracing.positions=4", "tracing.bands=1", "ghosts.count=3",
                     "fit.iterations=10", "fit.gaussians=60")
    return [
        Case("export", lambda out: ["export", run, "--as", "preset", "--out", f"{out}/lamp.json"]),
        Case("export ply", lambda out: ["export", run, "--as", "ply", "--out", f"{out}/ply", "--frames", "1-3"]),
        Case("bake", lambda out: ["bake", run, "--out", f"{out}/layers", "--frames", "1-3"]),
        Case("remove", lambda out: ["remove", str(inputs.capture / "images"), "--out", f"{out}/clean", "--flare",
                                    f"{out}/flares", "--weights", weights, "--frames", "1-2", "--stills",
                                    "--working-size", "256"]),
        Case("remove --run", lambda out: ["remove", "--run", run, "--out", f"{out}/clean", "--frames", "1-3"]),
        Case("remove a video", lambda out: ["remove", str(inputs.clip), "--out", f"{out}/clean.mov", "--weights",
                                            weights, "--stills", "--working-size", "256"]),
        Case("transfer", lambda out: ["transfer", f"{run}/flare.flare", "--to", str(inputs.capture), "--out",
                                      f"{out}/layers", "--frames", "1-3"]),
        Case("eval", lambda out: ["eval", f"{out}/run"], copy(inputs.run, "run")),
        Case("eval-removal", lambda out: ["eval-removal", str(inputs.pairs), "--out", f"{out}/eval", "--weights",
                                          weights, "--working-size", "256"]),
        Case("lights", lambda out: ["lights", f"{out}/capture"], copy(inputs.lit, "capture")),
        Case("make-flare", lambda out: ["make-flare", "US4099850", "--out", f"{out}/made.flare", *traced]),
        Case("fit", lambda out: fit_argv(inputs.capture, out / "run")),
        Case("train-removal", lambda out: ["train-removal", "--backgrounds", str(inputs.backgrounds), "--out",
                                           f"{out}/trained", *trained],
             resumed=frozenset({"trained/removal.safetensors", "trained/checkpoint.safetensors"})),
        Case("solve", lambda out: ["solve", str(inputs.shot), "--out", f"{out}/capture", "--work-size", "320",
                                   "--no-mask"]),
        Case("compose", lambda out: ["compose", str(inputs.layers), "--out", f"{out}/frames", "--frames", "1-2"]),
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
            case ".mov" | ".mkv":
                with av.open(str(path)) as container:
                    if not sum(1 for _ in container.decode(video=0)):
                        return "no frame"
            case ".blend":
                data = path.read_bytes()
                if data[:7] != b"BLENDER" or b"ENDB" not in data[-64:]:
                    return "no end of a .blend"
            case ".bin" | ".txt" if path.stem in ("cameras", "images", "points3D"):
                read_model(path.parent)
            case ".ply":
                header = read_header(path.read_bytes())
                if header is None or any(element.rows < 0 for element in header.elements):
                    return "no PLY"
    except Exception as problem:  # whatever a reader raises
        return f"{type(problem).__name__}: {problem}"
    return ""
