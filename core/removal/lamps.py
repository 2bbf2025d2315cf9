# SPDX-License-Identifier: GPL-3.0-or-later
"""The lamps of a scene, which are its own and stay as bright as they were filmed, with the glow of a clean lens.

A lamp clips, and so does the glow before it; how much of what is clipped is glow nobody can tell. A network that takes
some of it leaves lamps grey: in photographs of streets at night most of those that are not the brightest. So a small
place as bright as film gets, which stands out of its surroundings still when the flare is gone, is taken for a lamp,
and given back what was taken of it, the more the brighter it was left: its middle whole, of its rim little. A bright
wall under a veil stands out little, a ghost is gone.

In the dark no lens is so clean that a lamp has no glow in it, and a flare is what comes on top of that. What comes of
which one picture does not say, and the network, whose flares were synthesised over lamps without any, takes both. So a
part of what is told as glow stays near a lamp at night. Of streaks, rays and ghosts nothing does, nor by day, when a
lamp is less brighter than the rest.
"""
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..pictures import Pixels

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
STAYS, REACH = 0.5, 0.05
"""Part of the glow that stays beside a lamp, and how far off, in parts of the frame's long side, it has fallen to a
third (to 1 / e) of that."""
DARK = (0.2, 0.3)
"""Median display value without the flare up to which a scene is dark, and from which on no glow stays in it."""
WHITE = (0.9, 0.97)
"""Display value of its brightest pixel up to which a lamp keeps no glow, and from which on it does."""
STEPS = 4
"""In how many steps a place that may be a lamp counts as one for the glow about it."""


class _Lamps(NamedTuple):
    """Bright places by their numbers (h, w), 0 where there is none; and of each, (count,), how far it is a lamp, 0..1,
    and its brightest pixel, as it was filmed and as the flare leaves it."""

    places: NDArray[np.int32]
    likely: NDArray[Any]
    filmed: NDArray[Any]
    left: NDArray[Any]


def given_back(display: Pixels, added: Pixels, glow: Pixels) -> Pixels:
    """The part, 0..1 (h, w, 3), of what a flare is told to add to display values 0..1 (h, w, 3) that is left there,
    since it is a lamp's. glow: the part of it, 0..1 (h, w, 3), that is glow round lights."""
    filmed, left = display.mean(-1), np.maximum(display - added, 0).mean(-1)
    lamps = _found(filmed, left)
    near = _grown(lamps.places, NEAR)
    rim = np.interp(filmed, RIM, (0, 1)) * np.clip(left / lamps.left[near], 0, 1) ** ROUND
    own = np.asarray(lamps.likely[near] * rim, np.float32)
    glowing = lamps.likely * np.interp(lamps.filmed, WHITE, (0, 1))
    stays = np.float32(STAYS * np.interp(np.median(left), DARK, (1, 0)))
    return np.asarray(np.maximum(own[..., None], stays * _beside(glowing[lamps.places])[..., None] * glow))


def _found(filmed: Pixels, left: Pixels) -> _Lamps:
    """By brightness (h, w), as it was filmed and as the flare leaves it."""
    import cv2

    count, numbers = cv2.connectedComponents((filmed > BRIGHT).astype(np.uint8))
    places = np.asarray(numbers, np.int32)
    about = np.where(_grown(places, NEAR) > 0, 0, _grown(places, ABOUT))
    middle = np.where(filmed >= _means(filmed, places, count)[places], places, 0)
    stands_out = _means(left, middle, count) - _means(left, about, count)
    pixels = np.bincount(places.ravel(), minlength=count)
    likely = np.interp(stands_out, STANDS_OUT, (0, 1)) * np.interp(pixels / filmed.size, LARGE, (1, 0))
    likely[pixels < FEW] = 0
    likely[0] = 0  # what is no such place
    return _Lamps(places, likely, _most(filmed, middle, count), _most(left, middle, count))


def _beside(glowing: NDArray[Any]) -> Pixels:
    """(h, w), as much as what is glowing, 0..1 (h, w), and the less the farther from it."""
    import cv2

    reach = REACH * max(glowing.shape)
    near = np.zeros(glowing.shape, np.float32)
    for step in range(STEPS):
        dark = (glowing <= (step + 0.5) / STEPS).astype(np.uint8)
        if not dark.all():
            near += np.exp(-cv2.distanceTransform(dark, cv2.DIST_L2, cv2.DIST_MASK_5) / np.float32(reach)) / STEPS
    return near


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
