# SPDX-License-Identifier: GPL-3.0-or-later
"""The offscreen buffers of the overlay. Each view has its own, so that two views or two eyes do not redraw each other.

A view is an eye in a region of a window, or a picture. `overlay` draws the levels into them.
"""
from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .overlay_quads import DrawnRegion, Quads
from .stereo import Eye

MAX_VIEWS = 4
"""Most views whose buffers are kept; the view that was not drawn for longest loses its buffers."""

View = tuple[int, Eye]
"""A region's address, and an eye."""
PICTURE: View = (0, "")
"""The view of pictures, which no region shows."""

Part = tuple[float, float, float, float]
"""Left, bottom, right and top of a part of a region, 0..1."""


@dataclass(frozen=True)
class DrawnLevels:
    """Levels that were drawn.

    offscreens: the buffer of each level that has Gaussians, by its divisor. part: the part of the region outside of
    which they are black.
    """

    offscreens: dict[int, Any]
    part: Part


def part_of_quads(by_level: Mapping[int, Quads], window: DrawnRegion) -> Part:
    """Return the part of a region that quads touch, with the texels between which the buffers are interpolated."""
    size = np.array([window.width, window.height], np.float64)
    low, high = size.copy(), np.zeros(2)
    for divisor, quads in by_level.items():
        x, y = quads.place.T
        low = np.minimum(low, divisor * (np.array([x.min(), y.min()]) - 1))
        high = np.maximum(high, divisor * (np.array([x.max(), y.max()]) + 1))
    (left, top), (right, bottom) = np.clip(np.floor(low), 0, size) / size, np.clip(np.ceil(high), 0, size) / size
    return float(left), float(1 - bottom), float(right), float(1 - top)


def create_offscreen(width: int, height: int) -> Any:
    """Create an offscreen buffer of 32-bit floats: in the bright core of a flare, a sum of half floats loses the light
    of faint Gaussians to rounding. Needs a GPU context."""
    import gpu

    return gpu.types.GPUOffScreen(width, height, format="RGBA32F")


class ViewBuffers:
    """The offscreen buffers of a view, one for each level that it needed."""

    def __init__(self) -> None:
        self._offscreens: dict[int, tuple[tuple[int, int], Any]] = {}
        self.content: tuple[Any, DrawnLevels] | None = None
        """What the buffers hold: the key of `overlay._render_region`, and the levels. None if unknown."""

    def offscreen(self, divisor: int, width: int, height: int) -> Any:
        """Return the buffer of a level, whose size is that of the region (pixels) divided by `divisor`, rounded up.

        A buffer of this level with another size is freed."""
        key = max(-(-width // divisor), 1), max(-(-height // divisor), 1)
        known = self._offscreens.get(divisor)
        if known is None or known[0] != key:
            if known is not None:
                known[1].free()
            known = self._offscreens[divisor] = key, create_offscreen(*key)
        return known[1]

    def free(self) -> None:
        """Free all buffers."""
        self.content = None
        for _, offscreen in self._offscreens.values():
            offscreen.free()
        self._offscreens.clear()


class BuffersByView:
    """The buffers of the views that were drawn last."""

    def __init__(self) -> None:
        self._views: OrderedDict[View, ViewBuffers] = OrderedDict()

    def of(self, view: View) -> ViewBuffers:
        """Return the buffers of a view; those of the view that was not drawn for longest are freed."""
        buffers = self._views.setdefault(view, ViewBuffers())
        self._views.move_to_end(view)
        while len(self._views) > MAX_VIEWS:
            self._views.popitem(last=False)[1].free()
        return buffers

    def free(self, view: View | None = None) -> None:
        """Free the buffers of a view; None for those of all views."""
        for name in list(self._views) if view is None else [view]:
            buffers = self._views.pop(name, None)
            if buffers is not None:
                buffers.free()
