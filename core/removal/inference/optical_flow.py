# SPDX-License-Identifier: GPL-3.0-or-later
"""Dense optical flow between frames, warping along it, and how far it can be relied on.

The flow is OpenCV's DIS (Kroeger et al. 2016, "Fast Optical Flow using Dense Inverse Search"). Its confidence is the
forward-backward consistency: where something hides a place, the two flows lead to different places (Sundaram et al.
2010, "Dense Point Trajectories by GPU-accelerated Large Displacement Optical Flow"). `neighbours` computes flows,
`temporal` warps along them.
"""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels
from .filters import DOWNSAMPLING, downsample

FB_TOLERANCE_PX, FB_TOLERANCE_PER_PX = 0.5, 0.02
"""Forward-backward error, pixels of the flow, at which the confidence is 1 / e; and what is added to it for each pixel
of the flow's length."""


def to_grey_codes(display: Pixels) -> NDArray[np.uint8]:
    """Convert display values 0..1 (h, w, 3) to the 8 bit codes (h, w) that the flow is computed on."""
    import cv2

    return np.asarray(cv2.cvtColor((np.clip(display, 0, 1) * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY))


def compute_flow(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> Pixels:
    """Return the flow from a frame to another, (h / DOWNSAMPLING, w / DOWNSAMPLING, 2): x and y, in pixels of the flow.
    """
    return downsample(dense_flow(source, target)) / DOWNSAMPLING


def dense_flow(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> Pixels:
    """Return the flow from a frame to another, (h, w, 2): x and y, in pixels of the frame.

    source, target: grey codes (h, w) of the frames.

    One thread computes it: the search propagates within the part of the frame that a thread gets, so that with several
    threads the result would depend on their number.
    """
    import cv2

    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return np.asarray(search.calc(source, target, None), np.float32)  # type: ignore[call-overload]
    finally:
        cv2.setNumThreads(threads)


def warp(values: Pixels, flow: Pixels) -> Pixels:
    """Resample `values` (h, w, c) of the target frame to the source frame along the flow to it (h, w, 2); beyond its
    edges the values at the edge."""
    import cv2

    x, y = _target_coordinates(flow)
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def forward_backward_confidence(flow_forward: Pixels, flow_backward: Pixels) -> Pixels:
    """Return the confidence in the flow to another frame by its consistency with the flow back, 0..1, (h, w); 0 where
    the flow leads out of that frame."""
    height, width = flow_forward.shape[:2]
    x, y = _target_coordinates(flow_forward)
    error = np.linalg.norm(flow_forward + warp(flow_backward, flow_forward), axis=-1)
    tolerance = FB_TOLERANCE_PX + FB_TOLERANCE_PER_PX * np.linalg.norm(flow_forward, axis=-1)
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return np.asarray(inside * np.exp(-np.square(error / tolerance)), np.float32)


def _target_coordinates(flow: Pixels) -> tuple[Pixels, Pixels]:
    y, x = np.mgrid[:flow.shape[0], :flow.shape[1]].astype(np.float32)
    return x + flow[..., 0], y + flow[..., 1]
