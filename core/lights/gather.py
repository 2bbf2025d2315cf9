# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights in 3D from detections in many views.

Every pair of detections proposes a place, finite and at infinity; a place is worth the detections near its
projections. The best is refined, its detections are taken away, and so on until nothing has enough views.
What slides over the views, as highlights on glossy things do, finds no place that many views agree on; what
agrees in so few that it may be an accident is told by the expected number of accidents (a contrario, Desolneux,
Moisan and Morel 2000): pairs tried, times the chance that so many more of the other views have a detection there.

A place is held as direction and inverse distance from the middle of the cameras that see it (Civera et
al. 2008), so that the sun is no special case: its inverse distance is zero within its uncertainty, and it is
put far away in its direction.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..capture.camera import Camera, Floats
from .detection import Detection

FAR = 1000.0      # distance of a far light, in extents of the cameras' path
STEPS = 20
PAIRS = 60000     # of rays tested for meeting
MANY = 20         # times PAIRS; of more pairs than these no list is made
DRAWS = 8         # of twice PAIRS, after which those that came are enough
PATIENCE = 6      # places of too few views in a row, after which there is nothing left
USES = 16         # refused places, after which others are proposed
AT_ONCE = 512     # places whose worth is found together: memory is theirs times the detections
FEW = 32          # of them once each has a bound


@dataclass(frozen=True)
class GatherSettings:
    """tolerance: of a projection, as a share of the frame's diagonal, to which half the source's radius is added;
    min_views: fewer do not make a light; accidents: as many expected by chance are allowed at most;
    min_share: of the views that have its place in frame, hidden or not, so many must show a light;
    anywhere: a light may be seen out of frame too, as ghosts claim it; most: lights at most;
    tries: places tried, each where a pair of rays meets, all of them where there are fewer; seed: of their choice."""

    tolerance: float = 0.006
    min_views: int = 3
    accidents: float = 0.02
    min_share: float = 0.15
    anywhere: bool = False
    most: int = 32
    tries: int = 3000
    seed: int = 0


@dataclass(frozen=True, eq=False)
class FoundLight:
    """A light in 3D.

    xyz: (3,) world. far: only its direction is known, and xyz lies FAR extents away in it.
    support: names of the views that show it; visible: how many views have it in frame.
    residual: median distance in pixels of detections from its projections.
    uncertainty: one standard deviation, scene units along the worst direction; degrees of direction where far.
    accidents: how many places of this support chance alone would give.
    colour: (3,) linear, largest channel 1. radius: median of its detections, pixels. how: where it is from.
    """

    xyz: Floats
    far: bool
    support: tuple[str, ...]
    visible: int
    residual: float
    uncertainty: float
    colour: Floats
    radius: float
    accidents: float = 0.0
    how: str = "triangulated"
    detections: tuple[tuple[str, Detection], ...] = field(default=(), repr=False)


@dataclass(eq=False)
class _Sightings:
    """All detections as arrays: view number (d,), pixel (d, 2), tolerance (d,) px, worth (d,), ray (d, 3)."""

    cameras: list[Camera]
    names: list[str]
    view: NDArray[np.int64]
    pixel: Floats
    tolerance: Floats
    worth: Floats
    ray: Floats
    detection: list[Detection]

    def __post_init__(self) -> None:
        self.rotation = np.array([camera.world_to_camera[:3, :3] for camera in self.cameras])
        self.position = np.array([camera.position for camera in self.cameras])
        self.focal = np.array([(camera.fx, camera.fy) for camera in self.cameras])
        self.centre = np.array([(camera.cx, camera.cy) for camera in self.cameras])
        self.size = np.array([camera.size for camera in self.cameras], np.float64)

    def project(self, places: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Homogeneous places (n, 4) to pixels (n, v, 2) in every view, and whether they lie in front."""
        local = np.einsum("vij,nvj->nvi", self.rotation, places[:, None, :3] - places[:, None, 3:] * self.position)
        front = local[..., 2] > 1e-9
        depth = np.where(front, local[..., 2], 1.0)[..., None]
        return local[..., :2] / depth * self.focal + self.centre, front


def gather(views: Sequence[tuple[str, Camera]], detections: Sequence[Sequence[Detection]], extent: float,
           settings: GatherSettings | None = None) -> list[FoundLight]:
    """Lights from the detections of each view, best supported first.

    `extent` is the size of the cameras' path (`Capture.extent`), the unit of what counts as far.
    """
    settings = settings or GatherSettings()
    seen = _sightings(views, detections, settings.tolerance)
    rng = np.random.default_rng(settings.seed)
    open_ = np.ones(len(seen.view), bool)
    found: list[FoundLight] = []
    failures, proposed = 0, _Proposed(seen, open_, rng, settings.tries)
    while open_.sum() >= settings.min_views and failures < PATIENCE and len(found) < settings.most:
        place = proposed.best(open_)
        if place is None:
            break
        place, inliers, covariance = _settled(seen, place, open_, extent)
        if len(np.unique(seen.view[inliers])) < settings.min_views:
            if not proposed.uses:
                open_[_near(seen, place, open_)] = False  # spent, or the search would find it for ever
                failures += 1
            proposed = _Proposed(seen, open_, rng, settings.tries)
            continue
        light = _light(seen, place, inliers, covariance, extent, settings.anywhere)
        open_[inliers] = False
        taken = light.accidents <= settings.accidents and len(light.support) >= settings.min_share * light.visible
        if taken:
            found.append(light)
            failures = 0
        proposed.uses += 1
        if taken or proposed.uses == USES:
            proposed = _Proposed(seen, open_, rng, settings.tries)
    return without_ghosts(merged(found, views, extent), views)


def _sightings(views: Sequence[tuple[str, Camera]], detections: Sequence[Sequence[Detection]],
               share: float) -> _Sightings:
    cameras = [camera for _, camera in views]
    flat = [(i, detection) for i, some in enumerate(detections) for detection in some]
    diagonal = np.array([np.hypot(*camera.size) for camera in cameras])
    view = np.array([i for i, _ in flat], np.int64)
    pixel = np.array([detection.xy for _, detection in flat], np.float64).reshape(-1, 2)
    ray = np.array([cameras[i].rays(detection.xy)[0] for i, detection in flat]).reshape(-1, 3)
    tolerance = np.array([share * diagonal[i] + 0.5 * detection.radius for i, detection in flat])
    # The centroid of what the frame's edge cuts is off, but better than nothing.
    worth = np.array([detection.score * (0.3 if detection.cut else 1.0) for _, detection in flat])
    return _Sightings(cameras, [name for name, _ in views], view, pixel, tolerance, worth, ray,
                      [detection for _, detection in flat])


class _Proposed:
    """Places where the rays of open detections meet, to be looked at from the best on.

    What is taken away from the open detections makes every place worth less or the same, so that a worth of before is
    a bound, and few have to be found anew (lazy greedy choice: Minoux 1978, "Accelerated greedy algorithms").
    """

    def __init__(self, seen: _Sightings, open_: NDArray[np.bool_], rng: np.random.Generator, tries: int) -> None:
        self.uses = 0
        self._seen = seen
        self._places = _meetings(seen, np.flatnonzero(open_ & (seen.worth > 0)), rng, tries)  # (n, 4)
        self._bounds = np.full(len(self._places), np.inf)

    def best(self, open_: NDArray[np.bool_]) -> Floats | None:
        """The place (4,) that the most open detections, by worth, agree on; None where there is none. `open_`: fewer
        from call to call."""
        index = np.flatnonzero(open_ & (self._seen.worth > 0))
        while len(self._places):
            at_once = AT_ONCE if np.isinf(self._bounds).any() else FEW
            some = np.argsort(-self._bounds, kind="stable")[:at_once]
            self._bounds[some] = _worth(self._seen, self._places[some], index)
            top = int(np.argmax(self._bounds))
            if top in some:
                return self._places[top] if self._bounds[top] > 0 else None
        return None


def _meetings(seen: _Sightings, index: NDArray[np.int64], rng: np.random.Generator, tries: int) -> Floats:
    """(n, 4), n at most `tries`: where the rays of two of the detections `index`, of two views, meet."""
    first, second = _pairs(seen, index, rng)
    places = np.concatenate([_crossing(seen, first, second), _direction(seen, first, second)])
    first, second = np.tile(first, 2), np.tile(second, 2)
    meet = np.flatnonzero(_on(seen, places, first) & _on(seen, places, second))
    if len(meet) > tries:
        meet = rng.choice(meet, tries, replace=False)
    return places[meet]


def _pairs(seen: _Sightings, index: NDArray[np.int64],
           rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """PAIRS at most of the detections `index`, each of two views, chosen by worth."""
    if math.comb(len(index), 2) > MANY * PAIRS:
        return _drawn_pairs(seen, index, rng)
    first, second = np.triu_indices(len(index), 1)
    first, second = index[first], index[second]
    apart = seen.view[first] != seen.view[second]
    first, second = first[apart], second[apart]
    if len(first) > PAIRS:
        worth = seen.worth[first] * seen.worth[second]
        chosen = rng.choice(len(first), PAIRS, replace=False, p=worth / worth.sum())
        first, second = first[chosen], second[chosen]
    return first, second


def _drawn_pairs(seen: _Sightings, index: NDArray[np.int64],
                 rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The same without a list of all pairs, which would fill the memory: drawn one detection beside the other, those
    that are of one view or were drawn before left out. Fewer where nearly all are of one view."""
    worth = seen.worth[index] / seen.worth[index].sum()
    keys = np.zeros(0, np.int64)
    for _ in range(DRAWS):
        drawn = np.sort(index[rng.choice(len(index), (2 * PAIRS, 2), p=worth)], axis=1)
        drawn = drawn[seen.view[drawn[:, 0]] != seen.view[drawn[:, 1]]]
        keys = np.concatenate([keys, drawn[:, 0] * len(seen.view) + drawn[:, 1]])
        keys = keys[np.sort(np.unique(keys, return_index=True)[1])]  # in the order in which they were drawn
        if len(keys) >= PAIRS:
            break
    first, second = np.divmod(keys[:PAIRS], len(seen.view))
    return first, second


def _on(seen: _Sightings, places: Floats, index: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each place (n, 4) falls on the detection of the same row, within its tolerance."""
    view = seen.view[index]
    local = np.einsum("nij,nj->ni", seen.rotation[view], places[:, :3] - places[:, 3:] * seen.position[view])
    front = local[:, 2] > 1e-9
    pixel = local[:, :2] / np.where(front, local[:, 2], 1.0)[:, None] * seen.focal[view] + seen.centre[view]
    return np.asarray(front & (((pixel - seen.pixel[index]) ** 2).sum(axis=1) < seen.tolerance[index] ** 2))


def _crossing(seen: _Sightings, first: NDArray[np.int64], second: NDArray[np.int64]) -> Floats:
    """(n, 4): the middle between the rays of two detections where they come nearest; parallel rays give zeros."""
    a, b = seen.position[seen.view[first]], seen.position[seen.view[second]]
    d, e = seen.ray[first], seen.ray[second]
    across, base = (d * e).sum(axis=1), b - a
    slant = 1.0 - across ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        s = ((base * d).sum(axis=1) - across * (base * e).sum(axis=1)) / slant
        t = (across * (base * d).sum(axis=1) - (base * e).sum(axis=1)) / slant
        middle = 0.5 * (a + s[:, None] * d + b + t[:, None] * e)
    good = (slant > 1e-8) & (s > 0) & (t > 0)
    return np.concatenate([np.where(good[:, None], middle, 0.0), good[:, None].astype(float)], axis=1)


def _direction(seen: _Sightings, first: NDArray[np.int64], second: NDArray[np.int64]) -> Floats:
    """(n, 4): the direction between two rays, as a place at infinity."""
    mean = seen.ray[first] + seen.ray[second]
    return np.concatenate([mean / np.linalg.norm(mean, axis=1, keepdims=True), np.zeros((len(mean), 1))], axis=1)


def _worth(seen: _Sightings, places: Floats, index: NDArray[np.int64]) -> Floats:
    """What the open detections near each place's projections (n, 4) are worth, the nearest of a view counted,
    more the nearer it is."""
    pixels, front = seen.project(places)
    view = seen.view[index]
    off = np.zeros((len(places), len(index)))
    for axis in range(2):
        off += ((pixels[:, view, axis] - seen.pixel[index, axis]) / seen.tolerance[index]) ** 2
    gain = np.where(front[:, view] & (off < 1), seen.worth[index] * (1 - off), 0.0)
    # Detections come in the order of their views.
    starts = np.flatnonzero(np.diff(view, prepend=-1))
    return np.asarray(np.maximum.reduceat(gain, starts, axis=1).sum(axis=1))


def _near(seen: _Sightings, place: Floats, open_: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The open detections near the place's projections, one a view."""
    pixels, front = seen.project(place[None])
    off = np.linalg.norm(pixels[0, seen.view] - seen.pixel, axis=1) / seen.tolerance
    chosen: dict[int, int] = {}
    for i in np.flatnonzero(open_ & front[0, seen.view] & (off < 1)):
        view = int(seen.view[i])
        if view not in chosen or off[i] < off[chosen[view]]:
            chosen[view] = int(i)
    return np.array(sorted(chosen.values()), np.int64)


def _settled(seen: _Sightings, place: Floats, open_: NDArray[np.bool_],
             extent: float) -> tuple[Floats, NDArray[np.int64], Floats]:
    """The place (4,) refined on its detections until those stay the same; they, and the covariance (3, 3) of
    direction (two) and inverse distance."""
    inliers = _near(seen, place, open_)
    covariance = np.full((3, 3), np.inf)
    for _ in range(5):
        if len(inliers) < 2:
            break
        place, covariance = _refined(seen, place, inliers, extent)
        again = _near(seen, place, open_)
        if np.array_equal(again, inliers):
            break
        inliers = again
    return place, inliers, covariance


def _refined(seen: _Sightings, place: Floats, inliers: NDArray[np.int64], extent: float) -> tuple[Floats, Floats]:
    """Gauss-Newton on direction and inverse distance from the middle of the cameras, with Huber weights."""
    view = seen.view[inliers]
    middle = seen.position[view].mean(axis=0)
    offset = place[:3] - place[3] * middle
    length = float(np.linalg.norm(offset))
    direction, inverse = offset / length, float(place[3] / length)
    sigma = np.maximum(seen.tolerance[inliers] / 3, 0.5) / np.sqrt(np.maximum(seen.worth[inliers], 0.05))
    basis = _across(direction)
    information = np.eye(3)
    for _ in range(STEPS):
        residual, jacobian = _residuals(seen, inliers, middle, direction, inverse, basis)
        size = np.linalg.norm(residual, axis=1) / sigma
        weight = np.where(size < 1.5, 1.0, 1.5 / np.maximum(size, 1e-9)) / sigma ** 2
        information = np.einsum("nij,nik,n->jk", jacobian, jacobian, weight)
        # A weak pull towards infinity keeps the distance defined where the views hold none.
        information[2, 2] += (0.01 * extent) ** 2
        gradient = np.einsum("nij,ni,n->j", jacobian, residual, weight)
        gradient[2] += (0.01 * extent) ** 2 * inverse
        step = np.linalg.solve(information + 1e-12 * np.trace(information) * np.eye(3), -gradient)
        step[2] = np.clip(step[2], -0.5 * abs(inverse) - 0.05 / extent, 0.5 * abs(inverse) + 0.05 / extent)
        direction = direction + basis @ step[:2]
        direction /= np.linalg.norm(direction)
        basis = _across(direction)
        inverse = max(inverse + step[2], 0.0)
        if np.abs(step * (1, 1, extent)).max() < 1e-9:
            break
    residual, _ = _residuals(seen, inliers, middle, direction, inverse, basis)
    spread = max(float(np.mean((residual / sigma[:, None]) ** 2)), 0.1)
    covariance = np.linalg.inv(information) * spread
    return np.array([*(direction + inverse * middle), inverse]), covariance


def _residuals(seen: _Sightings, inliers: NDArray[np.int64], middle: Floats, direction: Floats, inverse: float,
               basis: Floats) -> tuple[Floats, Floats]:
    """Pixels off (n, 2), and their derivatives (n, 2, 3) by two angles and inverse distance."""
    view = seen.view[inliers]
    rotation, shift = seen.rotation[view], middle - seen.position[view]
    local = np.einsum("nij,nj->ni", rotation, direction + inverse * shift)
    depth = np.maximum(local[:, 2], 1e-9)
    residual = local[:, :2] / depth[:, None] * seen.focal[view] + seen.centre[view] - seen.pixel[inliers]
    by_local = np.zeros((len(view), 2, 3))
    by_local[:, 0, 0], by_local[:, 1, 1] = 1 / depth, 1 / depth
    by_local[:, :, 2] = -local[:, :2] / depth[:, None] ** 2
    by_local *= seen.focal[view][:, :, None]
    by_state = np.concatenate([rotation @ basis, np.einsum("nij,nj->ni", rotation, shift)[:, :, None]], axis=2)
    return residual, by_local @ by_state


def _across(direction: Floats) -> Floats:
    """(3, 2) two unit vectors at right angles to a direction and to each other."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)], axis=1)


def _light(seen: _Sightings, place: Floats, inliers: NDArray[np.int64], covariance: Floats, extent: float,
           anywhere: bool) -> FoundLight:
    view = seen.view[inliers]
    middle = seen.position[view].mean(axis=0)
    offset = place[:3] - place[3] * middle
    length = float(np.linalg.norm(offset))
    direction, inverse = offset / length, float(place[3] / length)
    spread = float(np.sqrt(covariance[2, 2]))
    # Far: infinity lies within two standard deviations, and nothing nearer than 20 extents is likelier.
    far = inverse - 2 * spread <= 0 and inverse * extent < 0.05
    angle = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    if far:
        xyz, uncertainty = middle + FAR * extent * direction, float(np.degrees(angle))
    else:
        xyz = middle + direction / inverse
        uncertainty = max(spread / inverse ** 2, angle / inverse)
    homogeneous = np.array([[*(direction if far else xyz), 0.0 if far else 1.0]])
    pixels, front = seen.project(homogeneous)
    in_frame = front[0] & (anywhere | ((pixels[0] >= 0) & (pixels[0] <= seen.size)).all(axis=1))
    off = np.linalg.norm(pixels[0, view] - seen.pixel[inliers], axis=1)
    colours = np.array([seen.detection[i].colour for i in inliers])
    colour = np.median(colours, axis=0)
    support = tuple(sorted({seen.names[v] for v in view}))
    visible = int(max(in_frame.sum(), len(support)))
    radius = float(np.median([seen.detection[i].radius for i in inliers]))
    return FoundLight(xyz, far, support, visible, float(np.median(off)), uncertainty,
                      colour / max(float(colour.max()), 1e-6), radius, _accidents(seen, len(support), visible),
                      detections=tuple((seen.names[seen.view[i]], seen.detection[i]) for i in inliers))


def _accidents(seen: _Sightings, support: int, visible: int) -> float:
    """How many places chance would give that `support` of `visible` views agree on: every pair of detections claims
    one, and each other view has one of its detections within its tolerance of it with a small probability."""
    area = seen.size.prod(axis=1)
    cover = np.pi * seen.tolerance ** 2 / area[seen.view]
    share = min(float(np.bincount(seen.view, cover, len(seen.cameras)).mean()), 0.5)
    return math.comb(len(seen.view), 2) * _at_least(support - 2, visible - 2, share)


def _at_least(least: int, tries: int, share: float) -> float:
    """The chance that so many of the tries succeed or more, each with probability `share`. In logarithms: of some 1030
    tries the binomial coefficients are larger than floats get."""
    if least <= 0 or share >= 1:
        return float(least <= tries)
    if least > tries or share <= 0:
        return 0.0
    logs = [math.lgamma(tries + 1) - math.lgamma(k + 1) - math.lgamma(tries - k + 1)
            + k * math.log(share) + (tries - k) * math.log1p(-share) for k in range(least, tries + 1)]
    largest = max(logs)
    return min(math.exp(largest) * math.fsum(math.exp(log - largest) for log in logs), 1.0)


def merged(lights: Sequence[FoundLight], views: Sequence[tuple[str, Camera]], extent: float) -> list[FoundLight]:
    """Without duplicates: of lights that most views show at one spot, the one with the most support stays, and
    takes the others' views."""
    kept: list[FoundLight] = []
    for light in sorted(lights, key=lambda light: -len(light.support)):
        for i, other in enumerate(kept):
            if _same(light, other, views, extent):
                support = tuple(sorted({*other.support, *light.support}))
                kept[i] = replace(other, support=support, visible=max(other.visible, len(support)),
                                  detections=other.detections + light.detections)
                break
        else:
            kept.append(light)
    return sorted(kept, key=lambda light: -len(light.support))


def without_ghosts(lights: Sequence[FoundLight], views: Sequence[tuple[str, Camera]]) -> list[FoundLight]:
    """Without those that are ghosts of a better supported light: in every frame at the same share mu of the way from
    the principal point p to that light l, g = p + mu (l - p), while l moves over the frame."""
    kept: list[FoundLight] = []
    cameras = dict(views)
    for light in sorted(lights, key=lambda light: -len(light.support)):
        if not any(_is_ghost(light, other, cameras) for other in kept):
            kept.append(light)
    return kept


def _is_ghost(light: FoundLight, other: FoundLight, cameras: dict[str, Camera]) -> bool:
    ghost, source, allowed = [], [], []
    for name, detection in light.detections:
        camera = cameras[name]
        pixel, depth = camera.project(other.xyz[None])
        if depth[0] > 0:
            centre = np.array([camera.cx, camera.cy])
            ghost.append(detection.xy - centre)
            source.append(pixel[0] - centre)
            allowed.append(0.006 * float(np.hypot(*camera.size)) + 0.25 * detection.radius)
    if len(ghost) < 3:
        return False
    g, s = np.array(ghost), np.array(source)
    share = float((g * s).sum() / (s * s).sum())
    off = np.linalg.norm(g - share * s, axis=1) / allowed
    moved = float(np.linalg.norm(np.ptp(g, axis=0))) / float(np.median(allowed))
    return bool(np.median(off) < 1 and moved > 8 and abs(share - 1) > 0.05)


def _same(light: FoundLight, other: FoundLight, views: Sequence[tuple[str, Camera]], extent: float) -> bool:
    """Whether two lights fall on one spot: as near as their sources are large, in most frames that show both, or
    in space within their uncertainty."""
    near = 0.02 * extent + 2 * (light.uncertainty + other.uncertainty)
    if not light.far and not other.far and np.linalg.norm(light.xyz - other.xyz) < min(near, 0.3 * extent):
        return True
    together = apart = 0
    for _, camera in views:
        (a, b), depth = camera.project([light.xyz, other.xyz])
        if (depth > 0).all() and camera.contains([a, b], depth).any():
            reach = light.radius + other.radius + 0.004 * np.hypot(*camera.size)
            together += bool(np.linalg.norm(a - b) < reach)
            apart += bool(np.linalg.norm(a - b) >= reach)
    return together > 2 * apart
