# SPDX-License-Identifier: GPL-3.0-or-later
"""Coarse-to-fine fits: the size of the pictures in each iteration.

A scene is first fitted to small pictures, which cost a fraction of the time, and to full size later: its Gaussians are
still large at first, and small pictures determine them as well. A flare is soft, so while it is fitted by itself, over
clean frames, still smaller pictures are enough. `trainer` asks for the reduction of each iteration.
"""
from __future__ import annotations

import math
from dataclasses import dataclass


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

    def scene_reduction(self, width: int, progress: float) -> int:
        """Return the factor by which pictures of the scene are reduced; width: that of the whole picture, pixels;
        progress: share of the iterations, 0..1.

        The larger the whole picture is, the later it is used: each doubling halves its share of the iterations.
        """
        levels = _halvings(width, self.scene_width)
        for level in range(levels, 0, -1):
            if progress <= 1 - (1 - self.scene_until) * 0.5 ** (levels - level):
                return 1 << level
        return 1

    def flare_reduction(self, width: int, progress: float) -> int:
        """Return the factor by which pictures of the composite are reduced while the flare is fitted by itself.

        width, progress: as for `scene_reduction`.
        """
        if not self.flare_width:
            return self.scene_reduction(width, progress)
        levels = _halvings(width, self.flare_width)
        return 1 << (levels if progress <= self.flare_until else max(levels - 1, 0))


def _halvings(width: int, smallest_width: int) -> int:
    """Return how many times `width` is halved to come near `smallest_width`; 0 if that is 0 or wider."""
    return max(round(math.log2(width / smallest_width)), 0) if smallest_width else 0
