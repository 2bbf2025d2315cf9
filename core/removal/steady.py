# SPDX-License-Identifier: GPL-3.0-or-later
"""Steadiness: what is told of a frame of a sequence, brought into line with what is told of the frames about it.

A network that sees each frame by itself tells a little more now and a little less then, and the clean plates
breathe. A flare moves; but blurred a little, a place that looks the same in two frames has the same flare in
both. So what is told of a place is moved by what its blur differs from the mean over the frames about it, each
weighted by how alike their blurs look there: a joint bilateral filter (Petschnigg et al. 2004, "Digital
Photography with Flash and No-Flash Image Pairs") over time. Where a light comes out from behind something, nothing is
alike, and that place is left as it was told. Places of one colour are alike anywhere, a black sky in two photographs
say: so frames count for each other only as far as their details lie alike, which ends at a cut, and a folder of single
photographs is no sequence.
"""
from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..pictures import Pixels
from .inference import Remover, Told
from .plates import Plate, is_of_the_plate, read_plate

REACH = 4
"""Frames to either side that count."""
BLUR = 0.01
"""Of the long side of what the network sees, the blur's standard deviation."""
ALIKE = 0.06
"""Display value by which places differ that count for e**-1 of one that is the same."""
COARSE, STEP = 0.08, 4
"""Of the long side, the deviation of the blur that detail is finer than; pixels from one that is looked at to the
next."""
ANOTHER_SHOT, SAME_SHOT = 0.2, 0.4
"""Correlation of two frames' detail up to which they do not count for each other, and from which on they do: of 120
pairs of unrelated photographs it is 0.22 at most, of frames that follow each other 0.3 at least."""
NO_DETAIL = 1e-6
"""Mean square of detail that is none: that of a quarter of an 8 bit code."""


class Calm(NamedTuple):
    """What was told of a frame, the same blurred, and what the blurred frame has of detail."""

    told: Told
    display: Pixels
    added: Pixels
    detail: Pixels


def calm(told: Told) -> Calm:
    """With the blurs of it."""
    import cv2

    long_side = max(told.display.shape[:2])
    display, added = (np.asarray(cv2.GaussianBlur(part, (0, 0), BLUR * long_side), np.float32) for part in told)
    few = np.ascontiguousarray(display[::STEP, ::STEP])
    detail: Pixels = few - np.asarray(cv2.GaussianBlur(few, (0, 0), COARSE * long_side / STEP), np.float32)
    return Calm(told, display, added, detail)


def steadied(here: Calm, about: Iterable[Calm]) -> Told:
    """What was told of `here`, in line with the frames about it; those of another shape or shot are passed over."""
    total, weights = here.added, np.ones((*here.added.shape[:2], 1), np.float32)
    for other in about:
        share = _of_one_shot(here, other)
        if share > 0:
            apart = np.square(other.display - here.display).mean(-1, keepdims=True)
            weight = share * np.exp(-apart / np.float32(ALIKE**2))
            total, weights = total + weight * other.added, weights + weight
    # In this order, so that without neighbours it is what was told to the last bit.
    return Told(here.told.display, np.maximum(here.told.added + (total / weights - here.added), 0))


def _of_one_shot(one: Calm, other: Calm) -> np.float32:
    """How far two frames count for each other, 0..1."""
    if one.added.shape != other.added.shape:
        return np.float32(0)
    a, b = one.detail, other.detail
    alike = ((a * b).mean() + NO_DETAIL) / (np.sqrt(np.square(a).mean() * np.square(b).mean()) + NO_DETAIL)
    return np.float32(np.clip((alike - ANOTHER_SHOT) / (SAME_SHOT - ANOTHER_SHOT), 0, 1))


class Sequences:
    """Plates of which each is seen beside its neighbours: those of its folder, in the order of the numbers in their
    names. What is told of a plate does not depend on which of the others are cleaned, or in what order."""

    def __init__(self, remover: Remover, paths: Iterable[Path]) -> None:
        self._remover = remover
        self._beside: dict[Path, Sequence[Path]] = {}
        folders: dict[Path, list[Path]] = {}
        for path in paths:
            folders.setdefault(path.parent, []).append(path)
        for those in folders.values():
            those.sort(key=by_number)
            for at, path in enumerate(those):
                self._beside[path] = those[max(at - REACH, 0):at] + those[at + 1:at + 1 + REACH]
        self._kept: OrderedDict[Path, Calm | None] = OrderedDict()

    def beside(self, path: Path) -> Sequence[Path]:
        """The neighbours that count for a plate, in their order."""
        return self._beside.get(path, ())

    def read(self, path: Path) -> tuple[Plate, Told]:
        """The plate, and what is told of it.

        Its neighbours are read before it, so that one plate is in memory at a time; each is told of once. Those that
        cannot be read are passed over. Raises FrameError where the plate itself cannot.
        """
        about = [self._of(other) for other in self.beside(path)]
        plate = read_plate(path)
        here = self._kept.get(path) or self._keep(path, calm(self._remover.tell(plate)))
        return plate, steadied(here, [other for other in about if other is not None])

    def _of(self, path: Path) -> Calm | None:
        if path in self._kept:
            return self._kept[path]
        try:
            return self._keep(path, calm(self._remover.tell(read_plate(path))))
        except Exception as problem:
            if not is_of_the_plate(problem):
                raise
            self._kept[path] = None
            return None

    def _keep(self, path: Path, found: Calm) -> Calm:
        self._kept[path] = found
        while len(self._kept) > 2 * REACH + 1:
            self._kept.popitem(last=False)
        return found


def by_number(path: Path) -> list[tuple[int, str]]:
    """A key that sorts paths by the numbers in their names: a2 before a10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def shot_order(path: Path) -> tuple[Path, list[tuple[int, str]]]:
    """For sorting plates of any folders: in this order `Sequences` has the neighbours of each at hand."""
    return path.parent, by_number(path)
