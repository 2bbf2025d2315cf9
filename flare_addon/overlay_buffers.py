# SPDX-License-Identifier: GPL-3.0-or-later
"""The offscreen buffers of the overlay, one set for each canvas.

A canvas is one eye in one region of a window, or a picture. With buffers of its own, a canvas need not be drawn again
when another one changes. `overlay` draws the levels into the buffers.
"""
from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .overlay_quads import DrawnRegion, Quads
from .stereo import Eye
from .views import view_areas

MAX_CANVASES = 4
"""Most canvases with buffers. Beyond it, the canvas that was drawn longest ago loses its buffers."""

Canvas = tuple[int, Eye]
"""A region's address, and an eye."""
PICTURE: Canvas = (0, "")
"""The canvas of pictures, which no region shows."""

Part = tuple[float, float, float, float]
"""Left, bottom, right and top of a part of a region, 0..1."""


@dataclass(frozen=True)
class DrawnLevels:
    """Levels that were drawn.

    offscreens: the buffer of each level that has Gaussians, by its divisor. part: the part of the region that they may
    cover; outside it they are black.
    """

    offscreens: dict[int, Any]
    part: Part


def part_of_quads(by_level: Mapping[int, Quads], window: DrawnRegion) -> Part:
    """Return the part of a region that the quads touch, enlarged by one texel of each level for the interpolation."""
    size = np.array([window.width, window.height], np.float64)
    low, high = size.copy(), np.zeros(2)
    for divisor, quads in by_level.items():
        x, y = quads.place.T
        low = np.minimum(low, divisor * (np.array([x.min(), y.min()]) - 1))
        high = np.maximum(high, divisor * (np.array([x.max(), y.max()]) + 1))
    (left, top), (right, bottom) = np.clip(np.floor(low), 0, size) / size, np.clip(np.ceil(high), 0, size) / size
    return float(left), float(1 - bottom), float(right), float(1 - top)


def create_offscreen(width: int, height: int) -> Any:
    """Create an offscreen buffer (width, height), pixels, of 32-bit floats. Needs a GPU context.

    Half floats would lose faint Gaussians to rounding in the bright core of a flare.
    """
    import gpu

    return gpu.types.GPUOffScreen(width, height, format="RGBA32F")


def open_regions() -> set[int]:
    """Return the addresses of the regions of all 3D views that windows show."""
    return {region.as_pointer() for area in view_areas() for region in area.regions}


class CanvasBuffers:
    """The offscreen buffers of a canvas, one for each level that it needed."""

    def __init__(self) -> None:
        self._offscreens: dict[int, tuple[tuple[int, int], Any]] = {}
        self.content: tuple[Any, DrawnLevels] | None = None
        """What the buffers hold: the key of `overlay._render_region`, and the levels. None if unknown."""

    def offscreen(self, divisor: int, width: int, height: int) -> Any:
        """Return the buffer of a level, whose size is that of the region (pixels) divided by `divisor`, rounded up.

        A buffer of this level with another size is freed.
        """
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


class BuffersByCanvas:
    """The buffers of the canvases that were drawn last."""

    def __init__(self) -> None:
        self._canvases: OrderedDict[Canvas, CanvasBuffers] = OrderedDict()

    def of(self, canvas: Canvas) -> CanvasBuffers:
        """Return the buffers of a canvas. With too many canvases, those of the one drawn longest ago are freed.

        Those of regions that no window shows are freed too.
        """
        drawable_regions = {PICTURE[0], canvas[0]} | open_regions()
        for closed in [key for key in self._canvases if key[0] not in drawable_regions]:
            self.free(closed)
        buffers = self._canvases.setdefault(canvas, CanvasBuffers())
        self._canvases.move_to_end(canvas)
        while len(self._canvases) > MAX_CANVASES:
            self._canvases.popitem(last=False)[1].free()
        return buffers

    def free(self, canvas: Canvas | None = None) -> None:
        """Free the buffers of a canvas; None for those of all canvases."""
        for key in list(self._canvases) if canvas is None else [canvas]:
            buffers = self._canvases.pop(key, None)
            if buffers is not None:
                buffers.free()
