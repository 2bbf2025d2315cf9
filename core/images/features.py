# SPDX-License-Identifier: GPL-3.0-or-later
"""Detects and matches SIFT features of two pictures (Lowe 2004).

`homographies` aligns frames by the matches, and `core.fit` triangulates 3D points from them.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MATCH_RATIO = 0.8
"""Ratio of the distances to the nearest and the second nearest descriptor up to which a match counts."""


@dataclass(frozen=True)
class Features:
    """Positions (n, 2) of features, pixels with the centre of the first pixel at (0, 0), and descriptors (n, 128)."""

    positions: NDArray[np.float32]
    descriptors: NDArray[np.uint8]


def detect_features(grey: NDArray[np.uint8], max_count: int) -> Features:
    """Return the SIFT features of a picture (height, width), about `max_count` with the most contrast."""
    import cv2

    keypoints, descriptors = cv2.SIFT.create(max_count).detectAndCompute(grey, np.array([]))
    positions = np.array([keypoint.pt for keypoint in keypoints], np.float32).reshape(-1, 2)
    # SIFT's values are whole numbers up to 255; of a picture without features there are none.
    codes = np.zeros((0, 128), np.uint8) if descriptors is None else descriptors.astype(np.uint8)
    return Features(positions, codes)


def match_features(first: Features, second: Features, *, mutual: bool = False) -> NDArray[np.int64]:
    """Return (n, 2) indices of the features of two pictures that match, by Lowe's ratio test.

    A feature of `first` matches the feature of `second` with the nearest descriptor if its distance is less than
    MATCH_RATIO times that of the second nearest. mutual: of all descriptors in `first`, that of the feature also has to
    be the nearest to that of its match.
    """
    import cv2

    if min(len(first.positions), len(second.positions)) < 2:  # the ratio test needs a second nearest
        return np.zeros((0, 2), np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    pairs = [(nearest.queryIdx, nearest.trainIdx)
             for nearest, second_nearest in matcher.knnMatch(first.descriptors, second.descriptors, 2)
             if nearest.distance < MATCH_RATIO * second_nearest.distance]
    if mutual:
        backward = {nearest.queryIdx: nearest.trainIdx
                    for nearest in matcher.match(second.descriptors, first.descriptors)}
        pairs = [pair for pair in pairs if backward.get(pair[1]) == pair[0]]
    return np.array(pairs, np.int64).reshape(-1, 2)
