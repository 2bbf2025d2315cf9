# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds what lies beyond the parallax of a capture, such as a skyline, clouds or a view from a window, and makes the
far points that the scene starts from there. `initialise` calls it.

Structure from motion has no points there, and a scene that grows over such places from near points has wrong depths
there. A sphere sweep decides: it projects each direction into the frames, as a point on an infinite sphere and as
points on some near spheres about the cameras, and compares the frames there. In a far direction the frames agree on the
infinite sphere and differ on the near ones. In a plain direction they agree on all, so it is decided like the
directions with contrast about it. On a near surface they agree on none. In an even sky, a far light decides
(`even_sky`).
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from ..capture import Camera, Capture, PointCloud, View
from ..colour.srgb_torch import expose
from ..gaussians.far_sphere import FarSphere
from ..gaussians.scene import INITIAL_OPACITY, SceneGaussians
from ..images.picture import Picture
from .even_sky import Sky, segment_sky, select_far_lights, with_margin
from .frames import Frames, Targets, subsample
from .sweep_views import (
    SWEEP_WIDTH,
    Booleans,
    Floats,
    SweepView,
    Values,
    bilinear,
    camera_centre,
    camera_spread,
    farthest_distance,
    make_sweep_view,
    median_focal_length,
    nearest_indices,
    pixel_indices,
    project_sphere,
    visible_directions,
)

SWEEP_VIEWS = 24
"""Approximate number of views of the sweep."""
PITCH_PX = 1.7
"""Distance of neighbouring directions of the sweep, pixels of its pictures."""
PATCH_PITCHES = 3.0
"""Distance of neighbouring patches, which are decided as a whole, in distances of directions."""
BARE_PARALLAX_PX, PARALLAXES_PX = 2.0, (4.0, 7.0, 12.0, 20.0)
"""Radii of the spheres, as the parallax of their points over the spread of the cameras, pixels of the pictures. A far
patch must agree better on the infinite sphere than on that of bare parallax; the others are the near ones."""
MAX_DIFFERENCE = 0.05
"""Difference, display values, up to which two views agree."""
MIN_VIEWS, MIN_VISIBLE_SHARE = 3, 0.5
"""Number of views that must see a direction, and share of a patch's directions that so many must see."""
MIN_CONTRAST = 0.1
"""Share of the views that differ on near spheres, below which a patch is plain and undecided."""
DECISIVE_RATIO = 0.7
"""Ratio of the shares that differ on the infinite sphere and on near ones, below which a patch is certainly far."""
NEIGHBOURS, MIN_GAIN = 7, 0.06
"""In a capture with a far layer, a patch is decided by so many patches with contrast next to it, itself included; and
the views must differ there by so much less on the infinite sphere than on near ones."""
MAX_COST = 0.3
"""Share of views that differ on the infinite sphere up to which a patch with contrast is far then: mostly plain ones
that something hides in some views."""
MIN_FAR_SHARE, MIN_FAR_PATCHES = 0.12, 12
"""Share and number of the patches with contrast that must be far for a capture to have a far layer."""
RADIUS_FACTOR, MAX_PARALLAX_PX = 20.0, 0.25
"""Smallest radius of the far sphere relative to the distance of the farthest points, and the largest parallax of its
points over the spread of the cameras, pixels of the fit's frames."""
POINT_PITCH_PX = 4.0
"""Distance of neighbouring far points, pixels of the fit's frames."""
MAX_POINTS, MAX_CANDIDATES = 16_000, 64_000
SKY_OPACITY = 0.5
"""Opacity that Gaussians of the sky about a far light start with. Those that something hides in all views keep it."""
COLOUR_QUANTILE = 0.25
"""Quantile of the views' colours that a far point takes where the frames have a flare: flares only add light."""


@dataclass(frozen=True, eq=False)
class FarLayer:
    """The far points (n) of a capture, the sphere that they lie on, and the opacities (n,) that they start with."""

    sphere: FarSphere
    points: PointCloud
    opacities: Floats


def find_far_layer(capture: Capture, views: tuple[View, ...], frames: Frames) -> FarLayer | None:
    """Return the far layer of a capture: what a sphere sweep over some of the views finds far, and the sky about a far
    light.

    None if neither is found, or if this cannot be decided: without points, or with all cameras in one place.
    """
    sampled = subsample(views, SWEEP_VIEWS)
    cameras = [view.camera.scaled(min(SWEEP_WIDTH, view.camera.width)) for view in sampled]
    spread = camera_spread(cameras)
    if not len(capture.points) or not spread or capture.is_rotation_only:
        return None
    sweep_views = [make_sweep_view(view, frames) for view in sampled]
    patches = classify_patches(sweep_views)
    sky = _find_sky(capture, sweep_views)
    if patches is None and sky is None:
        return None
    focal = max(frames.camera(view).focal_length for view in sampled)  # the longest lens shows the most parallax
    radius = max(RADIUS_FACTOR * farthest_distance(capture.points.xyz, cameras), spread * focal / MAX_PARALLAX_PX)
    sphere = FarSphere(tuple(map(float, camera_centre(cameras))), radius)
    return FarLayer(sphere, *_make_far_points(sphere, _FarParts(patches, sky), sampled, frames))


def _find_sky(capture: Capture, views: list[SweepView]) -> Sky | None:
    """Return the sky about the far lights of a capture; None without such a light, or if no view shows it in an even
    sky."""
    cameras = [view.camera for view in views]
    places = np.array([light.xyz for light in capture.lights if not light.moves]).reshape(-1, 3)
    lights = select_far_lights(places, capture.points.xyz, cameras)
    if not len(lights):
        return None
    return segment_sky(views, lights, capture.points.xyz, PITCH_PX / median_focal_length(cameras))


def far_layer_messages(scene: SceneGaussians) -> tuple[str, ...]:
    """Return a message to the user on the far layer of a scene that a fit starts from; () without one."""
    count = len(scene.far_rows())
    if not count:
        return ()
    return (f"The frames show something beyond the parallax of the capture: {count} far Gaussians stand for it.",)


@dataclass(frozen=True, eq=False)
class Patches:
    """Directions (n, 3), unit vectors, each the middle of a patch, and which (n,) are far."""

    directions: Floats
    is_far: Booleans

    def are_far(self, directions: Floats) -> Booleans:
        """Return (m,) whether the patches of directions (m, 3) are far."""
        return self.is_far[nearest_indices(directions, self.directions)]


@dataclass(frozen=True, eq=False)
class _FarParts:
    """The far parts of a capture: patches by the sphere sweep, and the sky about a far light; None for one that it
    lacks."""

    patches: Patches | None
    sky: Sky | None

    def visible_directions(self, cameras: list[Camera], pitch: float) -> Floats:
        """Return the far ones (n, 3) of `sweep_views.visible_directions`."""
        directions = visible_directions(cameras, pitch)
        is_far = np.zeros(len(directions), bool)
        if self.patches is not None:
            is_far |= self.patches.are_far(directions)
        if self.sky is not None:
            is_far |= self.sky.contains(directions)
        return directions[is_far]


def classify_patches(views: list[SweepView]) -> Patches | None:
    """Return which patches of directions are far; None where too few are for a far layer."""
    costs = sweep_patches(views)
    # Patches that are certainly far decide whether there is a far layer. If so, every patch is decided by its
    # neighbours.
    has_contrast = costs.near >= MIN_CONTRAST
    is_far = has_contrast & (costs.infinite < DECISIVE_RATIO * costs.near) & (costs.infinite <= costs.bare)
    if is_far.sum() < max(MIN_FAR_PATCHES, MIN_FAR_SHARE * has_contrast.sum()):
        return None
    return Patches(costs.directions, _classify_by_neighbours(costs))


class SweepCosts(NamedTuple):
    """Directions (n, 3) of patches, and the share (n,) of the views that differ there: on the infinite sphere, on that
    of bare parallax, and the median of the near ones."""

    directions: Floats
    infinite: Floats
    bare: Floats
    near: Floats


def sweep_patches(views: list[SweepView]) -> SweepCosts:
    """Return how much the views disagree on each patch of directions, for spheres of several radii about the cameras.

    The cost of a patch is the mean over its directions. Patches that too few views see are left out.
    """
    cameras = [view.camera for view in views]
    focal = median_focal_length(cameras)
    pitch = PITCH_PX / focal
    directions = visible_directions(cameras, pitch)
    patch_directions = visible_directions(cameras, PATCH_PITCHES * pitch)
    patch_indices = nearest_indices(directions, patch_directions)
    sizes = np.bincount(patch_indices, minlength=len(patch_directions))  # directions in each patch
    parallaxes = (0.0, BARE_PARALLAX_PX, *PARALLAXES_PX)  # of the spheres: infinite, bare parallax, near
    costs = np.full((len(parallaxes), len(patch_directions)), np.nan)
    for row, parallax in zip(costs, parallaxes, strict=True):
        # A point at distance r has a parallax of focal * spread / r pixels.
        cost, visible = _disagreement(views, directions, parallax / focal / camera_spread(cameras))
        sums = np.bincount(patch_indices, np.where(visible, cost, 0), len(patch_directions))
        visible_counts = np.bincount(patch_indices, visible, len(patch_directions))
        is_visible = (visible_counts > 0) & (visible_counts >= MIN_VISIBLE_SHARE * sizes)
        row[:] = np.where(is_visible, sums / np.maximum(visible_counts, 1), np.nan)
    # A patch is usable if its cost is known on the infinite sphere, on that of bare parallax and on a near one.
    usable = np.isfinite(costs[:2]).all(0) & np.isfinite(costs[2:]).any(0)
    infinite, bare = costs[:2, usable]
    return SweepCosts(patch_directions[usable], infinite, bare, np.nanmedian(costs[2:, usable], axis=0))


def _classify_by_neighbours(costs: SweepCosts) -> Booleans:
    """Return which patches (n,) are far, each decided by the NEIGHBOURS nearest patches with contrast.

    A patch is far if these differ less on the infinite sphere than on near ones, by MIN_GAIN of the latter. A patch
    with contrast is far also if its own cost on the infinite sphere is below MAX_COST.
    """
    has_contrast = costs.near >= MIN_CONTRAST
    directions, infinite, near = (values[has_contrast] for values in (costs.directions, costs.infinite, costs.near))
    count = min(NEIGHBOURS, int(has_contrast.sum()))
    is_far = np.zeros(len(costs.directions), bool)
    for index, direction in enumerate(costs.directions):
        nearest = np.argpartition(-(directions @ direction), count - 1)[:count]
        gain = near[nearest] - infinite[nearest]
        is_far[index] = gain.sum() > MIN_GAIN * near[nearest].sum()
    return is_far | has_contrast & (costs.infinite < MAX_COST)


def _disagreement(views: list[SweepView], directions: Floats, inverse_radius: float) -> tuple[Floats, Booleans]:
    """Return for points in directions (n, 3) on a sphere about the cameras how much the views disagree, and whether at
    least MIN_VIEWS see each, (n,) both.

    Disagreement is the share of the seeing views that differ from the largest group of views that agree; 0 if too few
    see the point. A group is robust: something near may hide a direction in most views. inverse_radius: 1 / radius of
    the sphere, 0 for an infinite one.
    """
    centre = camera_centre([view.camera for view in views])
    values = np.full((len(views), len(directions), 3), np.nan, np.float32)
    for row, view in zip(values, views, strict=True):
        inside, places = project_sphere(view.camera, centre, directions, inverse_radius)
        x, y = pixel_indices(places, view.camera.size)
        row[inside] = bilinear(view.picture, places)
        if view.mask is not None:
            row[np.flatnonzero(inside)[~view.mask[y, x]]] = np.nan
    view_counts = np.isfinite(values[..., 0]).sum(0)
    visible = view_counts >= MIN_VIEWS
    cost = np.zeros(len(directions))
    red, green, blue = torch.from_numpy(np.ascontiguousarray(values[:, visible].transpose(2, 0, 1)))
    largest_group = torch.zeros(red.shape[1], dtype=torch.int32)
    for r, g, b in zip(red, green, blue, strict=True):
        difference = (red - r).abs_().maximum((green - g).abs_()).maximum((blue - b).abs_())
        agree = (difference <= MAX_DIFFERENCE).sum(0, dtype=torch.int32)  # comparisons with NaN are false
        largest_group = torch.maximum(largest_group, agree)
    cost[visible] = 1 - (largest_group.numpy() - 1) / (view_counts[visible] - 1)  # every view agrees with itself
    return cost, visible


def _make_far_points(sphere: FarSphere, far_parts: _FarParts, views: Sequence[View], frames: Frames
                     ) -> tuple[PointCloud, Floats]:
    """Return about MAX_POINTS points at most, on the far sphere in the far parts, in the colours of the frames, and
    their opacities.

    Colours are at the usual exposure: the median over the views where all have clean frames, else a low quantile, since
    a flare only adds light.
    """
    targets = [frames.targets(view) for view in views]
    cameras = [target.camera for target in targets]
    seeing_cameras = cameras if far_parts.sky is None else [with_margin(camera) for camera in cameras]
    pitch = max(POINT_PITCH_PX / median_focal_length(cameras), _least_pitch(far_parts, seeing_cameras))
    directions = far_parts.visible_directions(seeing_cameras, pitch)
    if len(directions) > MAX_POINTS:
        directions = far_parts.visible_directions(seeing_cameras, pitch * (len(directions) / MAX_POINTS) ** 0.5)
    colours = _sample_colours(directions, views, targets, frames)
    opacities = np.full(len(directions), INITIAL_OPACITY)
    if far_parts.sky is not None:
        in_sky = far_parts.sky.contains(directions)
        opacities[in_sky] = SKY_OPACITY
        colours[:, in_sky] = _sky_colours(colours[:, in_sky], directions[in_sky], cameras, far_parts.sky)
    is_exact = all(target.clean is not None for target in targets)
    visible = np.isfinite(colours[..., 0]).any(0)
    chosen_colours = np.nanquantile(colours[:, visible], 0.5 if is_exact else COLOUR_QUANTILE, axis=0)
    xyz = np.array(sphere.centre) + sphere.radius * directions[visible]
    points = PointCloud(xyz.astype(np.float32), (chosen_colours.clip(0, 1) * 255 + 0.5).astype(np.uint8),
                        np.zeros(len(xyz), np.float32))
    return points, opacities[visible]


def _least_pitch(far_parts: _FarParts, cameras: list[Camera]) -> float:
    """Return the distance of neighbouring directions, radians, at which the far parts hold about MAX_CANDIDATES.

    They are measured by the directions of small pictures: in large frames, the lattice of the points has millions.
    """
    small = [camera.scaled(min(SWEEP_WIDTH, camera.width)) for camera in cameras]
    pitch = PITCH_PX / median_focal_length(small)
    count = len(far_parts.visible_directions(small, pitch))
    return pitch * float(np.sqrt(count / MAX_CANDIDATES))


def _sky_colours(colours: Values, directions: Floats, cameras: list[Camera], sky: Sky) -> Values:
    """Return the colours (views, n, 3) of sky directions (n, 3): NaN in the views in which something near hides the
    sky.

    A direction in which no view shows the sky has the colours of the nearest one with sky.
    """
    shows_sky = np.zeros(colours.shape[:2], bool)
    for row, camera, mask in zip(shows_sky, cameras, sky.masks, strict=True):
        height, width = mask.shape
        small = camera.scaled(width)
        inside, places = project_sphere(small, camera.position, directions, 0.0)
        x, y = pixel_indices(places, (width, height))
        row[inside] = mask[y, x]
    shows_sky &= np.isfinite(colours[..., 0])
    has_colour = shows_sky.any(0)
    sky_colours = np.where(shows_sky[:, has_colour, None], colours[:, has_colour], np.float32(np.nan))
    return np.asarray(sky_colours[:, nearest_indices(directions, directions[has_colour])])


def _sample_colours(directions: Floats, views: Sequence[View], targets: Sequence[Targets], frames: Frames) -> Values:
    """Return colours (views, n, 3), display values at the usual exposure, of points at infinity in directions (n, 3);
    NaN where a view does not see a direction. targets: camera, frame and clean frame of each view."""
    colours = np.full((len(views), len(directions), 3), np.nan, np.float32)
    for row, view, (camera, frame, clean) in zip(colours, views, targets, strict=True):
        # Scale the frame so that neighbouring far points lie PITCH_PX pixels apart.
        small = camera.scaled(max(round(camera.width * PITCH_PX / POINT_PITCH_PX), 8))
        picture = expose(frame if clean is None else clean, 1 / camera.exposure).numpy()
        values = Picture(picture, "srgb").resized(*small.size).display()
        inside, places = project_sphere(small, camera.position, directions, 0.0)
        row[inside] = bilinear(values, places)
        if (mask := frames.mask(view)) is not None:
            x, y = pixel_indices(places / small.width * camera.width, camera.size)
            row[np.flatnonzero(inside)[~mask.numpy()[y, x]]] = np.nan
    return colours
