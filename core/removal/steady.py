# SPDX-License-Identifier: GPL-3.0-or-later
"""Steadiness: what is told of a frame of a sequence, brought into line with what is told of the frames about it.

A network that sees each frame by itself tells a little more now and a little less then, and the clean plates
breathe. A flare moves; but blurred a little, a place that looks the same in two frames has the same flare in
both. So what is told of a place is moved by what its blur differs from the mean over the frames about it, each
weighted by how alike their blurs look there: a joint bilateral filter (Petschnigg et al. 2004, "Digital
Photography with Flash and No-Flash Image Pairs") over time. Where a light comes out from behind something, nothing is
alike, and that place is left as it was told. Places of one colour are alike anywhere, a black sky in two photographs
say: so frames count for each other only as far as their details lie alike, which ends at a cut, and a folder of single
photographs is no sequence. How far the network is believed (`views`) is one for the frames about a place in a shot,
too: where its views agree on most of them, a flare does not go out on the others.
"""
from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..pictures import Pixels
from .inference import Remover, Told
from .plates import Plate, is_of_the_plate, read_plate
from .views import Views, believed, doubt_of

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


class Guide(NamedTuple):
    """By what frames are compared: what the network is shown of one, the same blurred, and what that has of detail."""

    display: Pixels
    blurred: Pixels
    detail: Pixels


class Sighting(NamedTuple):
    """A frame's guide, and what was told of it in its views."""

    guide: Guide
    views: Views


def guide(display: Pixels) -> Guide:
    """Of what the network is shown of a frame."""
    import cv2

    blurred = _blurred(display)
    few = np.ascontiguousarray(blurred[::STEP, ::STEP])
    deviation = COARSE * max(display.shape[:2]) / STEP
    detail: Pixels = few - np.asarray(cv2.GaussianBlur(few, (0, 0), deviation), np.float32)
    return Guide(display, blurred, detail)


def _blurred(values: Pixels) -> Pixels:
    import cv2

    return np.asarray(cv2.GaussianBlur(values, (0, 0), BLUR * max(values.shape[:2])), np.float32)


def steadied(here: Sighting, about: Iterable[Sighting]) -> Told:
    """What was told of `here`, in line with the frames about it; those of another shape or shot are passed over."""
    shot = [(other, share) for other in about if (share := _of_one_shot(here.guide, other.guide)) > 0]
    doubt = doubt_of([(here.views, 1), *((other.views, float(share)) for other, share in shot)])
    added = believed(here.views, doubt)
    blurred = _blurred(added)
    total, weights = blurred, np.ones((*added.shape[:2], 1), np.float32)
    for other, share in shot:
        apart = np.square(other.guide.blurred - here.guide.blurred).mean(-1, keepdims=True)
        weight = share * np.exp(-apart / np.float32(ALIKE**2))
        total, weights = total + weight * _blurred(believed(other.views, doubt)), weights + weight
    # In this order, so that without neighbours it is what was told to the last bit.
    return Told(here.guide.display, np.maximum(added + (total / weights - blurred), 0))


def _of_one_shot(one: Guide, other: Guide) -> np.float32:
    """How far two frames count for each other, 0..1."""
    if one.display.shape != other.display.shape:
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
        self._guides: dict[Path, Guide | None] = {}
        self._sightings: dict[Path, Sighting] = {}

    def beside(self, path: Path) -> Sequence[Path]:
        """The neighbours that count for a plate, in their order."""
        return self._beside.get(path, ())

    def read(self, path: Path) -> tuple[Plate, Told]:
        """The plate, and what is told of it.

        Its neighbours are read before it, so that one plate is in memory at a time. Those that cannot be read are
        passed over, and so are those of another shot, before the network is asked, which takes far longer than reading
        them. Each is told of once. Raises FrameError where the plate itself cannot be read.
        """
        self._forget_all_but([path, *self.beside(path)])
        about = {other: self._guide_of(other) for other in self.beside(path)}
        plate = read_plate(path)
        own = self._guides[path] = self._guides.get(path) or self._guide(plate)
        return plate, steadied(self._sighting(path, own), [self._sighting(other, its) for other, its in about.items()
                                                       if its is not None and _of_one_shot(own, its) > 0])

    def _guide(self, plate: Plate) -> Guide:
        return guide(self._remover.shown(plate))

    def _guide_of(self, path: Path) -> Guide | None:
        """None where the plate cannot be read."""
        if path not in self._guides:
            try:
                self._guides[path] = self._guide(read_plate(path))
            except Exception as problem:
                if not is_of_the_plate(problem):
                    raise
                self._guides[path] = None
        return self._guides[path]

    def _sighting(self, path: Path, its: Guide) -> Sighting:
        if path not in self._sightings:
            self._sightings[path] = Sighting(its, self._remover.views(its.display))
        return self._sightings[path]

    def _forget_all_but(self, paths: Sequence[Path]) -> None:
        self._guides = {path: self._guides[path] for path in paths if path in self._guides}
        self._sightings = {path: self._sightings[path] for path in paths if path in self._sightings}


def by_number(path: Path) -> list[tuple[int, str]]:
    """A key that sorts paths by the numbers in their names: a2 before a10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def shot_order(path: Path) -> tuple[Path, list[tuple[int, str]]]:
    """For sorting plates of any folders: in this order `Sequences` has the neighbours of each at hand."""
    return path.parent, by_number(path)
