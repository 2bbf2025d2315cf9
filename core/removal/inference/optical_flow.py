# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a place of one frame is in another: dense optical flow, there and back.

By dense inverse search (Kroeger et al. 2016, "Fast Optical Flow using Dense Inverse Search", OpenCV's DIS). A flow is
worth as much as the one back agrees with it: where something hides a place they lead to other places (Sundaram et al.
2010, "Dense Point Trajectories by GPU-accelerated Large Displacement Optical Flow").
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels

COARSER = 2
"""Pixels of a frame that are one of its flow, by side."""
APART, APART_PER_PIXEL = 0.5, 0.02
"""Pixels of the flow by which there and back are apart where a flow counts for e**-1, and how many more of them for
each pixel of its length."""


def grey(display: Pixels) -> NDArray[np.uint8]:
    """8 bit codes (h, w) by which frames are followed, of display values 0..1 (h, w, 3)."""
    import cv2

    return np.asarray(cv2.cvtColor((np.clip(display, 0, 1) * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY))


def flow(here: NDArray[np.uint8], there: NDArray[np.uint8]) -> Pixels:
    """(h / COARSER, w / COARSER, 2): how far right and down what `here` shows is `there`, in its own pixels.

    By one thread, since the search goes from place to place within what a thread is given: by several it would find
    others on another machine.
    """
    import cv2

    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        found = np.asarray(search.calc(here, there, None), np.float32)  # type: ignore[call-overload]
    finally:
        cv2.setNumThreads(threads)
    return coarser(found) / COARSER


def coarser(values: Pixels) -> Pixels:
    """Means of squares of COARSER pixels."""
    import cv2

    height, width = values.shape[:2]
    return np.asarray(cv2.resize(values, (width // COARSER, height // COARSER), interpolation=cv2.INTER_AREA))


def brought(values: Pixels, there: Pixels) -> Pixels:
    """`values` (h, w, c) of the other frame, laid where this one shows the same; beyond its edges, those at them."""
    import cv2

    x, y = _places(there)
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def followed(there: Pixels, back: Pixels) -> Pixels:
    """0..1 (h, w): how far the flow to another frame can be relied on, by the one back; 0 where it leads out of it."""
    height, width = there.shape[:2]
    x, y = _places(there)
    apart = np.linalg.norm(there + brought(back, there), axis=-1)
    allowed = APART + APART_PER_PIXEL * np.linalg.norm(there, axis=-1)
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return np.asarray(inside * np.exp(-np.square(apart / allowed)), np.float32)


def _places(there: Pixels) -> tuple[Pixels, Pixels]:
    y, x = np.mgrid[:there.shape[0], :there.shape[1]].astype(np.float32)
    return x + there[..., 0], y + there[..., 1]
