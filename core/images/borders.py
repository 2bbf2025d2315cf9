# SPDX-License-Identifier: GPL-3.0-or-later
"""Black borders of a picture: letterboxes above and below it, pillars at its sides. They stay where they are while the
camera moves, so they are no part of a scene, and nothing of a flare is to be seen in them."""
from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

DARKEST = 20 / 255
"""Display value of a border at most: black is 16 where video levels were taken for full ones."""
EVEN, SHARE = 4 / 255, 0.98
"""Display value by which a border's pixels differ from its colour, and the share of a line for which that holds; the
others, which JPEG makes beside the picture, may differ by three times as much."""
LEAST = 2
"""Lines of a border."""
SMALLEST = 16
"""Pixels each way that are left of a picture at least."""


class Borders(NamedTuple):
    """Lines of a picture that are even and black, from each of its sides inwards."""

    top: int
    bottom: int
    left: int
    right: int

    @classmethod
    def of(cls, picture: NDArray[Any], shown: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray) -> Borders:
        """Of a picture (height, width, 3). shown: makes a line's display values 0..1."""
        height, width = picture.shape[:2]
        top, bottom = _lines(lambda row: shown(picture[row]), height)
        left, right = _lines(lambda column: shown(picture[top:height - bottom, column]), width)
        return cls(top, bottom, left, right)

    def common(self, other: Borders) -> Borders:
        """What both have."""
        return Borders(*map(min, self, other))

    def inside(self, width: int, height: int, soft: int = 0) -> Inside:
        """What of a picture of this size lies inside letterboxes and pillars, `soft` lines beside each left out too.

        Those are as wide on one side as on the other: a night sky makes the one wider than it is, and is none by
        itself.
        """
        (top, bottom), (left, right) = (_facing(*pair) for pair in ((self.top, self.bottom), (self.left, self.right)))
        found = Inside(top + soft * (top > 0), height - bottom - soft * (bottom > 0), left + soft * (left > 0),
                       width - right - soft * (right > 0))
        return found if min(found.size) >= SMALLEST else Inside(0, height, 0, width)


class Inside(NamedTuple):
    """The rows and columns of a picture that are no border, from the first to before the last."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def part(self) -> tuple[slice, slice]:
        """To take it from an array."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.right - self.left, self.bottom - self.top


def inside_borders(picture: NDArray[Any], shown: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray) -> Inside:
    """What of a picture (height, width, 3) lies inside its borders. shown: makes a line's display values 0..1."""
    return Borders.of(picture, shown).inside(picture.shape[1], picture.shape[0])


def _facing(first: int, last: int) -> tuple[int, int]:
    """Lines of two borders that face each other, of those that are black."""
    if min(first, last) < LEAST:
        return 0, 0
    return (first, last) if abs(first - last) <= LEAST else (min(first, last),) * 2


def _lines(line: Callable[[int], NDArray[Any]], count: int) -> tuple[int, int]:
    """Lines that are black, from the first on and from the last back; none of a picture that is black all over."""
    first, last = (_before_the_picture(line, order) for order in (range(count), range(count - 1, -1, -1)))
    return (first, last) if first + last < count else (0, 0)


def _before_the_picture(line: Callable[[int], NDArray[Any]], order: Iterable[int]) -> int:
    colour, number = None, -1
    for number, at in enumerate(order):
        pixels = line(at)
        if colour is None:
            colour = np.median(pixels, 0)
            if not colour.max() <= DARKEST:
                return 0
        apart = np.abs(pixels - colour).max(-1)
        if (apart <= EVEN).mean() < SHARE or not apart.max() <= 3 * EVEN:
            return number
    return number + 1
