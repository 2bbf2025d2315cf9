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
"""Display value by which a border's pixels differ from its colour, and the share of a line for which that holds."""
LEAST = 2
"""Lines."""
UNLIKE = 0.1
"""Share by which two borders that face each other differ, or LEAST lines: a night sky has none across from it."""


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

    @classmethod
    def whole(cls, width: int, height: int) -> Inside:
        """Of a picture without borders."""
        return cls(0, height, 0, width)

    def less(self, lines: int, width: int, height: int) -> Inside:
        """Without so many more lines beside each border of a picture of this size."""
        return Inside(self.top + lines * (self.top > 0), self.bottom - lines * (self.bottom < height),
                      self.left + lines * (self.left > 0), self.right - lines * (self.right < width))

    def joined(self, other: Inside) -> Inside:
        """What lies inside of one of them."""
        return Inside(min(self.top, other.top), max(self.bottom, other.bottom), min(self.left, other.left),
                      max(self.right, other.right))


def inside_borders(picture: NDArray[Any], shown: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray) -> Inside:
    """What of a picture (height, width, 3) lies inside its borders. shown: makes a line's display values 0..1."""
    height, width = picture.shape[:2]
    top, bottom = _facing(lambda row: shown(picture[row]), height)
    left, right = _facing(lambda column: shown(picture[top:height - bottom, column]), width)
    return Inside(top, height - bottom, left, width - right)


def _facing(line: Callable[[int], NDArray[Any]], count: int) -> tuple[int, int]:
    """Lines of the two borders that face each other, (0, 0) where there are none."""
    first, last = _lines(line, range(count)), _lines(line, range(count - 1, -1, -1))
    even = abs(first - last) <= max(LEAST, UNLIKE * max(first, last))
    return (first, last) if min(first, last) >= LEAST and even and first + last < count else (0, 0)


def _lines(line: Callable[[int], NDArray[Any]], order: Iterable[int]) -> int:
    colour = None
    for number, at in enumerate(order):
        pixels = line(at)
        if colour is None:
            colour = np.median(pixels, 0)
            if not colour.max() <= DARKEST:
                return 0
        if (np.abs(pixels - colour) <= EVEN).all(-1).mean() < SHARE:
            return number
    return 0  # a picture that is black all over has none
