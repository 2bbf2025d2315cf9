# SPDX-License-Identifier: GPL-3.0-or-later
"""Aligns frames of a shot, so that one frame's background can be compared with that of its neighbours.

Where the camera stands or turns, one homography aligns two frames. Where it travels, near things move more than far
ones, and optical flow aligns them, over fewer frames. `plate_estimates` calls it.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..images.homographies import FrameMatch, HomographyMatcher
from ..removal.inference.optical_flow import dense_flow, forward_backward_confidence, to_grey_codes, warp

Pixels = NDArray[np.float32]

TURNING_OFFSETS = (2, 4, 6, 9, 12, 16, 20, 25)
"""Distances in frames, before and after, of the neighbours of a frame, where the camera stands or turns: by then a
flare is elsewhere, a background is not."""
TRAVELLING_OFFSETS = (2, 4, 6, 8, 10, 12)
"""Distances in frames over which optical flow is reliable."""
MIN_INLIER_SHARE = 0.4
"""Share of the matches that the homography between two frames has to explain."""
PROBED_OFFSET, PROBES, TURNING_INLIER_SHARE = 6, 5, 0.57
"""Distance and approximate number of the pairs of frames that decide whether the camera travels, and the median share
of their matches that one homography has to explain if it does not."""
MIN_FLOW_CONFIDENCE = 0.4
"""Forward-backward confidence below which the flow of a pixel is not used."""


class Alignment:
    """The alignments between frames of a shot; each is computed once.

    pictures: frames by name, in the order of the shot, display values (height, width, 3), with little flare.
    """

    def __init__(self, pictures: Mapping[str, Pixels]) -> None:
        self._pictures, self._names = pictures, list(pictures)
        self._matcher = HomographyMatcher(pictures.__getitem__, MIN_INLIER_SHARE)
        self._flows: dict[tuple[str, str], Pixels] = {}
        self._grey_codes: dict[str, NDArray[np.uint8]] = {}
        self.travels = self._camera_travels()
        """True if no homography aligns the frames."""
        self.stands = not self.travels and self._camera_stands()
        """True if the camera neither travels nor turns: frames need no alignment."""

    def neighbours(self, name: str) -> Sequence[str]:
        """Return the frames that are compared with a frame."""
        index = self._names.index(name)
        return [self._names[other] for offset in (TRAVELLING_OFFSETS if self.travels else TURNING_OFFSETS)
                for other in (index - offset, index + offset) if 0 <= other < len(self._names)]

    def align(self, picture: Pixels, source: str, target: str) -> Pixels | None:
        """Return a picture of frame `source`, (height, width, 3), warped to the camera of frame `target`.

        By optical flow if the camera travels, else by a homography. NaN where the source does not show what the target
        shows; None if no homography aligns the frames.
        """
        import cv2

        if self.travels:
            flow, backward_flow = self._dense_flow(target, source), self._dense_flow(source, target)
            warped = warp(picture, flow)
            warped[forward_backward_confidence(flow, backward_flow) < MIN_FLOW_CONFIDENCE] = np.nan
            return warped
        matrix = self._matcher.match(source, target).matrix
        if matrix is None:
            return None
        height, width = picture.shape[:2]
        return np.asarray(cv2.warpPerspective(picture, matrix, (width, height), flags=cv2.INTER_LINEAR,
                                              borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,) * 3), np.float32)

    def _probed_matches(self) -> list[FrameMatch]:
        """Return the matches of a few pairs of frames of the shot; none for a shot that is too short for a pair."""
        pairs = list(zip(self._names, self._names[PROBED_OFFSET:], strict=False))
        return [self._matcher.match(*pair) for pair in pairs[::max(len(pairs) // PROBES, 1)]]

    def _camera_travels(self) -> bool:
        """Return whether homographies explain too few matches of the probed pairs of frames, or no pair has enough
        matches; False for a shot that is too short for a pair."""
        matches = self._probed_matches()
        shares = [match.inlier_share for match in matches if match.inlier_share is not None]
        return bool(matches) and (not shares or float(np.median(shares)) < TURNING_INLIER_SHARE)

    def _camera_stands(self) -> bool:
        """Return whether all homographies of the probed pairs are the identity."""
        matrices = [match.matrix for match in self._probed_matches() if match.matrix is not None]
        return bool(matrices) and all(np.array_equal(matrix, np.eye(3)) for matrix in matrices)

    def _dense_flow(self, source: str, target: str) -> Pixels:
        """Return the flow (height, width, 2) from a frame to another, pixels."""
        if (source, target) not in self._flows:
            for name in (source, target):
                if name not in self._grey_codes:
                    self._grey_codes[name] = to_grey_codes(self._pictures[name])
            self._flows[source, target] = dense_flow(self._grey_codes[source], self._grey_codes[target])
        return self._flows[source, target]
