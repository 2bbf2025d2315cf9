# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds homographies between frames of a shot by matched features and RANSAC (Fischler & Bolles 1981).

A homography aligns two frames of a camera that stands or turns, and frames of what is far away. `core.lights` carries
static lights by it, and `core.fit` aligns plates.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..colour.srgb import LUMINANCE, Pixels
from .features import Features, detect_features, match_features

Matrix = NDArray[np.float64]

MAX_FEATURES, MIN_INLIERS, MAX_ERROR_PX = 800, 25, 1.5
"""Number of features of a frame, and what a homography between two frames needs; errors in pixels of the pictures."""
STANDING_PX = 0.1
"""Median motion of the matches, pixels, below which the camera stands."""


@dataclass(frozen=True)
class FrameMatch:
    """The match of two frames.

    matrix: homography (3, 3) from the first frame's pixels to the second's; None where none fits. inlier_share: share
    of the matched features that fit it; None with too few matches.
    """

    matrix: Matrix | None
    inlier_share: float | None


class HomographyMatcher:
    """The homographies between frames; features and matches are computed once.

    read: returns the picture of a frame by its name, display values (height, width, 3), all of one size.
    min_inlier_share: share of the matches that a homography has to explain.
    """

    def __init__(self, read: Callable[[str], Pixels], min_inlier_share: float) -> None:
        self._read, self._min_inlier_share = read, min_inlier_share
        self._features_by_name: dict[str, Features] = {}
        self._matches: dict[tuple[str, str], FrameMatch] = {}

    def match(self, source: str, target: str) -> FrameMatch:
        """Return the match from a frame's pixels to another's. The reverse match is its inverse. Both are cached."""
        if (source, target) not in self._matches:
            match = self._find_match(source, target)
            self._matches[source, target] = match
            inverse = None if match.matrix is None else np.linalg.inv(match.matrix)
            self._matches[target, source] = FrameMatch(inverse, match.inlier_share)
        return self._matches[source, target]

    def _find_match(self, source: str, target: str) -> FrameMatch:
        """Compute the homography from a frame's pixels to another's by SIFT, ratio test and RANSAC; the identity if the
        camera stands."""
        import cv2

        first, second = self._features(source), self._features(target)
        if min(len(first.positions), len(second.positions)) < MIN_INLIERS:
            return FrameMatch(None, None)
        pairs = match_features(first, second)
        if len(pairs) < MIN_INLIERS:
            return FrameMatch(None, None)
        ends = first.positions[pairs[:, 0]], second.positions[pairs[:, 1]]
        cv2.setRNGSeed(0)  # RANSAC gives the same result each time
        matrix, inliers = cv2.findHomography(*ends, cv2.RANSAC, MAX_ERROR_PX)
        share = 0.0 if matrix is None else float(inliers.mean())
        if matrix is None or inliers.sum() < max(MIN_INLIERS, self._min_inlier_share * len(pairs)):
            return FrameMatch(None, share)
        motion = np.abs(ends[1] - ends[0])[inliers[:, 0] > 0]
        stands = np.median(motion) < STANDING_PX
        return FrameMatch(np.eye(3) if stands else np.asarray(matrix, np.float64), share)

    def _features(self, name: str) -> Features:
        """Return the features of a frame, cached."""
        if name not in self._features_by_name:
            grey = np.clip(self._read(name) @ LUMINANCE * 255 + 0.5, 0, 255).astype(np.uint8)
            self._features_by_name[name] = detect_features(grey, MAX_FEATURES)
        return self._features_by_name[name]


def apply_homography(matrix: Matrix, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (n, 2) under a homography (3, 3), pixels; NaN for points that are behind the target's camera, if
    the pixel (0, 0) is before it."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ (matrix / matrix[2, 2]).T
    depth = np.where(mapped[:, 2:] > 0, mapped[:, 2:], np.nan)
    return np.asarray(mapped[:, :2] / depth)
