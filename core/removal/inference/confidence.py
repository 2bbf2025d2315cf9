# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether what a network tells over a frame is a flare, or what lies in the frame, or how it is graded.

A flare is one in every view of a frame (`views`); what is taken for one in some alone seldom is. It is brightest near
its light and falls off from there; snow, haze and white walls, which are taken for one, are as even or as patchy as
they are in the scene. Pictures printed or graded so that black is grey look much as veiled ones do, but a grade lifts
display values and a veil adds light: so the frame is graded back, black to black, and the network asked again. Of a
lifted black it then tells nothing, of most flares, which are not even, what it told before.
"""
from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...colour.srgb import Pixels
from ..model.image_formation import flare_light
from . import optical_flow

ASKED = 0.0005
"""Mean over the frame of what is told, from which on it is asked whether it is a flare; less counts for none."""
BLACK = 0.002
"""Share of a frame that is darker than its black."""
NOTHING = 0.02
"""Part of what is told that has to be told again to count for something."""
AGREED = 0.05
"""Part of what is told by which views are apart that agree."""
PATCH = 8
"""How many patches the long side of a frame has: what is narrower than one is patchy."""
WEIGHTS, CONSTANT = (0.6, 0.6, -2.0, 0.9, -2.0), 0.5
"""By how much each of the `Signs` raises the log odds of a flare, in their order, and those without any; those of a
logistic regression (`benchmarks/removal.py odds`, and clean photographs besides), rounded."""
BELIEVED = (-0.25, 0.25)
"""Log odds of a flare up to which nothing is believed, and from which on all."""


class Signs(NamedTuple):
    """By what a flare is known: the logarithms of how much of what is told is told again of the frame graded back, as a
    part, of its mean light over the frame, of how far the views are apart, as a part of what they tell, and of how many
    times its mean its brightest place is; and how much of it is narrower than a patch, as a part."""

    again: float
    light: float
    apart: float
    peak: float
    patchy: float

    @property
    def log_odds(self) -> float:
        """Of a flare against none."""
        return float(np.dot(WEIGHTS, self) + CONSTANT)


def signs(display: Pixels, told: Pixels, apart: Pixels, again: Pixels) -> Signs:
    """Of display values 0..1, what views tell over them in the mean, how far they are apart from that (standard
    deviation), and what is told over them `graded_back`, each (h, w, 3)."""
    import cv2

    mean = max(float(told.mean()), 1e-9)
    coarse = optical_flow.coarser(told.mean(-1))
    patch = max(coarse.shape) // PATCH | 1
    broad = cv2.morphologyEx(coarse, cv2.MORPH_OPEN, np.ones((patch, patch), np.uint8))
    return Signs(again=float(np.log(again.mean() / mean + NOTHING)),
                 light=float(np.log(flare_light(display, told).mean() + 0.002)),
                 apart=float(np.log(apart.mean() / mean + AGREED)),
                 peak=float(np.log(max(coarse.max(), 1e-9) / mean)),
                 patchy=1 - float(broad.mean()) / mean)


def graded_back(display: Pixels) -> Pixels:
    """Display values 0..1 (h, w, 3) with the black of each channel at none."""
    black = np.quantile(display.reshape(-1, 3), BLACK, axis=0).astype(np.float32)
    return np.asarray(np.clip((display - black) / np.maximum(1 - black, 0.1), 0, 1), np.float32)


def worth(log_odds: float) -> np.float32:
    """The part of what is told that is believed, 0..1."""
    return np.float32(np.interp(log_odds, BELIEVED, (0, 1)))
