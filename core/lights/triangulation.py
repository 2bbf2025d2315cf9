# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangulates lights from detections in many views.

Every pair of detections proposes a place, finite and at infinity, and the detections near its projections score it
(`candidates.py`). The best is refined (`refinement.py`), its detections are removed, and so on until no place has
enough views; `merging.py` then removes duplicates and ghosts. Highlights on glossy surfaces move from view to view, so
few views agree on a place for them. Such agreement can be chance. The number of false alarms measures that (a contrario
detection, Desolneux, Moisan and Morel 2000): the number of pairs of detections, times the probability that so many of
the other views have a detection at the place by chance.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..capture.camera import Camera, Floats
from .candidates import Candidates
from .detection import Detection
from .found_light import FAR, FoundLight
from .merging import merge_duplicates, remove_ghosts
from .observations import Observations
from .refinement import parametrise, refine_until_stable

MAX_FAILURES = 6
"""Number of successive places with too few views after which the search ends."""
MAX_REJECTED = 16
"""Number of rejected candidates after which new ones are proposed."""


@dataclass(frozen=True)
class TriangulationSettings:
    """Bounds of the search.

    tolerance: of a projection, as a share of the frame's diagonal, to which half the light's radius is added.
    min_views: number of views that must show a light.
    max_nfa: largest number of false alarms of a light.
    min_share: share of the views with the light's place in frame, hidden or not, that must show it.
    allow_out_of_frame: count views with the place out of frame as well, as ghosts claim it.
    max_lights: number of lights at which the search ends.
    max_candidates: places tried, each where a pair of rays meets; all of them where there are fewer.
    seed: of the random choice of pairs and candidates.
    """

    tolerance: float = 0.006
    min_views: int = 3
    max_nfa: float = 0.02
    min_share: float = 0.15
    allow_out_of_frame: bool = False
    max_lights: int = 32
    max_candidates: int = 3000
    seed: int = 0


def triangulate_lights(views: Sequence[tuple[str, Camera]], detections: Sequence[Sequence[Detection]], extent: float,
                       settings: TriangulationSettings | None = None) -> list[FoundLight]:
    """Find lights from the detections of each view, best supported first.

    The best candidate place is refined and its detections are removed, until no place has enough views; then duplicates
    and ghosts are removed. extent: size of the cameras' path, world units.
    """
    settings = settings or TriangulationSettings()
    observations = Observations.of(views, detections, settings.tolerance)
    rng = np.random.default_rng(settings.seed)
    remaining = np.ones(len(observations.view), bool)
    lights: list[FoundLight] = []
    failures, candidates = 0, Candidates(observations, remaining, rng, settings.max_candidates)
    while remaining.sum() >= settings.min_views and failures < MAX_FAILURES and len(lights) < settings.max_lights:
        place = candidates.best(remaining)
        if place is None:
            break
        place, inliers, covariance = refine_until_stable(observations, place, remaining, extent)
        if len(np.unique(observations.view[inliers])) < settings.min_views:
            # If rejected candidates have removed detections since the list was made, a new list may have better places.
            if not candidates.rejected:
                # The place's detections are removed, or the search would find it again without end.
                remaining[observations.inliers(place, remaining)] = False
                failures += 1
            candidates = Candidates(observations, remaining, rng, settings.max_candidates)
            continue
        light = _to_light(observations, place, inliers, covariance, extent, settings.allow_out_of_frame)
        remaining[inliers] = False
        accepted = light.nfa <= settings.max_nfa and len(light.support) >= settings.min_share * light.visible
        if accepted:
            lights.append(light)
            failures = 0
        candidates.rejected += not accepted
        if accepted or candidates.rejected == MAX_REJECTED:
            candidates = Candidates(observations, remaining, rng, settings.max_candidates)
    return remove_ghosts(merge_duplicates(lights, views, extent), views)


def _to_light(observations: Observations, place: Floats, inliers: NDArray[np.int64], covariance: Floats, extent: float,
              allow_out_of_frame: bool) -> FoundLight:
    """Return a refined place (4,) with its covariance (3, 3) and inliers as a light.

    covariance: of two angles of the direction, radians, and the inverse distance. extent: size of the cameras' path,
    world units. allow_out_of_frame: the number of visible views
    includes those that have the place out of frame, if it is in front of the camera.
    """
    view = observations.view[inliers]
    origin, direction, inverse = parametrise(observations, place, inliers)
    spread = float(np.sqrt(covariance[2, 2]))
    # Far: infinity lies within two standard deviations, and the estimate itself is farther than 20 extents.
    far = inverse - 2 * spread <= 0 and inverse * extent < 0.05
    angle = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    if far:
        xyz, uncertainty = origin + FAR * extent * direction, float(np.degrees(angle))  # degrees
    else:
        xyz = origin + direction / inverse
        # World units. Errors of the inverse distance (d(1/x) = dx / x²) along the ray, and of the angle across it.
        uncertainty = max(spread / inverse ** 2, angle / inverse)
    homogeneous = np.array([[*(direction if far else xyz), 0.0 if far else 1.0]])
    pixels, front = observations.project(homogeneous)
    in_frame = front[0] & (allow_out_of_frame | ((pixels[0] >= 0) & (pixels[0] <= observations.size)).all(axis=1))
    distance = np.linalg.norm(pixels[0, view] - observations.pixel[inliers], axis=1)
    colour = np.median(np.array([observations.detection[i].colour for i in inliers]), axis=0)
    support = tuple(sorted({observations.names[v] for v in view}))
    visible = int(max(in_frame.sum(), len(support)))
    radius = float(np.median([observations.detection[i].radius for i in inliers]))
    return FoundLight(xyz, far, support, visible, float(np.median(distance)), uncertainty,
                      colour / max(float(colour.max()), 1e-6), radius, _nfa(observations, len(support), visible),
                      detections=tuple((observations.names[observations.view[i]], observations.detection[i])
                                       for i in inliers))


def _nfa(observations: Observations, support: int, visible: int) -> float:
    """Return the number of false alarms: how many places with `support` of `visible` views chance is expected to give.

    Every pair of detections claims a place, on which its two views agree by construction. Each other view has a
    detection within tolerance of the place with a small probability: the part of its frame that the tolerances of its
    detections cover, here the mean over the views.
    """
    area = observations.size.prod(axis=1)
    cover = np.pi * observations.tolerance ** 2 / area[observations.view]
    probability = min(float(np.bincount(observations.view, cover, len(observations.cameras)).mean()), 0.5)
    return math.comb(len(observations.view), 2) * binomial_tail(support - 2, visible - 2, probability)


def binomial_tail(successes: int, trials: int, probability: float) -> float:
    """Return the probability of at least `successes` in `trials` independent trials of this probability each.

    Computed in logarithms: from some 1030 trials on the binomial coefficients exceed floats.
    """
    if successes <= 0 or probability >= 1:
        return float(successes <= trials)
    if successes > trials or probability <= 0:
        return 0.0
    logs = [math.lgamma(trials + 1) - math.lgamma(k + 1) - math.lgamma(trials - k + 1)
            + k * math.log(probability) + (trials - k) * math.log1p(-probability)
            for k in range(successes, trials + 1)]
    largest = max(logs)
    return min(math.exp(largest) * math.fsum(math.exp(log - largest) for log in logs), 1.0)
