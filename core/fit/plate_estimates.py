# SPDX-License-Identifier: GPL-3.0-or-later
"""Improves the plates of a shot by what neighbouring frames show of the same background.

The removal network cleans each frame by itself, and errs differently in each. Where the background stands still, or the
camera only turns, other frames show it without flare. So every frame is compared with the median of its neighbours'
plates, each aligned to it by a homography. In a small window a local line, frame = gain * background + flare, separates
the two: a flare adds light that does not depend on the background's texture, and light on the walls changes the gain.
Where the background has no texture, or something hides it, nothing is certain, and the network's plate stays.

`plate_trainer` calls it before a fit, and a few times during it with the fitted flare subtracted from the neighbours.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colour.srgb import LUMINANCE, linear_from_srgb, srgb_from_linear

Pixels = NDArray[np.float32]
Matrix = NDArray[np.float64]

NEIGHBOUR_OFFSETS = (2, 4, 6, 9, 12, 16, 20, 25)
"""Distances in frames, before and after, of the neighbours of a plate: by then a flare is elsewhere, a background is
not."""
WINDOW_SHARE = 0.02
"""Standard deviation of the window of the local line, as a share of the frame's width."""
NOISE = 0.004
"""Noise of display values, as a standard deviation."""
GAIN_TOLERANCE = 0.3
"""Deviation of the local gain from 1 at which a background counts as half certain: light on it changes the gain."""
FEATURES, MATCH_RATIO, MIN_INLIERS, MIN_INLIER_SHARE, MAX_ERROR_PX = 800, 0.8, 25, 0.4, 1.5
"""Features of a frame, ratio test, and what a homography between two frames needs; errors in pixels of the fit."""
SMOOTHING_SHARE = 0.006
"""Standard deviation, as a share of the frame's width, by which differences from a plate are smoothed: those of aligned
frames have both signs at every edge, those of a flare have one."""
MIN_EXCESS = 0.006
"""Largest difference that is no flare, display values."""


@dataclass(frozen=True)
class ShotFrames:
    """The frames and the network's plates of a shot by name, in order, display values (height, width, 3), one size."""

    frames: Mapping[str, Pixels]
    plates: Mapping[str, Pixels]

    @property
    def names(self) -> list[str]:
        """Names of the frames, in the order of the shot."""
        return list(self.frames)


@dataclass(frozen=True)
class _Features:
    points: NDArray[np.float32]
    descriptors: Any


class PlateEstimator:
    """Estimates plates of a shot; the alignments of its frames are computed once."""

    def __init__(self, shot: ShotFrames) -> None:
        self._shot = shot
        self._features: dict[str, _Features] = {}
        self._alignments: dict[tuple[str, str], Matrix | None] = {}

    def estimate(self, name: str, cleaned: Mapping[str, Pixels] | None = None) -> Pixels:
        """Return the plate of a frame, display values.

        cleaned: frames minus the fitted flare, which show the neighbours' background in place of the network's plates.
        The frame's own plate stays the network's: a flare subtracted from its own frame would grow.
        """
        shot = self._shot
        own, plates = shot.plates[name], shot.plates if cleaned is None else cleaned
        aligned = [warped for other in self._neighbours(name)
                   if (warped := self._aligned(plates[other], other, name)) is not None]
        if not aligned:
            return own
        stack = np.stack([plates[name], *aligned])
        with np.errstate(all="ignore"):
            background = np.nanmedian(stack, 0).astype(np.float32)
            count = np.isfinite(stack[..., 0]).sum(0)
        fitted, confidence = local_line(linear_from_srgb(shot.frames[name]),
                                        linear_from_srgb(np.nan_to_num(background)))
        confidence = confidence * np.clip((count - 1) / 3, 0, 1)[..., None].astype(np.float32)
        excess = _smooth(own - np.minimum(srgb_from_linear(fitted), shot.frames[name]), confidence)
        excess = np.sign(excess) * np.maximum(np.abs(excess) - MIN_EXCESS, 0)
        return np.asarray(np.clip(own - confidence * excess, 0, None), np.float32)

    def _neighbours(self, name: str) -> Sequence[str]:
        names = self._shot.names
        index = names.index(name)
        return [names[other] for offset in NEIGHBOUR_OFFSETS for other in (index - offset, index + offset)
                if 0 <= other < len(names)]

    def _aligned(self, plate: Pixels, source: str, target: str) -> Pixels | None:
        """Return a plate as the target frame's camera would show it, NaN beyond its edges; None if it cannot be
        aligned."""
        import cv2

        matrix = self._alignment(source, target)
        if matrix is None:
            return None
        height, width = plate.shape[:2]
        warped = cv2.warpPerspective(plate, matrix, (width, height), flags=cv2.INTER_LINEAR,
                                     borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,) * 3)
        return np.asarray(warped, np.float32)

    def _alignment(self, source: str, target: str) -> Matrix | None:
        """Return the homography (3, 3) from pixels of one frame to those of another; None where none fits."""
        if (source, target) not in self._alignments:
            matrix = self._match(source, target)
            self._alignments[source, target] = matrix
            self._alignments[target, source] = None if matrix is None else np.linalg.inv(matrix)
        return self._alignments[source, target]

    def _match(self, source: str, target: str) -> Matrix | None:
        import cv2

        first, second = self._described(source), self._described(target)
        if min(len(first.points), len(second.points)) < MIN_INLIERS:
            return None
        matches = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first.descriptors, second.descriptors, 2)
        pairs = [(near.queryIdx, near.trainIdx) for near, *other in matches
                 if other and near.distance < MATCH_RATIO * other[0].distance]
        if len(pairs) < MIN_INLIERS:
            return None
        ends = first.points[[pair[0] for pair in pairs]], second.points[[pair[1] for pair in pairs]]
        cv2.setRNGSeed(0)
        matrix, inliers = cv2.findHomography(*ends, cv2.RANSAC, MAX_ERROR_PX)
        if matrix is None or inliers.sum() < max(MIN_INLIERS, MIN_INLIER_SHARE * len(pairs)):
            return None
        moved = np.abs(ends[1] - ends[0])[inliers[:, 0] > 0]
        if np.median(moved) < 0.1:  # a camera that stands
            return np.eye(3)
        return np.asarray(matrix, np.float64)

    def _described(self, name: str) -> _Features:
        import cv2

        if name not in self._features:
            plate = self._shot.plates[name]
            grey = np.clip(plate @ LUMINANCE * 255 + 0.5, 0, 255).astype(np.uint8)
            keys, descriptors = cv2.SIFT.create(FEATURES).detectAndCompute(grey, np.array([]))
            self._features[name] = _Features(np.array([key.pt for key in keys], np.float32).reshape(-1, 2), descriptors)
        return self._features[name]


def _smooth(values: Pixels, weights: Pixels) -> Pixels:
    """Return the weighted means of values (height, width, 3) in a small window; weights (height, width, 1)."""
    import cv2

    sigma = max(SMOOTHING_SHARE * values.shape[1], 0.5)
    total = cv2.GaussianBlur(weights[..., 0], (0, 0), sigma)[..., None]
    return np.asarray(cv2.GaussianBlur(weights * values, (0, 0), sigma) / (total + 1e-3), np.float32)


def local_line(frame: Pixels, background: Pixels) -> tuple[Pixels, Pixels]:
    """Return gain * background (height, width, 3) of the local line frame = gain * background + flare, and how certain
    it is (height, width, 1), 0..1.

    frame, background: linear light. The channels share one gain. Where the background has little texture, the gain
    tends to 1; a gain far from 1 says that something hides the background.
    """
    import cv2

    sigma = max(WINDOW_SHARE * frame.shape[1], 1.0)

    def blur(values: Pixels) -> Pixels:
        return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma), np.float32)

    # Errors are those of display values: relative in bright parts.
    weight = 1 / (background.mean(-1, keepdims=True) + 0.02) ** 2
    total = blur(weight[..., 0])[..., None]
    mean_frame, mean_background = (blur(weight * values) / total for values in (frame, background))
    variance = (blur(weight * background**2) / total - mean_background**2).sum(-1).clip(0)
    covariance: Pixels = (blur(weight * frame * background) / total - mean_frame * mean_background).sum(-1)
    residual = (blur(weight * frame**2) / total - mean_frame**2).sum(-1).clip(0)
    noise = 3 * (NOISE * (mean_background.mean(-1) + 0.02) * 2.4) ** 2
    gain = (covariance + noise) / (variance + noise)
    explained = np.clip(gain, 0, 2) * covariance
    unexplained = (residual - explained).clip(0)
    texture = variance / (variance + 10 * noise)
    near_one = 1 / (1 + ((gain - 1) / GAIN_TOLERANCE) ** 4)
    fits = variance / (variance + 0.5 * unexplained + noise)
    confidence = np.asarray(texture * near_one * fits, np.float32)[..., None]
    return np.asarray(np.clip(gain, 0.5, 1.5)[..., None] * background, np.float32), confidence
