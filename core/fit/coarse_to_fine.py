# SPDX-License-Identifier: GPL-3.0-or-later
"""Coarse-to-fine fits: the size of the pictures in each iteration.

A scene is first fitted to small pictures, which cost a fraction of the time, and to full size later: its Gaussians are
still large at first, and small pictures determine them as well. A flare is soft, so while it is fitted by itself, over
clean frames, still smaller pictures are enough. `trainer` asks for the reduction of each iteration.
"""
from __future__ import annotations

import math
from dataclasses import dataclass

MIN_SIDE = 8
"""Shortest side of a reduced picture, pixels."""


@dataclass(frozen=True)
class CoarseToFineSettings:
    """Widths in pixels of the first pictures, and shares of the iterations, from the start, that use them.

    scene_width: of the pictures of the scene until `scene_until`; 0 for full size throughout. flare_width: of the
    pictures of the composite until `flare_until`, and twice that until the flare is fitted together with the scene; 0
    for the size of the scene's pictures. Pictures are reduced by powers of 2, so they have about these widths.
    """

    scene_width: int = 0
    scene_until: float = 0.35
    flare_width: int = 0
    flare_until: float = 0.4

    def scene_reduction(self, size: tuple[int, int], progress: float) -> int:
        """Return the factor by which pictures of the scene are reduced; size: (width, height) of the whole picture,
        pixels; progress: share of the iterations, 0..1.

        The larger the whole picture is, the later it is used: each doubling halves its share of the iterations.
        """
        levels = _halvings(size, self.scene_width)
        for level in range(levels, 0, -1):
            if progress <= 1 - (1 - self.scene_until) * 0.5 ** (levels - level):
                return 1 << level
        return 1

    def flare_reduction(self, size: tuple[int, int], progress: float) -> int:
        """Return the factor by which pictures of the composite are reduced while the flare is fitted by itself, if
        `flare_width` is not 0.

        size, progress: as for `scene_reduction`.
        """
        levels = _halvings(size, self.flare_width)
        return 1 << (levels if progress <= self.flare_until else max(levels - 1, 0))


def _halvings(size: tuple[int, int], smallest_width: int) -> int:
    """Return how many times pictures of a size (width, height) are halved to come near `smallest_width`; 0 if that is 0
    or wider.

    Neither side gets shorter than MIN_SIDE.
    """
    if not smallest_width:
        return 0
    limit = max(math.floor(math.log2(min(size) / MIN_SIDE)), 0) if min(size) else 0
    return min(max(round(math.log2(size[0] / smallest_width)), 0), limit)
