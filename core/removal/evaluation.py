# SPDX-License-Identifier: GPL-3.0-or-later
"""How good a removal is: scores of cleaned pictures against flare-free ones, beside the untouched input.

Paired folders are read as the field keeps them: input/ and gt/ (also target/, clean/ or scene/ for the
latter, flare/ or blend/ for the former), pictures matched by name, or by the number in it, as Flare7K++'s
real and synthetic test sets have input_000001.png beside gt_000001.png; mask/ if there is one. Of several the
first of these counts: beside input/ a folder flare/ holds what was taken away. A folder of such folders is a set
of categories.
"""
from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..colour.srgb import Pixels
from ..errors import FrameError, SettingsError
from ..images.contact_sheet import labelled, side_by_side
from ..images.listing import pictures_in
from ..images.picture import are_one_shape
from ..images.read import read_picture
from ..metrics.evaluation import cell
from ..metrics.pictures import Perceptual, flip, psnr, ssim
from ..system.progress import Progress
from .synthesis.prescription import Prescription, built_in
from .training.backgrounds import Backgrounds, kept_for_test

INPUTS = ("input", "flare", "blend")
TRUTHS = ("gt", "target", "clean", "scene")
WORST = 10
TALLEST = 2
"""Heights of a picture on the sheet by its width: what is taller, a column of pixels say, is squeezed."""
CANVAS = 640
"""Pixels a side of the canvas of synthesised flares."""
ALIKE = 100.0
"""PSNR in dB that pictures which are the same count for in gains and means: that of an error of 0.00001."""
Scores = dict[str, float | None]


@dataclass(frozen=True)
class Case:
    """A picture with flare and the same without: display values 0..1 (height, width, 3), read when asked for."""

    name: str
    category: str
    read: Callable[[], tuple[Pixels, Pixels, Pixels | None]]


def paired(folder: Path | str) -> list[Case]:
    """The cases of a folder, see the module's head. Raises SettingsError where it holds none, or some without
    their counterpart."""
    folder = Path(folder)
    cases: list[Case] = []
    if not folder.is_dir():
        raise SettingsError(f"{folder} is {'no folder' if folder.exists() else 'missing'}; give a folder with input/ "
                            "and gt/, or a folder of such folders.")
    for inputs in sorted(path for path in folder.rglob("*") if path.is_dir()):
        root = inputs.parent
        if inputs.name.lower() not in INPUTS or inputs != _first_of(root, INPUTS):
            continue
        truth = _first_of(root, TRUTHS)
        if truth is None:
            continue
        marked = _first_of(root, ("mask",))
        category = root.relative_to(folder).as_posix() if root != folder else root.name
        truths, masks = _by_key(truth), _by_key(marked) if marked else {}
        for key, path in _by_key(inputs).items():
            if key not in truths:
                raise SettingsError(f"{path} has no counterpart in {truth}; add it, or remove the picture.")
            cases.append(Case(path.stem, category, _reader(path, truths[key], masks.get(key))))
    if not cases:
        raise SettingsError(f"{folder} holds no pairs; give a folder with input/ and gt/, or a folder of such folders.")
    return cases


def _first_of(root: Path, names: Sequence[str]) -> Path | None:
    """The folder in `root` that has the first of these names, in capitals or not."""
    folders = {path.name.lower(): path for path in sorted(root.iterdir()) if path.is_dir()}
    return next((folders[name] for name in names if name in folders), None)


def _by_key(folder: Path) -> dict[str, Path]:
    paths = pictures_in(folder)
    twice = [stem for stem, count in Counter(path.stem for path in paths).items() if count > 1]
    if twice:
        raise SettingsError(f"{folder} has {twice[0]} under two suffixes; remove one of them.")
    plain = {re.sub(r"^(input|gt|target|clean|scene|flare|blend|mask)_?", "", path.stem): path for path in paths}
    return plain if len(plain) == len(paths) else {path.stem: path for path in paths}


def _reader(path: Path, truth: Path, mask: Path | None) -> Callable[[], tuple[Pixels, Pixels, Pixels | None]]:
    def read() -> tuple[Pixels, Pixels, Pixels | None]:
        frame, clean = read_picture(path), read_picture(truth)
        if frame.size != clean.size:
            raise FrameError(f"{path} is {frame.size[0]} x {frame.size[1]} pixels and {truth} {clean.size[0]} x "
                             f"{clean.size[1]}; make them one size.")
        marked = read_picture(mask) if mask else None
        if marked and not are_one_shape(marked.size, frame.size):
            raise FrameError(f"{mask} is {marked.size[0]} x {marked.size[1]} pixels, another shape than {path} of "
                             f"{frame.size[0]} x {frame.size[1]}; make it for that picture, or remove it.")
        return frame.display(), clean.display(), marked.resized(*frame.size).display() if marked else None

    return read


def evaluate(cases: Sequence[Case], clean: Callable[[Pixels], Pixels], progress: Progress | None = None, *,
             lpips: Perceptual | None = None) -> dict[str, Any]:
    """Scores of every case, means by category and of all; JSON-able.

    clean: display values (height, width, 3) to the same without flare. `gain_db` is the PSNR above the untouched
    input's (where two pictures are the same and have none, `ALIKE` counts, in means too), `made_worse` the share of
    pictures with a gain below -0.5 dB; `failed` what is wrong with pairs that cannot be read, which are left out;
    `masked_psnr` counts the pixels of the mask alone. lpips is null where no weights for it were given, FLIP where its
    package is not installed. Raises FrameError where none can be read.
    """
    progress = progress or Progress()
    progress.stage("eval-removal", len(cases))
    rows: list[dict[str, Any]] = []
    failed: list[str] = []
    for case in cases:
        try:
            frame, truth, mask = case.read()
        except FrameError as problem:
            failed.append(str(problem))
            progress.say(f"Left out: {problem}")
            progress.advance()
            continue
        result = clean(frame)
        row: dict[str, Any] = {"name": case.name, "category": case.category,
                               "result": _scores(result, truth, mask, lpips),
                               "input": _scores(frame, truth, mask, lpips)}
        row["gain_db"] = round(_level(row["result"]) - _level(row["input"]), 4)
        rows.append(row)
        progress.advance()
    if not rows:
        raise FrameError(f"None of {len(cases)} pairs could be read: {failed[0]}")
    categories = sorted({row["category"] for row in rows})
    by_category = {name: _summary([row for row in rows if row["category"] == name]) for name in categories}
    return {"failed": failed, "mean": _summary(rows), "categories": by_category, "pictures": rows}


def _scores(picture: Pixels, truth: Pixels, mask: Pixels | None,
            lpips: Perceptual | None) -> Scores:
    small = min(picture.shape[:2]) < 11
    scores: Scores = {"psnr": psnr(picture, truth), "ssim": None if small else ssim(picture, truth),
                      "lpips": lpips(picture, truth) if lpips else None, "flip": flip(picture, truth)}
    if mask is not None:
        scores["masked_psnr"] = psnr(picture, truth, mask.max(-1) > 0.5)
    return {name: round(value, 5) if value is not None and math.isfinite(value) else None
            for name, value in scores.items()}


def _summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    gains = [row["gain_db"] for row in rows]
    summary: dict[str, Any] = {"count": len(rows), "gain_db": _mean(gains),
                               "made_worse": round(sum(gain < -0.5 for gain in gains) / max(len(gains), 1), 4)}
    for side in ("result", "input"):
        others = sorted({name for row in rows for name in row[side]} - {"psnr"})
        summary[side] = {"psnr": _mean([_level(row[side]) for row in rows]),
                         **{name: _mean([row[side].get(name) for row in rows]) for name in others}}
    return summary


def _level(scores: Scores) -> float:
    """PSNR in dB; `ALIKE` where there is none, of pictures that are the same."""
    return ALIKE if scores["psnr"] is None else scores["psnr"]


def _mean(values: Iterable[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return round(sum(numbers) / len(numbers), 4) if numbers else None


def table(scores: dict[str, Any]) -> str:
    """The means as text: result, input in brackets."""
    lines = [f"{'category':24}{'n':>5}{'PSNR':>16}{'gain':>7}{'SSIM':>18}{'LPIPS':>8}{'FLIP':>8}{'worse':>7}"]
    for name, part in [*scores["categories"].items(), ("all", scores["mean"])]:
        after, before = part["result"], part["input"]
        levels = f"{cell(after['psnr'], 2)} ({cell(before['psnr'], 2)})"
        likeness = f"{cell(after['ssim'], 4)} ({cell(before['ssim'], 4)})"
        lines.append(f"{name:24.24}{part['count']:>5}{levels:>16}{cell(part['gain_db'], 2):>7}{likeness:>18}"
                     f"{cell(after['lpips'], 4):>8}{cell(after['flip'], 4):>8}{part['made_worse']:>7.1%}")
    return "\n".join(lines)


def worst_sheet(cases: Sequence[Case], clean: Callable[[Pixels], Pixels], scores: dict[str, Any],
                width: int = 400) -> Pixels:
    """The pictures with the lowest gain, worst first: input | result | truth | flare taken, display values."""
    import cv2

    by_name = {(case.category, case.name): case for case in cases}
    strips = []
    for row in sorted(scores["pictures"], key=lambda row: row["gain_db"])[:WORST]:
        case, gain = by_name[row["category"], row["name"]], row["gain_db"]
        frame, truth, _ = case.read()
        result = clean(frame)
        taken = np.clip((frame - result) * 2, 0, 1)
        height = int(np.clip(round(width * frame.shape[0] / frame.shape[1]), 1, TALLEST * width))
        parts = [np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), np.float32)
                 for part in (frame, result, truth, taken)]
        text = f"{case.category} / {case.name}: {gain:+.2f} dB   input | result | truth | taken away x2"
        strips.append(labelled(text, side_by_side(parts)))
    return np.concatenate(strips) if strips else np.zeros((20, 4 * width, 3), np.float32)


def held_out(lenses: Iterable[Prescription]) -> list[Prescription]:
    """Those that are kept from training, by name; the built-in ones where none is."""
    return [lens for lens in lenses if kept_for_test(lens.name)] or built_in()


def synthetic(seed: int, count: int, backgrounds: Backgrounds, lenses: Sequence[Prescription],
              size: tuple[int, int]) -> list[Case]:
    """`count` cases of every class of flare, a function of the seed: the test set that needs no data but clean
    pictures. Frames are 8 bit codes."""
    from .synthesis.flare import CLASSES
    from .training.flare_bank import OneFlare
    from .training.pairs import pair

    def reader(index: int, number: int) -> Callable[[], tuple[Pixels, Pixels, None]]:
        def read() -> tuple[Pixels, Pixels, None]:
            random = np.random.default_rng((seed, index, number))
            bank = OneFlare((seed, index, number), CANVAS, lenses, CLASSES[index])
            made = pair(random, bank, backgrounds, *size, clean=0)
            return np.round(made.frame * 255).astype(np.float32) / 255, made.scene, None

        return read

    return [Case(f"{number:04d}", kind, reader(index, number))
            for index, kind in enumerate(CLASSES) for number in range(count)]

