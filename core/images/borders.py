# SPDX-License-Identifier: GPL-3.0-or-later
"""Black borders of frames: letterboxes above and below, pillars at the sides.

They stay in place while the camera moves, so they belong to no scene, and no flare is visible in them. Fits, scores and
removal leave them out.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

MAX_BORDER_LEVEL = 20 / 255
"""Highest display value of a border: black is 16 where video levels were taken for full ones."""
LEVEL_TOLERANCE, MIN_EVEN_SHARE = 4 / 255, 0.98
"""Difference in display value within which a border's pixels are even, and the share of a line that must be.

The other pixels, which JPEG makes next to the picture, may differ by three times as much.
"""
MIN_BORDER_LINES = 2
"""Lines of the narrowest border; also the difference allowed between two facing ones."""
MIN_AREA_SIDE = 16
"""Smallest side, px, of the area inside the borders."""


class Borders(NamedTuple):
    """Number of even, black lines at each side of a picture."""

    top: int
    bottom: int
    left: int
    right: int

    @classmethod
    def measure(cls, picture: NDArray[Any], to_display: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray) -> Borders:
        """Measure the borders of a picture (height, width, 3). to_display: converts a line to display values 0..1."""
        height, width = picture.shape[:2]
        top, bottom = _count_border_lines(lambda row: to_display(picture[row]), height)
        left, right = _count_border_lines(lambda column: to_display(picture[top:height - bottom, column]), width)
        return cls(top, bottom, left, right)

    def intersection(self, other: Borders) -> Borders:
        """Return the borders that both have."""
        return Borders(*map(min, self, other))

    def area(self, width: int, height: int, margin: int = 0) -> PictureArea:
        """Return the area inside the borders of a picture of this size, less `margin` lines next to each border.

        If two facing borders differ, the narrower width counts for both: a night sky can widen one, and is no border.
        An area with a side below MIN_AREA_SIDE becomes the whole picture.
        """
        top, bottom = _match_facing(self.top, self.bottom)
        left, right = _match_facing(self.left, self.right)
        area = PictureArea(top + margin * (top > 0), height - bottom - margin * (bottom > 0),
                           left + margin * (left > 0), width - right - margin * (right > 0))
        return area if min(area.size) >= MIN_AREA_SIDE else PictureArea(0, height, 0, width)


class PictureArea(NamedTuple):
    """The rows and columns of a picture inside its borders; bottom and right are exclusive."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index that crops an array (height, width, ...) to the area."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.right - self.left, self.bottom - self.top


def find_picture_area(picture: NDArray[Any],
                      to_display: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray) -> PictureArea:
    """Find the area inside the borders of a picture (height, width, 3). to_display: converts a line to display values
    0..1."""
    return Borders.measure(picture, to_display).area(picture.shape[1], picture.shape[0])


def _match_facing(first: int, last: int) -> tuple[int, int]:
    """Return the numbers of lines of two facing borders: the lower one for both where they differ by more than
    MIN_BORDER_LINES, zeros where either is no border."""
    if min(first, last) < MIN_BORDER_LINES:
        return 0, 0
    return (first, last) if abs(first - last) <= MIN_BORDER_LINES else (min(first, last),) * 2


def _count_border_lines(read_line: Callable[[int], NDArray[Any]], count: int) -> tuple[int, int]:
    """Count the black lines at both ends; none in a picture that is black all over. read_line: returns the pixels
    (length, 3) of a line, as display values. count: number of lines."""
    first, last = (_count_leading_lines(read_line, order) for order in (range(count), range(count - 1, -1, -1)))
    return (first, last) if first + last < count else (0, 0)


def _count_leading_lines(read_line: Callable[[int], NDArray[Any]], positions: Iterable[int]) -> int:
    """Count the even, black lines at `positions`, in their order, up to the first line that is not.

    read_line: returns the pixels (length, 3) of the line at a position, as display values. All lines must have the
    colour of the first.
    """
    colour, index = None, -1
    for index, position in enumerate(positions):
        pixels = read_line(position)
        if colour is None:
            colour = np.median(pixels, 0)
            if not colour.max() <= MAX_BORDER_LEVEL:  # not `>`: so that NaN is no border
                return 0
        difference = np.abs(pixels - colour).max(-1)
        if (difference <= LEVEL_TOLERANCE).mean() < MIN_EVEN_SHARE or not difference.max() <= 3 * LEVEL_TOLERANCE:
            return index
    return index + 1
