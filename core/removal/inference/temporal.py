# SPDX-License-Identifier: GPL-3.0-or-later
"""What is told of a frame of a shot, put right by the frames about it, which show the same scene.

A flare moves as nothing in the scene does: what it covers in one frame lies bare in another. So every place is followed
to where it is in the frames about it (`motion`), and the scene's colour there is taken to be the median of what their
clean frames have, at one exposure, each weighted by how far the flow can be relied on and by how little had to be taken
away: where hardly any flare is told, the scene was seen. A network that sees each frame by itself tells a little more
now and a little less then; what it missed, or took too much, is put right by those that saw better, and the clean
plates do not breathe. Only what is smooth is put right, since a frame's detail is its own, and by no more than was told
about there: where there is no flare, a lamp that comes on changes nothing. What is not found again stays as it was
told.

Whether the network is believed (`odds`) is one for the frames about a place in a shot, too: where most of them plainly
have a flare, it does not go out on the others. Which frames are of one shot, their details say (`of_one_shot`);
`sequences` finds them among files.
"""
from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels
from . import optical_flow
from .remover import CLIPPED, Told
from .test_time_views import Views, believed, worth_of

FAINT = 0.03
"""What a flare adds to display values where a frame counts half of what it counts where there is none."""
SMOOTH, WITHIN = 2.5, 4.0
"""Pixels of the flow: standard deviations of the blurs of what is put right, and of what was told about there, by which
it is bounded."""
DETAIL = 0.7
"""Pixels of the flow: that finer than which the scene is not compared."""
WITNESSES, HARDLY_FOUND = 2.0, 0.1
"""Frames that a place has to be found again in for all of what they say to be put right; with fewer, less. Part of
those below which what is put right fades, where none of the places about it is found."""
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
    return Guide(display, optical_flow.grey(display), few - _blurred(few, COARSE * max(display.shape[:2]) / STEP))


def of_one_shot(one: Guide, other: Guide) -> np.float32:
    """How far two frames count for each other, 0..1; not at all where their shapes differ."""
    if one.display.shape != other.display.shape:
        return np.float32(0)
    a, b = one.detail, other.detail
    alike = ((a * b).mean() + NO_DETAIL) / (np.sqrt(np.square(a).mean() * np.square(b).mean()) + NO_DETAIL)
    return np.float32(np.clip((alike - ANOTHER_SHOT) / (SAME_SHOT - ANOTHER_SHOT), 0, 1))


def steadied(here: Sighting, about: Sequence[Neighbour]) -> Told:
    """What was told of `here`, put right by the frames about it."""
    display = here.guide.display
    worth = worth_of([(here.views, 1.0), *((other.sighting.views, float(other.share)) for other in about)])
    added = np.minimum(believed(here.views), display)
    if not about:
        return Told(display, added, worth, here.views.glow)
    own = _seen(here)
    missed = _missed(own, [_found_again(own, other) for other in about])
    added = np.clip(added + _finer(missed, display), 0, display)
    return Told(display, added, worth, here.views.glow)


class _Seen(NamedTuple):
    """Of a frame, at the flow's size: what is left of it without its flare and its detail (h, w, 3), the most that the
    flare adds to a channel (h, w), and how far a place of it can be relied on to be the one that is looked at (h, w).
    """

    scene: Pixels
    told: Pixels
    sure: Pixels

    @property
    def weights(self) -> Pixels:
        """The less flare, the more of the scene was seen."""
        return self.sure / (1 + np.square(self.told / np.float32(FAINT)))


def _seen(frame: Sighting) -> _Seen:
    added = optical_flow.coarser(believed(frame.views))
    scene = _blurred(optical_flow.coarser(frame.guide.display) - added, DETAIL)
    told: Pixels = added.max(-1)
    return _Seen(scene, told, np.ones_like(told))


def _found_again(own: _Seen, other: Neighbour) -> _Seen:
    """Of a frame what it shows of the places of `own`, laid where those are, as bright as it is there."""
    scene, told, _ = _seen(other.sighting)
    laid = optical_flow.brought(np.dstack([scene, told]), other.there)
    found = _Seen(laid[..., :3], laid[..., 3], other.share * optical_flow.followed(other.there, other.back))
    return found._replace(scene=found.scene * _exposure(own, found))


def _exposure(own: _Seen, found: _Seen) -> np.float32:
    """How many times as bright the one is as the other: the median over what both show without a flare, neither black
    nor clipped. Else a camera that changes its exposure, or a fade, would pass for a flare."""
    here, there = own.scene.mean(-1), found.scene.mean(-1)
    both = np.minimum(here, there) > BLACK
    both &= np.maximum(own.scene.max(-1), found.scene.max(-1)) < CLIPPED
    both &= np.maximum(own.told, found.told) < FAINT
    sure = found.sure[both]
    if sure.sum() < BARE * both.size:
        return np.float32(1)
    return np.float32(_weighted_median(here[both] / there[both], sure))


def _missed(own: _Seen, found: Sequence[_Seen]) -> Pixels:
    """What there is more of a flare than was told of `own` (h, w, 3), by what was found of its places elsewhere; below
    0 where too much was told."""
    seen = [own, *found]
    scene = _weighted_median(np.stack([one.scene for one in seen]), np.stack([one.weights for one in seen])[..., None])
    sure = np.minimum(np.sum([one.sure for one in found], 0) / np.float32(WITNESSES), 1)
    smooth = _blurred((own.scene - scene) * sure[..., None], SMOOTH)
    smooth /= (_blurred(sure, SMOOTH) + np.float32(HARDLY_FOUND))[..., None]
    bound = _blurred(np.max([own.told, *(one.sure * one.told for one in found)], 0), WITHIN)[..., None]
    return np.clip(smooth, -bound, bound)


def _weighted_median(values: Pixels, weights: Pixels) -> Pixels:
    """Over the first axis; of a shape that the weights' broadcasts to."""
    order = np.argsort(values, 0)
    sums = np.cumsum(np.take_along_axis(np.broadcast_to(weights, values.shape), order, 0), 0)
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
