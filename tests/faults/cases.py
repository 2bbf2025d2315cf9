# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands under attack, on a toy capture, and what their results have to be like."""
from __future__ import annotations

import hashlib
import json
import shutil
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


INPUTS = {
    "capture": "capture",  # with a flare, clean frames and lights
    "lit": "lit",  # a capture with lamps in its frames, and no lights.json
    "run": "run",  # a fit of `capture`
    "layers": "layers",  # a bake of `run`
    "weights": "weights.safetensors",  # of a tiny network
    "shot": "shot",  # frames to solve
    "clip": "clip.mkv",  # a video of a few frames
    "backgrounds": "backgrounds",  # pictures without flare
    "pairs": "pairs"}  # pictures with flare and without
"""File of each input in the folder of inputs."""


class Case(NamedTuple):
    """A command. reads: names of its inputs, each after those that it is made from. words: its arguments, with {names}
    of inputs and of {out}, the folder that takes all it writes. copies: an input that lies in that folder before.
    varies: files that a repeated run may change or add, by docs/reproducibility.md."""

    name: str
    reads: tuple[str, ...]
    words: str
    copies: str = ""
    varies: frozenset[str] = frozenset()

    def argv(self, inputs: Path, out: Path) -> list[str]:
        """Return the arguments for a folder."""
        places = {name: inputs / file for name, file in INPUTS.items()}
        return [word.format(out=out, **places) for word in self.words.split()]

    def prepare(self, inputs: Path, out: Path) -> None:
        """Fill the folder."""
        if self.copies:
            shutil.copytree(inputs / INPUTS[self.copies], out / self.copies)


FIT = ("--resume --iterations 4 --preset draft --holdout 3 --set flare.count=24 --set checkpoint_every_s=1")
"""A tiny fit that saves its state at every iteration."""
FITTED = ("capture", "run")
CASES = (
    Case("export", FITTED, "export {run} --as preset --out {out}/lamp.json"),
    Case("export ply", FITTED, "export {run} --as ply --out {out}/ply --frames 1-3"),
    Case("bake", FITTED, "bake {run} --out {out}/layers --frames 1-3"),
    Case("remove", ("capture", "weights"), "remove {capture}/images --out {out}/clean --flare {out}/flares --weights "
         "{weights} --frames 1-2 --stills --working-size 256"),
    Case("remove --run", FITTED, "remove --run {run} --out {out}/clean --frames 1-3"),
    Case("remove a video", ("clip", "weights"), "remove {clip} --out {out}/clean.mov --weights {weights} --stills "
         "--working-size 256"),
    Case("transfer", FITTED, "transfer {run}/flare.flare --to {capture} --out {out}/layers --frames 1-3"),
    Case("eval", FITTED, "eval {out}/run", copies="run"),
    Case("eval-removal", ("pairs", "weights"), "eval-removal {pairs} --out {out}/eval --weights {weights} "
         "--working-size 256"),
    Case("lights", ("lit",), "lights {out}/lit", copies="lit"),
    Case("make-flare", (), "make-flare US4099850 --out {out}/made.flare --set tracing.width=48 --set "
         "tracing.positions=4 --set tracing.bands=1 --set ghosts.count=3 --set fit.iterations=10 --set "
         "fit.gaussians=60"),
    Case("fit", ("capture",), "fit {capture} --out {out}/run " + FIT),
    Case("train-removal", ("backgrounds",), "train-removal --backgrounds {backgrounds} --out {out}/trained --set "
         "widths=[8,8,8,8,8] --set size_stages=[[1.0,64,64]] --set pixels_per_iteration=1 --set bank_size=2 --set "
         "canvas_size=64 --iterations 2 --processes 1 --threads 1 --resume"),
    Case("solve", ("shot",), "solve {shot} --out {out}/capture --work-size 320 --no-mask",
         varies=frozenset({"capture/solve.png", *(f"capture/images/{number:03d}.png" for number in range(8)),
                           *(f"capture/sparse/0/{name}.bin" for name in ("cameras", "images", "points3D"))})),
    Case("compose", (*FITTED, "layers"), "compose {layers} --out {out}/frames --frames 1-2",
         varies=frozenset({"frames/compositor.blend1"})))
"""The commands, the quick ones first."""


def fit_argv(capture: Path, run: Path) -> list[str]:
    """Return the arguments of a tiny fit."""
    return ["fit", str(capture), "--out", str(run), *FIT.split()]


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
    """Return why a file is incomplete or invalid by its format, or "". The last line of a log may be cut off."""
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
