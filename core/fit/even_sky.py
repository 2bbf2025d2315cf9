# SPDX-License-Identifier: GPL-3.0-or-later
"""Segments the sky about a far light, such as the sun in an even sky, by seeded region growing. `far_layer` calls it.

An even sky has no contrast, so a sphere sweep cannot tell it from a white wall. A far light can: where a view shows it,
nothing near stands before it. So the pixels about it are a seed: the smooth bright region that they belong to is sky,
in each view that shows the light. The sky is propagated to the other views: there, a smooth region is sky if it has the
sky's colours in the sky's directions. Without a far light, nothing is sky: a plain wall indoors never is.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..capture import Camera
from .sweep_views import (
    Booleans,
    Floats,
    SweepView,
    Values,
    camera_centre,
    camera_spread,
    farthest_distance,
    nearest_indices,
    pixel_indices,
    project_sphere,
    visible_directions,
)

MAX_LIGHT_PARALLAX_PX = 2.0
"""Largest parallax of a far light over the spread of the cameras, pixels of the sweep's pictures."""
MIN_LIGHT_DISTANCE = 3.0
"""Smallest distance of a far light relative to that of the farthest points: in a small room, cameras close together
show no parallax of a lamp either."""
SEED_RADIUS, MIN_SEED_PX, MIN_SMOOTH_SHARE, MIN_SEED_SHARE = 0.03, 6, 0.5, 0.3
"""Radius of the seed about a far light, in frame widths, and how many of its pixels the frame must hold. If the view
shows the light, the first share of these is smooth and bright, and a region that covers the second share is sky. A
smaller region may be a wall beside the light."""
MAX_STEP = 0.04
"""Largest difference of neighbouring pixels of a smooth region, display values of any channel."""
MIN_LEVEL = 0.2
"""Smallest brightness about a light, display values of the largest channel: a darker sky cannot be told from ground."""
MIN_SEED_LEVEL, MIN_SKY_LEVEL = 0.7, 0.4
"""Smallest brightness relative to that about the light in the view where this is brightest: about the light in a view
that shows it, and of sky."""
MAX_POINT_SHARE = 0.02
"""Share of a region's pixels on which points of the solve lie, above which the region is a surface."""
CLOSING_PX = 5
"""Side of the square by which holes in the sky, such as birds and thin wires, are closed; pixels of the pictures."""
MIN_REGION, MIN_KNOWN_SHARE, MAX_DIFFERENCE = 12, 0.2, 0.2
"""Number of directions in a region that is compared with the known sky, the share of them that must be known as sky,
and the largest median difference of their colours, display values."""
MIN_VIEW_SHARE = 0.12
"""Share of the views that see a direction that must show sky there: something near may hide it in the others."""
MIN_SKY_SHARE = 0.02
"""Share of the directions in view that must be sky for a capture to have one."""
REACH, GROWTH = 0.1, 0.02
"""Radius of the gaps that are filled in the sky, and its growth at the edges, both in frame widths. In a gap, something
near hides the sky in all views of the sweep, but not in every other view. The sky also goes on for REACH beyond the
frames."""


@dataclass(frozen=True, eq=False)
class Sky:
    """The sky of a capture: which (n,) of the unit vectors `directions` (n, 3) are sky, and the pixels (height, width)
    that show it in each view of the sweep."""

    directions: Floats
    is_sky: Booleans
    masks: list[Booleans]

    def contains(self, directions: Floats) -> Booleans:
        """Return (m,) whether directions (m, 3) are sky."""
        return self.is_sky[nearest_indices(directions, self.directions)]


def select_far_lights(lights: Floats, points: Values, cameras: list[Camera]) -> Floats:
    """Return which lights (m, 3) are so far that they show no parallax and lie behind all the scene, world units.

    lights: (n, 3), places of static lights. points: (k, 3), those of the solve. cameras: those of the sweep.
    """
    centre = camera_centre(cameras)
    focal = max(camera.focal_length for camera in cameras)
    min_distance = max(focal * camera_spread(cameras) / MAX_LIGHT_PARALLAX_PX,
                       MIN_LIGHT_DISTANCE * farthest_distance(points, cameras))
    return lights[np.linalg.norm(lights - centre, axis=1) >= min_distance]


def segment_sky(views: Sequence[SweepView], lights: Floats, points: Values, pitch: float) -> Sky | None:
    """Return the sky about far lights (m, 3), world units; None if no view shows a light in an even sky.

    points: (k, 3), those of the solve. pitch: distance of neighbouring directions, radians.
    """
    seeds = [_light_seeds(view, lights) for view in views]
    brightest = max((seed.level for view_seeds in seeds for seed in view_seeds), default=0.0)
    if brightest < MIN_LEVEL:
        return None
    regions = [_segment_smooth_regions(view, points, MIN_SKY_LEVEL * brightest) for view in views]
    masks = [_seeded_regions(view_seeds, view_regions, MIN_SEED_LEVEL * brightest)
             for view_seeds, view_regions in zip(seeds, regions, strict=True)]
    directions = visible_directions([with_margin(view.camera) for view in views], pitch)
    samples = [_Samples.of(view, view_regions, directions) for view, view_regions in zip(views, regions, strict=True)]
    _propagate_to_views(masks, regions, samples)
    closed = [_close_mask(mask) for mask in masks]
    sky_counts, view_counts = np.zeros(len(directions)), np.zeros(len(directions))
    for mask, view_samples in zip(closed, samples, strict=True):
        view_counts[view_samples.rows] += 1
        sky_counts[view_samples.rows] += view_samples.read(mask)
    in_view = view_counts > 0
    is_sky = (sky_counts > 0) & (sky_counts >= MIN_VIEW_SHARE * view_counts)
    if is_sky.sum() < MIN_SKY_SHARE * in_view.sum():
        return None
    width = float(np.median([view.camera.width / view.camera.focal_length for view in views]))
    return Sky(directions, _close_directions(directions, is_sky, in_view, width), closed)


class _Seed(NamedTuple):
    """The pixels (height, width) about a light in a view, and their median brightness, display values of the largest
    channel."""

    pixels: Booleans
    level: float


@dataclass(frozen=True, eq=False)
class _Samples:
    """The samples of a view in the directions that it sees: their row numbers (m,), pixels x and y (m,), regions (m,)
    and colours (m, 3)."""

    rows: NDArray[np.int64]
    x: NDArray[np.int64]
    y: NDArray[np.int64]
    regions: NDArray[np.int32]
    colours: Values

    @classmethod
    def of(cls, view: SweepView, regions: NDArray[np.int32], directions: Floats) -> _Samples:
        """Sample a view and its regions (height, width) in directions (n, 3), at infinity."""
        inside, places = project_sphere(view.camera, view.camera.position, directions, 0.0)
        x, y = pixel_indices(places, view.camera.size)
        rows = np.flatnonzero(inside)
        if view.mask is not None:
            unmasked = view.mask[y, x]
            rows, x, y = rows[unmasked], x[unmasked], y[unmasked]
        return cls(rows, x, y, regions[y, x], view.picture[y, x])

    def read(self, mask: Booleans) -> Booleans:
        """Return the values (m,) of a mask (height, width)."""
        return mask[self.y, self.x]


def _light_seeds(view: SweepView, lights: Floats) -> list[_Seed]:
    """Return the seeds about those of the lights (m, 3) that are in the frame, none hidden by a mask."""
    camera, seeds = view.camera, []
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    for (light_x, light_y), depth in zip(*camera.project(lights), strict=True):
        pixels = np.hypot(x - light_x, y - light_y) <= SEED_RADIUS * camera.width
        if view.mask is not None:
            pixels &= view.mask
        if depth > 0 and pixels.sum() >= MIN_SEED_PX:
            seeds.append(_Seed(pixels, float(np.median(view.picture.max(-1)[pixels]))))
    return seeds


def _seeded_regions(seeds: Sequence[_Seed], regions: NDArray[np.int32], min_level: float) -> Booleans:
    """Return the pixels (height, width) of the regions that cover much of the seed about a light which the view shows.

    min_level: smallest brightness about such a light, display values.
    """
    sky: list[int] = []
    for seed in seeds:
        numbers, counts = np.unique(regions[seed.pixels], return_counts=True)
        shares = np.where(numbers > 0, counts / seed.pixels.sum(), 0)
        if seed.level >= min_level and shares.sum() >= MIN_SMOOTH_SHARE:
            sky.extend(numbers[shares >= MIN_SEED_SHARE].tolist())
    return np.isin(regions, sky)


def _segment_smooth_regions(view: SweepView, points: Values, level: float) -> NDArray[np.int32]:
    """Return the number (height, width) of the smooth region that each pixel belongs to, 0 for none.

    level: smallest brightness, display values. Regions with points (k, 3) of the solve are left out.
    """
    import cv2

    picture = view.picture
    steps_x, steps_y = (np.abs(np.diff(picture, axis=axis)).max(-1) > MAX_STEP for axis in (1, 0))
    is_smooth = picture.max(-1) >= level
    is_smooth[:, 1:] &= ~steps_x
    is_smooth[:, :-1] &= ~steps_x
    is_smooth[1:] &= ~steps_y
    is_smooth[:-1] &= ~steps_y
    if view.mask is not None:
        is_smooth &= view.mask
    count, regions = cv2.connectedComponents(is_smooth.astype(np.uint8), connectivity=4)
    pixels, depth = view.camera.project(points)
    x, y = pixel_indices(pixels[view.camera.contains(pixels, depth)], view.camera.size)
    has_point = np.zeros(regions.shape, bool)
    has_point[y, x] = True
    sizes = np.bincount(regions.ravel(), minlength=count)
    is_surface = np.bincount(regions[has_point], minlength=count) > MAX_POINT_SHARE * sizes
    return np.where(is_surface[regions], 0, regions)


def _propagate_to_views(masks: list[Booleans], regions: list[NDArray[np.int32]], samples: list[_Samples]) -> None:
    """Add to the masks (height, width) the regions that have the sky's colours in the sky's directions, until none is
    added."""
    count = max(int(view_samples.rows.max(initial=0)) for view_samples in samples) + 1
    has_changed = True
    while has_changed:
        colours = np.full((len(masks), count, 3), np.nan, np.float32)
        for row, mask, view_samples in zip(colours, masks, samples, strict=True):
            is_sky = view_samples.read(mask)
            row[view_samples.rows[is_sky]] = view_samples.colours[is_sky]
        known = np.isfinite(colours[..., 0]).any(0)
        sky_colours = np.full((count, 3), np.nan, np.float32)
        sky_colours[known] = np.nanmedian(colours[:, known], axis=0)
        has_changed = False
        for index, (mask, view_regions, view_samples) in enumerate(zip(masks, regions, samples, strict=True)):
            added = np.isin(view_regions, _matching_regions(view_samples, known, sky_colours)) & ~mask
            if added.any():
                masks[index], has_changed = mask | added, True


def _matching_regions(samples: _Samples, known: Booleans, sky_colours: Values) -> list[int]:
    """Return the numbers of the regions of a view that are sky, by the known sky (n,) and its colours (n, 3)."""
    is_known = known[samples.rows]
    differences = np.abs(samples.colours - sky_colours[samples.rows]).max(-1)
    accepted = []
    for region in np.unique(samples.regions[is_known & (samples.regions > 0)]):
        inside = samples.regions == region
        if (inside.sum() >= MIN_REGION and is_known[inside].mean() >= MIN_KNOWN_SHARE
                and np.median(differences[inside & is_known]) <= MAX_DIFFERENCE):
            accepted.append(int(region))
    return accepted


def with_margin(camera: Camera) -> Camera:
    """Return a camera that sees REACH frame widths more on each side."""
    margin = round(REACH * camera.width)
    return camera.cropped(-margin, -margin, camera.width + 2 * margin, camera.height + 2 * margin)


def _close_directions(directions: Floats, is_sky: Booleans, in_view: Booleans, width: float) -> Booleans:
    """Return the sky (n,) with its gaps filled: a morphological closing, whose erosion is smaller than its dilation.

    in_view: (n,), False for directions beyond all frames, which bound no gap. width: of the frames, radians.
    """
    is_near = is_sky.copy()
    is_near[~is_sky] = _angles_to(directions[~is_sky], directions[is_sky]) <= REACH * width
    outside, gaps = directions[in_view & ~is_near], is_near & ~is_sky
    filled = is_sky.copy()
    filled[gaps] = _angles_to(directions[gaps], outside) > (REACH - GROWTH) * width
    return filled


def _angles_to(directions: Floats, others: Floats) -> Floats:
    """Return the angles (n,), radians, of directions (n, 3) to the nearest of others (m, 3); pi without others."""
    if not len(others):
        return np.full(len(directions), np.pi)
    nearest = others[nearest_indices(directions, others)]
    return np.asarray(2 * np.arcsin(np.linalg.norm(directions - nearest, axis=1).clip(max=2) / 2))


def _close_mask(mask: Booleans) -> Booleans:
    """Return a mask (height, width) with its small holes closed."""
    import cv2

    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((CLOSING_PX, CLOSING_PX), np.uint8)) > 0
