# SPDX-License-Identifier: GPL-3.0-or-later
"""Which plates lie beside a plate in its shot, and what is told of it in the light of those (`steady`).

Neighbours are looked for in a plate's folder, by the numbers in their names, as far as its shot goes: that is followed
from frame to frame as far as their details lie alike. It ends at a cut, and a folder of single photographs is no
sequence.
"""
from __future__ import annotations

import re
from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from ...colour.srgb import Pixels
from ...images.plates import Plate, is_of_the_plate, read_plate
from . import optical_flow
from .remover import Remover, Told
from .temporal import Guide, Neighbour, Sighting, guide, of_one_shot, steadied

OFFSETS = (1, 2, 3, 4, 6, 8, 12, 16)
"""Frames to either side that count: near ones, which a place is surely found in, and far ones, which have the flare
elsewhere where a camera moves slowly."""
REACH = OFFSETS[-1]
"""Frames to either side that the shot is followed to."""


class Sequences:
    """Plates of which each is seen beside its neighbours: those of its folder, in the order of the numbers in their
    names. What is told of a plate does not depend on which of the others are cleaned, or in what order."""

    def __init__(self, remover: Remover, paths: Iterable[Path]) -> None:
        self._remover = remover
        self._before: dict[Path, Sequence[Path]] = {}
        self._after: dict[Path, Sequence[Path]] = {}
        folders: dict[Path, list[Path]] = {}
        for path in paths:
            folders.setdefault(path.parent, []).append(path)
        for those in folders.values():
            those.sort(key=by_number)
            for at, path in enumerate(those):
                self._before[path] = those[max(at - REACH, 0):at]
                self._after[path] = those[at + 1:at + 1 + REACH]
        self._guides: dict[Path, Guide | None] = {}
        self._sightings: dict[Path, Sighting] = {}
        self._flows: dict[tuple[Path, Path], Pixels] = {}

    def beside(self, path: Path) -> Sequence[Path]:
        """The frames that what is told of a plate depends on, in their order."""
        return [*self._before.get(path, ()), *self._after.get(path, ())]

    def read(self, path: Path) -> tuple[Plate, Told]:
        """The plate, and what is told of it.

        Its neighbours are read before it, so that one plate is in memory at a time. Those that cannot be read are
        passed over, and so are those of another shot, before the network is asked, which takes far longer than reading
        them. Each is told of once. Raises FrameError where the plate itself cannot be read.
        """
        before, after = self._before.get(path, ()), self._after.get(path, ())
        self._forget_all_but({path, *before, *after}, before)
        for other in (*before, *after):
            self._guide_of(other)
        plate = read_plate(path)
        own = self._guides[path] = self._guides.get(path) or self._guide(plate)
        here = self._sighting(path, own)
        return plate, steadied(here, [
            Neighbour(self._sighting(other, its), share, self._flow(path, other), self._flow(other, path))
            for side in (before[::-1], after) for other, its, share in self._of_its_shot(own, side)])

    def _of_its_shot(self, own: Guide, side: Sequence[Path]) -> Iterator[tuple[Path, Guide, np.float32]]:
        """(frame, its guide, how far it counts) of those at OFFSETS from a frame, to one side of it, the nearest first.
        A camera that moves soon sees other things; so the shot is followed from each of its frames to the next, past
        a flash or what else differs from it."""
        share, last = np.float32(1), own
        for offset, path in enumerate(side, 1):
            its = self._guides[path]
            if its is not None and (alike := of_one_shot(last, its)) > 0:
                share, last = min(share, alike), its
                if offset in OFFSETS:
                    yield path, its, share

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

    def _flow(self, path: Path, other: Path) -> Pixels:
        """Of two frames that have been told of."""
        if (path, other) not in self._flows:
            here, there = self._sightings[path].guide, self._sightings[other].guide
            self._flows[path, other] = optical_flow.flow(here.grey, there.grey)
        return self._flows[path, other]

    def _forget_all_but(self, paths: Container[Path], before: Container[Path]) -> None:
        """Flows between two frames of those `before` go too: both have been looked at, where plates are read in order.
        """
        self._guides = {path: its for path, its in self._guides.items() if path in paths}
        self._sightings = {path: its for path, its in self._sightings.items() if path in paths}
        self._flows = {(one, other): its for (one, other), its in self._flows.items()
                       if one in paths and other in paths and not (one in before and other in before)}


def by_number(path: Path) -> list[tuple[int, str]]:
    """A key that sorts paths by the numbers in their names: a2 before a10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def shot_order(path: Path) -> tuple[Path, list[tuple[int, str]]]:
    """For sorting plates of any folders: in this order `Sequences` has the neighbours of each at hand."""
    return path.parent, by_number(path)
