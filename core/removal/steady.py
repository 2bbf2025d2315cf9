# SPDX-License-Identifier: GPL-3.0-or-later
"""Sequences: what is told of a frame is brought into line with the frames about it, which show the same scene.

A flare moves as nothing in the scene does: what it covers in one frame lies bare in another. So every place is followed
to where it is in the frames about it (`motion`), and the scene's colour there is taken to be the median of what their
clean frames have, at one exposure, each weighted by how far the flow can be relied on and by how little had to be taken
away: where hardly any flare is told, the scene was seen. A network that sees each frame by itself tells a little more
now and a little less then; what it missed, or took too much, is put right by those that saw better, and the clean
plates do not breathe. Only what is smooth is put right, since a frame's detail is its own, and by no more than was told
about there: where there is no flare, a lamp that comes on changes nothing. What is not found again stays as it was
told.

Frames count for each other as far as their details lie alike, which ends at a cut, and a folder of single photographs
is no sequence. How far the network is believed (`views`) is one for the frames about a place in a shot, too: where its
views agree on most of them, a flare does not go out on the others.
"""
from __future__ import annotations

import re
from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..pictures import Pixels
from . import motion
from .inference import CLIPPED, Remover, Told
from .plates import Plate, is_of_the_plate, read_plate
from .views import Views, believed, doubt_of

OFFSETS = (1, 2, 3, 4, 6, 8, 12, 16)
"""Frames to either side that count: near ones, which a place is surely found in, and far ones, which have the flare
elsewhere where a camera moves slowly."""
FAINT = 0.03
"""What a flare adds to display values where a frame counts half of what it counts where there is none."""
SMOOTH, WITHIN = 2.5, 4.0
"""Pixels of the flow: standard deviations of what is put right, and of the blur of what was told about there, by which
it is bounded."""
DETAIL = 0.7
"""Pixels of the flow: that finer than which the scene is not compared."""
WITNESSES = 2.0
"""Frames that a place has to be found again in for all of what they say to be put right; with fewer, less."""
BLACK, BARE = 0.05, 0.02
"""Display value from which on frames' exposures are compared, and the part of a frame that has to be without flare for
that."""
BLUR, COARSE, STEP = 0.01, 0.08, 4
"""Of the long side, deviations of the blurs between which what counts as detail lies; pixels from one that is looked at
to the next."""
ANOTHER_SHOT, SAME_SHOT = 0.2, 0.4
"""Correlation of two frames' detail up to which they do not count for each other, and from which on they do: of 120
pairs of unrelated photographs it is 0.22 at most, of frames that follow each other 0.3 at least."""
NO_DETAIL = 1e-6
"""Mean square of detail that is none: that of a quarter of an 8 bit code."""


class Guide(NamedTuple):
    """By what frames are compared: what the network is shown of one, the same as it is followed (`motion.grey`), and
    its detail."""

    display: Pixels
    grey: NDArray[np.uint8]
    detail: Pixels


class Sighting(NamedTuple):
    """A frame's guide, and what was told of it in its views."""

    guide: Guide
    views: Views


class Neighbour(NamedTuple):
    """A frame about another: how far it counts for it (`of_one_shot`), and the flow from that one to it and back."""

    sighting: Sighting
    share: np.float32
    there: Pixels
    back: Pixels


def guide(display: Pixels) -> Guide:
    """Of what the network is shown of a frame."""
    few = np.ascontiguousarray(_blurred(display, BLUR * max(display.shape[:2]))[::STEP, ::STEP])
    return Guide(display, motion.grey(display), few - _blurred(few, COARSE * max(display.shape[:2]) / STEP))


def of_one_shot(one: Guide, other: Guide) -> np.float32:
    """How far two frames count for each other, 0..1; not at all where their shapes differ."""
    if one.display.shape != other.display.shape:
        return np.float32(0)
    a, b = one.detail, other.detail
    alike = ((a * b).mean() + NO_DETAIL) / (np.sqrt(np.square(a).mean() * np.square(b).mean()) + NO_DETAIL)
    return np.float32(np.clip((alike - ANOTHER_SHOT) / (SAME_SHOT - ANOTHER_SHOT), 0, 1))


def steadied(here: Sighting, about: Sequence[Neighbour]) -> Told:
    """What was told of `here`, in line with the frames about it."""
    display = here.guide.display
    doubt = doubt_of([(here.views, 1), *((other.sighting.views, float(other.share)) for other in about)])
    added = np.minimum(believed(here.views, doubt), display)
    if not about:
        return Told(display, added)
    clean, told = _seen(here, doubt)
    seen, weights, most, found = [clean], [_worth(told)], told, np.zeros_like(told)
    for other in about:
        its, its_told = _seen(other.sighting, doubt)
        laid = motion.brought(np.dstack([its, its_told]), other.there)
        its, its_told = laid[..., :3], laid[..., 3]
        sure = other.share * motion.followed(other.there, other.back)
        weights.append(sure * _worth(its_told))
        seen.append(its * _exposed(clean, its, sure * (np.maximum(told, its_told) < FAINT)))
        most, found = np.maximum(most, sure * its_told), found + sure
    sure = np.minimum(found / np.float32(WITNESSES), 1)
    amiss = (_weighted_median(np.stack(seen), np.stack(weights)) - clean) * sure[..., None]
    amiss = _blurred(amiss, SMOOTH) / (_blurred(sure, SMOOTH) + np.float32(0.1))[..., None]
    bound = _blurred(most, WITHIN)[..., None]
    return Told(display, np.clip(added - _finer(np.clip(amiss, -bound, bound), display), 0, display))


def _seen(frame: Sighting, doubt: np.float32) -> tuple[Pixels, Pixels]:
    """Of a frame at the flow's size, without its detail: what is left of it (h, w, 3), and the most that a flare adds
    to a channel (h, w)."""
    added = motion.coarser(believed(frame.views, doubt))
    return _blurred(motion.coarser(frame.guide.display) - added, DETAIL), np.asarray(added.max(-1))


def _exposed(clean: Pixels, its: Pixels, sure: Pixels) -> np.float32:
    """How many times as bright a frame is as another's `its`, laid over it: the median over what both show, neither
    black nor clipped, and so surely; else a camera that changes its exposure, or a fade, would pass for a flare."""
    here, there = clean.mean(-1), its.mean(-1)
    both = np.minimum(here, there) > BLACK
    both &= np.maximum(clean.max(-1), its.max(-1)) < CLIPPED
    sure = sure[both]
    if sure.sum() < BARE * here.size:
        return np.float32(1)
    return np.float32(_weighted_median((here[both] / there[both])[:, None, None, None], sure[:, None, None]).item())


def _worth(told: Pixels) -> Pixels:
    return 1 / (1 + np.square(told / np.float32(FAINT)))


def _weighted_median(values: Pixels, weights: Pixels) -> Pixels:
    """(h, w, c), over the first of values (n, h, w, c), weighted by (n, h, w)."""
    order = np.argsort(values, 0)
    sums = np.cumsum(np.take_along_axis(np.broadcast_to(weights[..., None], values.shape), order, 0), 0)
    middle = (sums >= sums[-1:] / 2).argmax(0)[None]
    return np.take_along_axis(values, np.take_along_axis(order, middle, 0), 0)[0]


def _blurred(values: Pixels, deviation: float) -> Pixels:
    import cv2

    return np.asarray(cv2.GaussianBlur(values, (0, 0), deviation), np.float32)


def _finer(values: Pixels, display: Pixels) -> Pixels:
    """Brought to a frame's size."""
    import cv2

    height, width = display.shape[:2]
    return np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


class Sequences:
    """Plates of which each is seen beside its neighbours: those of its folder, in the order of the numbers in their
    names. What is told of a plate does not depend on which of the others are cleaned, or in what order."""

    def __init__(self, remover: Remover, paths: Iterable[Path]) -> None:
        self._remover = remover
        self._beside: dict[Path, tuple[Sequence[Path], Sequence[Path]]] = {}
        folders: dict[Path, list[Path]] = {}
        for path in paths:
            folders.setdefault(path.parent, []).append(path)
        for those in folders.values():
            those.sort(key=by_number)
            for at, path in enumerate(those):
                self._beside[path] = those[max(at - OFFSETS[-1], 0):at][::-1], those[at + 1:at + 1 + OFFSETS[-1]]
        self._guides: dict[Path, Guide | None] = {}
        self._sightings: dict[Path, Sighting] = {}
        self._flows: dict[tuple[Path, Path], Pixels] = {}

    def beside(self, path: Path) -> Sequence[Path]:
        """The frames that what is told of a plate depends on, in their order."""
        before, after = self._beside.get(path, ((), ()))
        return [*before[::-1], *after]

    def read(self, path: Path) -> tuple[Plate, Told]:
        """The plate, and what is told of it.

        Its neighbours are read before it, so that one plate is in memory at a time. Those that cannot be read are
        passed over, and so are those of another shot, before the network is asked, which takes far longer than reading
        them. Each is told of once. Raises FrameError where the plate itself cannot be read.
        """
        self._forget_all_but({path, *self.beside(path)}, self._beside.get(path, ((), ()))[0])
        for other in self.beside(path):
            self._guide_of(other)
        plate = read_plate(path)
        own = self._guides[path] = self._guides.get(path) or self._guide(plate)
        here = self._sighting(path, own)
        return plate, steadied(here, [
            Neighbour(self._sighting(other, its), share, self._flow(path, other), self._flow(other, path))
            for side in self._beside.get(path, ()) for other, its, share in self._of_its_shot(own, side)])

    def _of_its_shot(self, own: Guide, side: Sequence[Path]) -> Iterator[tuple[Path, Guide, np.float32]]:
        """(frame, its guide, how far it counts) of those at OFFSETS from a frame, to one side of it. A camera that
        moves soon sees other things; so the shot is followed from each of its frames to the next, past a flash or
        what else differs from it."""
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
        if (path, other) not in self._flows:
            here, there = self._sightings[path].guide, self._sightings[other].guide
            self._flows[path, other] = motion.flow(here.grey, there.grey)
        return self._flows[path, other]

    def _forget_all_but(self, paths: Container[Path], before: Container[Path]) -> None:
        """Flows between two frames of those `before` have been looked at by both."""
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
