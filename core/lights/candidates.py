# SPDX-License-Identifier: GPL-3.0-or-later
"""Candidate places of lights: where the rays of two detections of different views meet, near or at infinity.

`triangulation.py` takes the best candidate, refines it and removes its detections, until none has enough views.
"""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..capture.camera import Floats, triangulate_midpoints
from .observations import Observations

MAX_PAIRS = 60000
"""Pairs of rays tested for an intersection."""
MAX_LISTED_PAIRS = 20 * MAX_PAIRS
"""Number of pairs above which they are drawn at random instead of listed."""
MAX_DRAWS = 8
"""Bound of the rounds, each of twice MAX_PAIRS draws, in search of distinct pairs."""
FIRST_BATCH = 512
"""Candidates scored together: memory is this times the number of detections."""
BATCH = 32
"""Candidates scored together once each has an upper bound."""
MIN_SQUARED_SINE = 1e-8
"""Squared sine of the angle between two rays up to which they are parallel."""


class Candidates:
    """Candidate places in the order of their scores over the remaining detections.

    Removing detections can only lower a score, so an earlier score is an upper bound and few candidates need a new one
    (lazy greedy choice: Minoux 1978, "Accelerated greedy algorithms").
    """

    def __init__(self, observations: Observations, remaining: NDArray[np.bool_], rng: np.random.Generator,
                 max_candidates: int) -> None:
        self.rejected = 0
        """Candidates taken from here that made no light."""
        self._observations = observations
        self._places = _intersections(observations, np.flatnonzero(remaining & (observations.weight > 0)), rng,
                                      max_candidates)  # (n, 4)
        self._bounds = np.full(len(self._places), np.inf)

    def best(self, remaining: NDArray[np.bool_]) -> Floats | None:
        """Return the place (4,) with the highest score over the remaining detections; None if no score is above 0.

        remaining: (d,), true for those detections; from call to call none may be added.
        """
        index = np.flatnonzero(remaining & (self._observations.weight > 0))
        while len(self._places):
            size = FIRST_BATCH if np.isinf(self._bounds).any() else BATCH
            batch = np.argsort(-self._bounds, kind="stable")[:size]
            self._bounds[batch] = self._observations.scores(self._places[batch], index)
            top = int(np.argmax(self._bounds))
            if top in batch:  # its score is new, and no other's upper bound is higher
                return self._places[top] if self._bounds[top] > 0 else None
        return None


def _intersections(observations: Observations, index: NDArray[np.int64], rng: np.random.Generator,
                   max_candidates: int) -> Floats:
    """Return (n, 4), at most `max_candidates` homogeneous places where the rays of two detections meet.

    Rays meet at a place, finite or at infinity, that projects within tolerance of both detections. index: detections
    whose rays are paired.
    """
    first, second = _choose_pairs(observations, index, rng)
    places = np.concatenate([_triangulate(observations, first, second), _at_infinity(observations, first, second)])
    first, second = np.tile(first, 2), np.tile(second, 2)
    meet = np.flatnonzero(observations.is_inlier(places, first) & observations.is_inlier(places, second))
    if len(meet) > max_candidates:
        meet = rng.choice(meet, max_candidates, replace=False)
    return places[meet]


def _choose_pairs(observations: Observations, index: NDArray[np.int64],
                  rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Choose pairs of the detections `index` from different views: all, or MAX_PAIRS at random by their weights.

    Returns the indices of the first and of the second detection of each pair, (n,) each.
    """
    if math.comb(len(index), 2) > MAX_LISTED_PAIRS:
        return _draw_pairs(observations, index, rng)
    first, second = np.triu_indices(len(index), 1)
    first, second = index[first], index[second]
    differ = observations.view[first] != observations.view[second]
    first, second = first[differ], second[differ]
    if len(first) > MAX_PAIRS:
        weight = observations.weight[first] * observations.weight[second]
        chosen = rng.choice(len(first), MAX_PAIRS, replace=False, p=weight / weight.sum())
        first, second = first[chosen], second[chosen]
    return first, second


def _draw_pairs(observations: Observations, index: NDArray[np.int64],
                rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Draw MAX_PAIRS pairs at random by their weights, without a list of all pairs, which would fill the memory.

    Pairs within one view and repeated pairs are dropped, so there are fewer where nearly all detections are of one
    view. index: the detections to pair. Returns as `_choose_pairs` does.
    """
    weight = observations.weight[index] / observations.weight[index].sum()
    keys = np.zeros(0, np.int64)
    for _ in range(MAX_DRAWS):
        drawn = np.sort(index[rng.choice(len(index), (2 * MAX_PAIRS, 2), p=weight)], axis=1)
        drawn = drawn[observations.view[drawn[:, 0]] != observations.view[drawn[:, 1]]]
        # One number for each pair, from which np.divmod below restores both indices.
        keys = np.concatenate([keys, drawn[:, 0] * len(observations.view) + drawn[:, 1]])
        keys = keys[np.sort(np.unique(keys, return_index=True)[1])]  # in the order of drawing
        if len(keys) >= MAX_PAIRS:
            break
    first, second = np.divmod(keys[:MAX_PAIRS], len(observations.view))
    return first, second


def _triangulate(observations: Observations, first: NDArray[np.int64], second: NDArray[np.int64]) -> Floats:
    """Return (n, 4), the midpoint of the shortest segment between the two rays of each pair, with w = 1.

    first, second: indices (n,) of the detections. All zeros for rays that are parallel, or whose nearest points lie
    behind a camera.
    """
    origins, other_origins = (observations.position[observations.view[index]] for index in (first, second))
    midpoints, cosines, is_in_front = triangulate_midpoints(origins, observations.ray[first],
                                                            other_origins, observations.ray[second])
    valid = is_in_front & (1 - cosines ** 2 > MIN_SQUARED_SINE)
    return np.concatenate([np.where(valid[:, None], midpoints, 0.0), valid[:, None].astype(float)], axis=1)


def _at_infinity(observations: Observations, first: NDArray[np.int64], second: NDArray[np.int64]) -> Floats:
    """Return (n, 4), the mean direction of two rays, as a place at infinity."""
    mean = observations.ray[first] + observations.ray[second]
    return np.concatenate([mean / np.linalg.norm(mean, axis=1, keepdims=True), np.zeros((len(mean), 1))], axis=1)
