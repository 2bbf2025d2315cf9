# SPDX-License-Identifier: GPL-3.0-or-later
"""The lamps of a scene, which are its own and stay as bright as they were filmed, with the glow of a clean lens.

A lamp clips, and so does the glow before it; how much of what is clipped is glow nobody can tell. A network that takes
some of it leaves lamps grey: in photographs of streets at night most of those that are not the brightest. So a small
place as bright as film gets, which stands out of its surroundings still when the flare is gone, is taken for a lamp,
and given back what was taken of it, the more the brighter it was left: its middle whole, of its rim little. A bright
wall under a veil stands out little, a ghost is gone. Of some lamps nothing is left that stands out; but what glow there
is about a white place comes from a lamp in its middle.

In the dark no lens is so clean that a lamp has no glow in it, and a flare is what comes on top of that. What comes of
which one picture does not say, and the network, whose flares were synthesised over lamps without any, takes both. So a
part of what is told as glow stays near a lamp at night. Of streaks, rays and ghosts nothing does, nor by day, when a
lamp outshines the rest by less.
"""
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels

BRIGHT = 0.9
"""Mean of the three display values from which on a place may be a lamp's."""
RIM = (0.8, 0.95)
"""The same about it: up to which nothing is given back, and from which on what is the lamp's."""
LARGE = (0.01, 0.02)
"""Share of the frame up to which such a place may be a lamp, and from which on it is none."""
FEW = 3
"""Pixels of the working size that a lamp has at least."""
STANDS_OUT = (0.15, 0.3)
"""How much brighter in display values than its surroundings a place is without the flare, up to which it is no lamp,
and from which on it is one."""
NEAR, ABOUT = 3, 7
"""Pixels a side of the squares that a place is grown by to what counts as its rim, and as its surroundings."""
ROUND = 4
"""Power of a pixel's brightness, in parts of the brightest of its lamp, by which it is given back."""
AMID_GLOW = (0.5, 0.8)
"""Part of what is told about a place that is glow, up to which that says nothing of a lamp, and from which on there is
one in its middle: what lies half as deep in it as its deepest pixel, or deeper."""
SHINES = (0.05, 0.15)
"""How much brighter than its surroundings such a place was filmed, up to which it is no lamp, and from which on it is.
"""
STAYS, REACH = 0.5, 0.05
"""Part of the glow that stays beside a lamp, and how far off, in parts of the frame's long side, it has fallen to a
third (to 1 / e) of that."""
DARK = (0.2, 0.3)
"""Median display value up to which a scene is dark, and from which on no glow stays in it; without the flare, which may
light all of the frame."""
WHITE = (0.9, 0.97)
"""Display value of its brightest pixel up to which a lamp keeps no glow, and from which on it does."""
STEPS = 4
"""In how many steps a place that may be a lamp counts as one for the glow about it."""


class _Lamps(NamedTuple):
    """Bright places by their numbers (h, w), 0 where there is none; and of each, (count,), how far it is a lamp, 0..1,
    as it stands out and as there is glow about it, and its brightest pixel, as filmed and as the flare leaves it."""

    places: NDArray[np.int32]
    stands_out: NDArray[Any]
    amid_glow: NDArray[Any]
    brightest_filmed: NDArray[Any]
    brightest_left: NDArray[Any]


def given_back(display: Pixels, added: Pixels, glow: Pixels, *, glow_stays: bool = True) -> Pixels:
    """The part, 0..1 (h, w, 3), of what a flare is told to add to display values 0..1 (h, w, 3) that is left there,
    since it is a lamp's. glow: the part of it, 0..1 (h, w, 3), that is glow round lights; glow_stays: and of which some
    is left beside the lamps."""
    filmed, left = display.mean(-1), np.maximum(display - added, 0).mean(-1)
    lamps = _found(filmed, left, added.mean(-1), (added * glow).mean(-1))
    of_glow = _beside(lamps, left)[..., None] * glow if glow_stays else np.zeros_like(glow)
    return np.asarray(np.maximum(_own(lamps, filmed, left)[..., None], of_glow), np.float32)


def _own(lamps: _Lamps, filmed: Pixels, left: Pixels) -> NDArray[Any]:
    """(h, w), 0..1, of what is taken at a place, the part that is taken of a lamp itself."""
    near = _grown(lamps.places, NEAR)
    bright = lamps.stands_out[near] * np.clip(left / lamps.brightest_left[near], 0, 1) ** ROUND
    middle = lamps.amid_glow[lamps.places] * _middles(lamps.places)
    return np.asarray(np.interp(filmed, RIM, (0, 1)) * np.maximum(bright, middle))


def _beside(lamps: _Lamps, left: Pixels) -> NDArray[Any]:
    """(h, w), the part of a glow that stays: most at the lamps, and the less the farther from them."""
    import cv2

    glowing = np.maximum(lamps.stands_out, lamps.amid_glow) * np.interp(lamps.brightest_filmed, WHITE, (0, 1))
    glowing = glowing[lamps.places]
    reach = np.float32(REACH * max(glowing.shape))
    near = np.zeros(glowing.shape, np.float32)
    for step in range(STEPS):
        dark = (glowing <= (step + 0.5) / STEPS).astype(np.uint8)
        if not dark.all():
            near += np.exp(-cv2.distanceTransform(dark, cv2.DIST_L2, cv2.DIST_MASK_5) / reach) / STEPS
    return np.asarray(STAYS * np.interp(np.median(left), DARK, (1, 0)) * near)


def _found(filmed: Pixels, left: Pixels, added: Pixels, glow: Pixels) -> _Lamps:
    """By brightness, as it was filmed and as the flare leaves it, and by what the flare adds and what of that is glow,
    each (h, w)."""
    import cv2

    count, numbers = cv2.connectedComponents((filmed > BRIGHT).astype(np.uint8))
    places = np.asarray(numbers, np.int32)
    about = np.where(_grown(places, NEAR) > 0, 0, _grown(places, ABOUT))
    middle = np.where(filmed >= _means(filmed, places, count)[places], places, 0)
    above, above_filmed = (_means(one, middle, count) - _means(one, about, count) for one in (left, filmed))
    of_glow = _means(glow, about, count) / np.maximum(_means(added, about, count), 1e-6)
    pixels = np.bincount(places.ravel(), minlength=count)
    small = np.interp(pixels / filmed.size, LARGE, (1, 0))
    small[pixels < FEW] = 0
    small[0] = 0  # what is no such place
    return _Lamps(places, small * np.interp(above, STANDS_OUT, (0, 1)),
                  small * np.interp(of_glow, AMID_GLOW, (0, 1)) * np.interp(above_filmed, SHINES, (0, 1)),
                  _most(filmed, middle, count), _most(left, middle, count))


def _middles(places: NDArray[np.int32]) -> Pixels:
    """(h, w), 0..1: how deep in its place each pixel lies, in parts of half as deep as the deepest."""
    import cv2

    deep = cv2.distanceTransform((places > 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    deepest = _most(np.asarray(deep), places, int(places.max()) + 1)
    return np.asarray(np.clip(deep / deepest[places] * 2, 0, 1), np.float32)


def _grown(places: NDArray[np.int32], side: int) -> NDArray[np.int32]:
    """Places by their numbers (h, w), 0 where there is none, grown by a square; where two meet, the later counts."""
    import cv2

    return np.asarray(cv2.dilate(places.astype(np.float32), np.ones((side, side), np.uint8)), np.int32)


def _most(values: Pixels, places: NDArray[np.int32], count: int) -> NDArray[Any]:
    """(count,), over each place; next to nothing where it has no pixel."""
    most = np.full(count, 1e-6)
    np.maximum.at(most, places, values)
    return most


def _means(values: Pixels, places: NDArray[np.int32], count: int) -> NDArray[Any]:
    """(count,), over each place; 0 where it has no pixel."""
    totals = np.bincount(places.ravel(), values.ravel(), minlength=count)
    return totals / np.maximum(np.bincount(places.ravel(), minlength=count), 1)
