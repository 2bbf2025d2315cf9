# SPDX-License-Identifier: GPL-3.0-or-later
"""Aligns frames of a shot, so that one frame's background can be compared with that of its neighbours.

Where the camera stands or turns, one homography aligns two frames. Where it travels, near things move more than far
ones, and optical flow aligns them, over fewer frames. `plate_estimates` calls it.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colour.srgb import LUMINANCE
from ..removal.inference.optical_flow import dense_flow, forward_backward_confidence, to_grey_codes, warp

Pixels = NDArray[np.float32]
Matrix = NDArray[np.float64]

TURNING_OFFSETS = (2, 4, 6, 9, 12, 16, 20, 25)
"""Distances in frames, before and after, of the neighbours of a frame, where the camera stands or turns: by then a
flare is elsewhere, a background is not."""
TRAVELLING_OFFSETS = (2, 4, 6, 8, 10, 12)
"""Distances in frames over which optical flow is reliable."""
FEATURES, MATCH_RATIO, MIN_INLIERS, MIN_INLIER_SHARE, MAX_ERROR_PX = 800, 0.8, 25, 0.4, 1.5
"""Features of a frame, ratio test, and what a homography between two frames needs; errors in pixels of the fit."""
PROBED_OFFSET, PROBES, TURNING_INLIER_SHARE = 6, 5, 0.57
"""Distance and approximate number of the pairs of frames that decide whether the camera travels, and the median share
of their matches that one homography has to explain if it does not."""
STANDING_PX = 0.1
"""Median motion of the matches, pixels, below which the camera stands."""
MIN_FLOW_CONFIDENCE = 0.4
"""Forward-backward confidence below which the flow of a pixel is not used."""


@dataclass(frozen=True)
class _Features:
    points: NDArray[np.float32]
    descriptors: Any


@dataclass(frozen=True)
class _Match:
    """A homography (3, 3) from one frame's pixels to another's, None where none fits, and its share of
    inliers, None with too few matches."""

    matrix: Matrix | None
    inlier_share: float | None


class Alignment:
    """The alignments between frames of a shot; each is computed once.

    pictures: frames by name, in the order of the shot, display values (height, width, 3), with little flare.
    """

    def __init__(self, pictures: Mapping[str, Pixels]) -> None:
        self._pictures, self._names = pictures, list(pictures)
        self._features: dict[str, _Features] = {}
        self._matches: dict[tuple[str, str], _Match] = {}
        self._flows: dict[tuple[str, str], Pixels] = {}
        self._codes: dict[str, NDArray[np.uint8]] = {}
        self.travels = self._camera_travels()
        """True if no homography aligns the frames."""

    def neighbours(self, name: str) -> Sequence[str]:
        """Return the frames that are compared with a frame."""
        index = self._names.index(name)
        return [self._names[other] for offset in (TRAVELLING_OFFSETS if self.travels else TURNING_OFFSETS)
                for other in (index - offset, index + offset) if 0 <= other < len(self._names)]

    def aligned(self, picture: Pixels, source: str, target: str) -> Pixels | None:
        """Return a picture of frame `source` as the camera of frame `target` would show it, NaN where it shows
        something else or nothing; None if the frames cannot be aligned."""
        import cv2

        if self.travels:
            flow, back = self._flow(target, source), self._flow(source, target)
            warped = warp(picture, flow)
            warped[forward_backward_confidence(flow, back) < MIN_FLOW_CONFIDENCE] = np.nan
            return warped
        matrix = self._match(source, target).matrix
        if matrix is None:
            return None
        height, width = picture.shape[:2]
        return np.asarray(cv2.warpPerspective(picture, matrix, (width, height), flags=cv2.INTER_LINEAR,
                                              borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,) * 3), np.float32)

    def _camera_travels(self) -> bool:
        """True if homographies explain too few matches of the probed pairs of frames, or no pair has enough matches;
        False for a shot that is too short for a pair."""
        pairs = list(zip(self._names, self._names[PROBED_OFFSET:], strict=False))
        probed = [self._match(*pair).inlier_share for pair in pairs[::max(len(pairs) // PROBES, 1)]]
        shares = [share for share in probed if share is not None]
        return bool(pairs) and (not shares or float(np.median(shares)) < TURNING_INLIER_SHARE)

    def _flow(self, source: str, target: str) -> Pixels:
        """Return the flow (height, width, 2) from a frame to another, pixels."""
        if (source, target) not in self._flows:
            for name in (source, target):
                if name not in self._codes:
                    self._codes[name] = to_grey_codes(self._pictures[name])
            self._flows[source, target] = dense_flow(self._codes[source], self._codes[target])
        return self._flows[source, target]

    def _match(self, source: str, target: str) -> _Match:
        """Return the match from a frame's pixels to another's; that of the reverse is its inverse."""
        if (source, target) not in self._matches:
            match = self._find_match(source, target)
            self._matches[source, target] = match
            inverse = None if match.matrix is None else np.linalg.inv(match.matrix)
            self._matches[target, source] = _Match(inverse, match.inlier_share)
        return self._matches[source, target]

    def _find_match(self, source: str, target: str) -> _Match:
        """Compute the homography from a frame's pixels to another's by matched features; the identity if the camera
        stands."""
        import cv2

        first, second = self._described(source), self._described(target)
        if min(len(first.points), len(second.points)) < MIN_INLIERS:
            return _Match(None, None)
        matches = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first.descriptors, second.descriptors, 2)
        pairs = [(near.queryIdx, near.trainIdx) for near, *other in matches
                 if other and near.distance < MATCH_RATIO * other[0].distance]
        if len(pairs) < MIN_INLIERS:
            return _Match(None, None)
        ends = first.points[[pair[0] for pair in pairs]], second.points[[pair[1] for pair in pairs]]
        cv2.setRNGSeed(0)  # RANSAC gives the same result each time
        matrix, inliers = cv2.findHomography(*ends, cv2.RANSAC, MAX_ERROR_PX)
        share = 0.0 if matrix is None else float(inliers.mean())
        if matrix is None or inliers.sum() < max(MIN_INLIERS, MIN_INLIER_SHARE * len(pairs)):
            return _Match(None, share)
        moved = np.abs(ends[1] - ends[0])[inliers[:, 0] > 0]
        stands = np.median(moved) < STANDING_PX
        return _Match(np.eye(3) if stands else np.asarray(matrix, np.float64), share)

    def _described(self, name: str) -> _Features:
        """Return the features of a frame: points (n, 2), pixels, and SIFT descriptors."""
        import cv2

        if name not in self._features:
            grey = np.clip(self._pictures[name] @ LUMINANCE * 255 + 0.5, 0, 255).astype(np.uint8)
            keys, descriptors = cv2.SIFT.create(FEATURES).detectAndCompute(grey, np.array([]))
            self._features[name] = _Features(np.array([key.pt for key in keys], np.float32).reshape(-1, 2), descriptors)
        return self._features[name]
