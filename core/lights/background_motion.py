# SPDX-License-Identifier: GPL-3.0-or-later
"""Carries a static light to the frames that do not show it, by the motion of the background, for `tracks`.

Where the camera turns, one homography maps the background of a frame to another frame, and a light that does not move
with it. So the light's place is known in frames in which it is hidden, out, or outside the frame. Whether a light is
static is tested on the frames that show it.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ..capture import Capture
from ..capture.camera import Floats
from ..colour.srgb import Pixels
from ..images.homographies import HomographyMatcher, apply_homography

WORKING_WIDTH, MIN_INLIER_SHARE = 480, 0.2
"""Largest width of the pictures that are matched, pixels, and the share of their matches that a homography has to
explain: fewer than elsewhere, for repeated patterns match wrongly, and the light itself is a test."""
TEST_OFFSET, TEST_PAIRS, MIN_TEST_PAIRS = 6, 12, 3
"""Distance in frames, approximate number and smallest number of the pairs of frames by which a light is tested."""
STATIC_ERROR = 0.004
"""Largest median distance of a static light from the place to which the background carries it, diagonals."""
MIN_MOTION = 0.012
"""Median motion of the background between the tested frames, diagonals, below which the test says nothing."""
CARRYING_FRAMES, MAX_OFFSET = 3, 25
"""Number of measured frames from which a place is carried, and their largest distance in frames."""


class CarriedPlace(NamedTuple):
    """A place (2,) on the picture and its expected error, pixels of the frame."""

    xy: Floats
    error: float


class BackgroundMotion:
    """The motion of the background between the frames of a shot; a match is computed when it is first needed."""

    def __init__(self, capture: Capture) -> None:
        """Prepare the matcher. capture: its frames are read, at a small size, when a match first needs them."""
        self._views = capture.views
        width, height = self._views[0].camera.size
        self._scale = min(WORKING_WIDTH / width, 1.0)
        self._diagonal = float(np.hypot(width, height))
        size = max(round(width * self._scale), 1), max(round(height * self._scale), 1)
        by_name = {view.name: view for view in self._views}

        def read(name: str) -> Pixels:
            return np.asarray(capture.frame(by_name[name], size).display(), np.float32)

        self._matcher = HomographyMatcher(read, MIN_INLIER_SHARE)

    def carry(self, frames: Sequence[int], places: Floats, targets: Iterable[int]) -> dict[int, CarriedPlace]:
        """Return the places of a light in target frames to which homographies carry it; none for a moving light.

        Each is the median of the places carried from the CARRYING_FRAMES nearest frames that show the light.

        frames: indices of the frames that show the light, ascending. places: (n, 2), pixels.
        """
        targets = list(targets)
        residual = self._static_residual(frames, places) if targets else None
        if residual is None:
            return {}
        carried = {}
        for target in targets:
            nearest = sorted(range(len(frames)), key=lambda index: abs(frames[index] - target))[:CARRYING_FRAMES]
            estimates = [place for index in nearest if abs(frames[index] - target) <= MAX_OFFSET
                         and (place := self._carry_place(frames[index], target, places[index])) is not None]
            if estimates:
                place = np.median(estimates, axis=0)
                spread = float(np.median(np.linalg.norm(np.array(estimates) - place, axis=1)))
                carried[target] = CarriedPlace(place, max(residual, spread))
        return carried

    def _static_residual(self, frames: Sequence[int], places: Floats) -> float | None:
        """Return the median distance, pixels, of a light from the place to which the background carries it from another
        frame; None if the light moves, or if too few frames or too little motion of the background decide it.

        frames, places: as for `carry`."""
        partners = [(index, int(np.searchsorted(frames, frame + TEST_OFFSET))) for index, frame in enumerate(frames)]
        pairs = [(index, other) for index, other in partners
                 if other < len(frames) and frames[other] - frames[index] <= MAX_OFFSET]
        residuals, motions = [], []
        for index, other in pairs[::max(len(pairs) // TEST_PAIRS, 1)]:
            place = self._carry_place(frames[index], frames[other], places[index])
            if place is not None:
                residuals.append(float(np.linalg.norm(place - places[other])))
                motions.append(float(np.linalg.norm(place - places[index])))
        if len(residuals) < MIN_TEST_PAIRS or np.median(motions) < MIN_MOTION * self._diagonal:
            return None
        residual = float(np.median(residuals))
        return residual if residual <= STATIC_ERROR * self._diagonal else None

    def _carry_place(self, source: int, target: int, place: Floats) -> Floats | None:
        """Return where the background at a place (2,) of a frame lies in another frame; None if no homography fits."""
        matrix = self._matcher.match(self._views[source].name, self._views[target].name).matrix
        if matrix is None:
            return None
        projected = apply_homography(matrix, np.asarray(place)[None] * self._scale)[0] / self._scale
        return projected if np.isfinite(projected).all() else None
