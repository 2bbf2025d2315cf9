# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether what a network tells over a frame is a flare, or how the frame is graded.

Pictures printed or graded so that black is grey look much as veiled ones do. They differ: a grade lifts display
values, a veil adds light. So the frame is graded back, black to black, and the network asked again: of a lifted black
it then tells nothing, of most flares, which are not even, what it told before. Of an even veil it tells nothing either;
so it counts too how strong it is, as hardly a grade is, whether a light is seen, and how flat the darks
are, which a veil flattens and a grade does not.
"""
from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..pictures import Pixels
from .formation import flare_light

FAINT = (0.004, 0.008)
"""Mean over the frame of what is told, up to which it is no grade, since a grade that anyone sees is told as more, and
from which on it may be one."""
BLACK = 0.002
"""Share of a frame that is darker than its black."""
DARKS = (0.001, 0.01, 0.1)
"""Shares of a frame that are darker than the three values that its darks are measured by."""
NOTHING = 0.02
"""Part of what is told that has to be told again to count for something."""
SATURATED = 0.99
"""Display value from which on a channel is."""
WEIGHTS, CONSTANT = (1.45, 1.0, 4.0, 1.2), 8.0
"""By how much each of the `Signs` raises the log odds of a flare, in their order, and those without any. Near those of
a logistic regression (`benchmarks/removal.py graded`), but that light weighs more: among the grades that it learns from
some are as strong as any veil, among photographs none."""
BELIEVED = (-0.75, -0.25)
"""Log odds of a flare up to which nothing is believed, and from which on all."""


class Signs(NamedTuple):
    """Of a flare, the likelier the greater they are: how much of what is told is told again of the frame graded back,
    as the logarithm of a part; its mean light over the frame, as a logarithm; the share of the frame that is
    saturated; and how much of the darks' range lies between the two lower of `DARKS`."""

    again: float
    light: float
    lights: float
    flat: float

    @property
    def log_odds(self) -> np.float32:
        """Of a flare against a grade."""
        return np.float32(np.dot(WEIGHTS, self) + CONSTANT)


def signs(display: Pixels, told: Pixels, again: Pixels) -> Signs:
    """Of display values 0..1, what is told over them and what is told over them `graded_back`, each (h, w, 3)."""
    grey = display.mean(-1)
    darkest, darker, dark = np.quantile(grey, DARKS)
    return Signs(again=float(np.log(again.mean() / max(told.mean(), 1e-9) + NOTHING)),
                 light=float(np.log(flare_light(display, told).mean() + 0.002)),
                 lights=float((display >= SATURATED).mean()),
                 flat=float((darker - darkest) / max(dark - darkest, 0.01)))


def graded_back(display: Pixels) -> Pixels:
    """Display values 0..1 (h, w, 3) with the black of each channel at none."""
    black = np.quantile(display.reshape(-1, 3), BLACK, axis=0).astype(np.float32)
    return np.asarray(np.clip((display - black) / np.maximum(1 - black, 0.1), 0, 1), np.float32)


def may_be(told: Pixels) -> np.float32:
    """0..1, whether so much is told that a grade may be it."""
    return np.float32(np.interp(told.mean(), FAINT, (0, 1)))


def worth(log_odds: float) -> np.float32:
    """The part of what is told that is believed, 0..1."""
    return np.float32(np.interp(log_odds, BELIEVED, (0, 1)))
