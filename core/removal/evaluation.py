# SPDX-License-Identifier: GPL-3.0-or-later
"""Scores flare removal: clean pictures against flare-free ones, and beside them the untouched input. `eval-removal`
calls it.

Paired folders are read in their common layout: input/ and gt/ (also target/, clean/ or scene/ for the latter, flare/ or
blend/ for the former), pictures matched by name, or by the number in it: Flare7K++'s real and synthetic test sets have
input_000001.png and gt_000001.png. mask/ is optional. The first name that exists counts: beside input/, a folder flare/
holds what was removed. A folder of such folders is a set of categories.
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
from ..images.contact_sheet import add_label, side_by_side
from ..images.listing import pictures_in
from ..images.picture import same_aspect
from ..images.read import read_picture
from ..metrics.evaluation import format_cell
from ..metrics.pictures import Perceptual, flip, psnr, ssim
from ..optics.prescription import Prescription, built_in_lenses
from ..system.progress import Progress
from .training.backgrounds import Backgrounds, is_held_out

INPUT_FOLDERS = ("input", "flare", "blend")
TRUTH_FOLDERS = ("gt", "target", "clean", "scene")
SHEET_ROWS = 10
"""Number of pictures on the sheet of the worst results."""
MAX_TILE_ASPECT = 2
"""Height of a tile of the sheet divided by its width, at most; taller pictures, such as a column of pixels, are
squeezed."""
CANVAS_SIZE = 640
"""Side of the canvas of synthesised flares, pixels."""
WORSE_BY_DB = 0.5
"""Loss of PSNR from which on a picture counts as made worse."""
IDENTICAL_PSNR = 100.0
"""PSNR in dB of identical pictures in gains and means, in place of infinity."""
Scores = dict[str, float | None]


@dataclass(frozen=True)
class Case:
    """A picture with flare and without: display values 0..1 (height, width, 3), then a mask if there is one; read on
    demand."""

    name: str
    category: str
    read: Callable[[], tuple[Pixels, Pixels, Pixels | None]]


def read_cases(folder: Path | str) -> list[Case]:
    """Return the cases of a folder, which has the layout that the top of this module describes. Raises SettingsError
    where it holds none, or a picture has no counterpart."""
    folder = Path(folder)
    cases: list[Case] = []
    if not folder.is_dir():
        raise SettingsError(f"{folder} is {'no folder' if folder.exists() else 'missing'}; give a folder with input/ "
                            "and gt/, or a folder of such folders.")
    for input_folder in sorted(path for path in folder.rglob("*") if path.is_dir()):
        root = input_folder.parent
        if input_folder.name.lower() not in INPUT_FOLDERS or input_folder != _find_folder(root, INPUT_FOLDERS):
            continue
        truth_folder = _find_folder(root, TRUTH_FOLDERS)
        if truth_folder is None:
            continue
        mask_folder = _find_folder(root, ("mask",))
        category = root.relative_to(folder).as_posix() if root != folder else root.name
        truths, masks = _index_by_key(truth_folder), _index_by_key(mask_folder) if mask_folder else {}
        for key, path in _index_by_key(input_folder).items():
            if key not in truths:
                raise SettingsError(f"{path} has no counterpart in {truth_folder}; add it, or remove the picture.")
            cases.append(Case(path.stem, category, _case_reader(path, truths[key], masks.get(key))))
    if not cases:
        raise SettingsError(f"{folder} holds no pairs; give a folder with input/ and gt/, or a folder of such folders.")
    return cases


def _find_folder(root: Path, names: Sequence[str]) -> Path | None:
    """Return the folder in `root` with the first of these names that exists, in upper or lower case."""
    folders = {path.name.lower(): path for path in sorted(root.iterdir()) if path.is_dir()}
    return next((folders[name] for name in names if name in folders), None)


def _index_by_key(folder: Path) -> dict[str, Path]:
    """Return a folder's pictures by the stem of their names without a prefix such as "gt_", or by the whole stem if two
    pictures would get one key. Raises SettingsError where one stem has two suffixes."""
    paths = pictures_in(folder)
    duplicates = [stem for stem, count in Counter(path.stem for path in paths).items() if count > 1]
    if duplicates:
        raise SettingsError(f"{folder} has {duplicates[0]} under two suffixes; remove one of them.")
    plain = {re.sub(r"^(input|gt|target|clean|scene|flare|blend|mask)_?", "", path.stem): path for path in paths}
    return plain if len(plain) == len(paths) else {path.stem: path for path in paths}


def _case_reader(path: Path, truth: Path, mask: Path | None) -> Callable[[], tuple[Pixels, Pixels, Pixels | None]]:
    """Return a function that reads frame, truth and mask of a case; it raises FrameError where their sizes differ."""
    def read() -> tuple[Pixels, Pixels, Pixels | None]:
        """Read (frame, truth, mask) as display values."""
        frame, clean = read_picture(path), read_picture(truth)
        if frame.size != clean.size:
            raise FrameError(f"{path} is {frame.size[0]} x {frame.size[1]} pixels and {truth} {clean.size[0]} x "
                             f"{clean.size[1]}; make them the same size.")
        mask_picture = read_picture(mask) if mask else None
        if mask_picture and not same_aspect(mask_picture.size, frame.size):
            raise FrameError(f"{mask} is {mask_picture.size[0]} x {mask_picture.size[1]} pixels, another shape than "
                             f"{path} of {frame.size[0]} x {frame.size[1]}; make it for that picture, or remove it.")
        values = mask_picture.resized(*frame.size).display() if mask_picture else None
        return frame.display(), clean.display(), values

    return read


def evaluate(cases: Sequence[Case], clean: Callable[[Pixels], Pixels], progress: Progress | None = None, *,
             lpips: Perceptual | None = None) -> dict[str, Any]:
    """Return the scores of every case, and their means by category and over all; JSON-able.

    clean: removes the flare from display values (height, width, 3). lpips: the metric; None leaves its score null.

    Keys of the result: gain_db is PSNR minus that of the untouched input; the PSNR of identical pictures counts as
    IDENTICAL_PSNR, in means too. made_worse is the share of pictures with a gain below -WORSE_BY_DB. failed holds
    messages about pairs that cannot be read, which are left out. masked_psnr is over the pixels of the mask. Raises
    FrameError where no pair can be read.
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
                               "result": _score_picture(result, truth, mask, lpips),
                               "input": _score_picture(frame, truth, mask, lpips)}
        row["gain_db"] = round(_psnr_or_identical(row["result"]) - _psnr_or_identical(row["input"]), 4)
        rows.append(row)
        progress.advance()
    if not rows:
        raise FrameError(f"None of {len(cases)} pairs could be read: {failed[0]}")
    categories = sorted({row["category"] for row in rows})
    by_category = {name: _summarise([row for row in rows if row["category"] == name]) for name in categories}
    return {"failed": failed, "mean": _summarise(rows), "categories": by_category, "pictures": rows}


def _score_picture(picture: Pixels, truth: Pixels, mask: Pixels | None,
                   lpips: Perceptual | None) -> Scores:
    """Return the scores of a picture against the truth; None for a score that is infinite or cannot be computed.

    mask: display values (height, width, 3); masked_psnr is the PSNR over the pixels with a channel above 0.5. Without
    a mask the scores have no masked_psnr.
    """
    small = min(picture.shape[:2]) < 11  # SSIM's window does not fit
    scores: Scores = {"psnr": psnr(picture, truth), "ssim": None if small else ssim(picture, truth),
                      "lpips": lpips(picture, truth) if lpips else None, "flip": flip(picture, truth)}
    if mask is not None:
        scores["masked_psnr"] = psnr(picture, truth, mask.max(-1) > 0.5)
    return {name: round(value, 5) if value is not None and math.isfinite(value) else None
            for name, value in scores.items()}


def _summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return means over the cases, and the share of cases that became worse by more than WORSE_BY_DB.

    rows: one dictionary per case, as `evaluate` makes them.
    """
    gains = [row["gain_db"] for row in rows]
    summary: dict[str, Any] = {"count": len(rows), "gain_db": _mean(gains),
                               "made_worse": round(sum(gain < -WORSE_BY_DB for gain in gains) / max(len(gains), 1), 4)}
    for picture in ("result", "input"):
        metrics = sorted({name for row in rows for name in row[picture]} - {"psnr"})
        summary[picture] = {"psnr": _mean([_psnr_or_identical(row[picture]) for row in rows]),
                            **{name: _mean([row[picture].get(name) for row in rows]) for name in metrics}}
    return summary


def _psnr_or_identical(scores: Scores) -> float:
    """Return PSNR in dB; IDENTICAL_PSNR for identical pictures, whose score is None."""
    return IDENTICAL_PSNR if scores["psnr"] is None else scores["psnr"]


def _mean(values: Iterable[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return round(sum(numbers) / len(numbers), 4) if numbers else None


def format_table(scores: dict[str, Any]) -> str:
    """Return the means as text, a line for each category: scores of the result, and in brackets those of the untouched
    input. scores: what `evaluate` returned."""
    lines = [f"{'category':24}{'n':>5}{'PSNR':>16}{'gain':>7}{'SSIM':>18}{'LPIPS':>8}{'FLIP':>8}{'worse':>7}"]
    for name, means in [*scores["categories"].items(), ("all", scores["mean"])]:
        after, before = means["result"], means["input"]
        psnr_cell = f"{format_cell(after['psnr'], 2)} ({format_cell(before['psnr'], 2)})"
        ssim_cell = f"{format_cell(after['ssim'], 4)} ({format_cell(before['ssim'], 4)})"
        lines.append(f"{name:24.24}{means['count']:>5}{psnr_cell:>16}{format_cell(means['gain_db'], 2):>7}"
                     f"{ssim_cell:>18}{format_cell(after['lpips'], 4):>8}{format_cell(after['flip'], 4):>8}"
                     f"{means['made_worse']:>7.1%}")
    return "\n".join(lines)


def draw_worst_sheet(cases: Sequence[Case], clean: Callable[[Pixels], Pixels], scores: dict[str, Any],
                     width: int = 400) -> Pixels:
    """Return a sheet (rows, 4 * width, 3) of the pictures with the lowest gain, worst first: input | result | truth |
    removed flare times 2, display values.

    clean: removes the flare from display values. scores: what `evaluate` returned. width: of one tile, pixels.
    """
    import cv2

    by_name = {(case.category, case.name): case for case in cases}
    strips = []
    for row in sorted(scores["pictures"], key=lambda row: row["gain_db"])[:SHEET_ROWS]:
        case, gain = by_name[row["category"], row["name"]], row["gain_db"]
        frame, truth, _ = case.read()
        result = clean(frame)
        removed = np.clip((frame - result) * 2, 0, 1)
        height = int(np.clip(round(width * frame.shape[0] / frame.shape[1]), 1, MAX_TILE_ASPECT * width))
        parts = [np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), np.float32)
                 for part in (frame, result, truth, removed)]
        text = f"{case.category} / {case.name}: {gain:+.2f} dB   input | result | truth | taken away x2"
        strips.append(add_label(text, side_by_side(parts)))
    return np.concatenate(strips) if strips else np.zeros((20, 4 * width, 3), np.float32)


def held_out_lenses(lenses: Iterable[Prescription]) -> list[Prescription]:
    """Return the lenses that are kept out of training by name, or the built-in ones if none is."""
    return [lens for lens in lenses if is_held_out(lens.name)] or built_in_lenses()


def synthetic_cases(seed: int, count: int, backgrounds: Backgrounds, lenses: Sequence[Prescription],
                    size: tuple[int, int]) -> list[Case]:
    """Return `count` cases of every flare class, a function of the seed: a test set that needs no data but clean
    pictures. Frames are rounded to 8 bit codes. size: (width, height) of a frame."""
    from .synthesis.flare import FLARE_CLASSES
    from .training.flare_bank import SingleFlareBank
    from .training.pairs import make_pair

    def reader(class_index: int, number: int) -> Callable[[], tuple[Pixels, Pixels, None]]:
        def read() -> tuple[Pixels, Pixels, None]:
            random = np.random.default_rng((seed, class_index, number))
            bank = SingleFlareBank((seed, class_index, number), CANVAS_SIZE, lenses, FLARE_CLASSES[class_index])
            pair = make_pair(random, bank, backgrounds, *size, clean_share=0)
            return np.round(pair.frame * 255).astype(np.float32) / 255, pair.scene, None

        return read

    return [Case(f"{number:04d}", flare_class, reader(class_index, number))
            for class_index, flare_class in enumerate(FLARE_CLASSES) for number in range(count)]

