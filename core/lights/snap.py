# SPDX-License-Identifier: GPL-3.0-or-later
"""Snaps inaccurate lights to their flares before a fit.

A light that was placed by hand is off by a part of its distance, and with it the line that its ghosts lie on, in every
view. A flare is brightest around its light. So each light moves to the brightest place in all views at once: mean shift
(Comaniciu and Meer 2002) under windows that narrow, whose steps in the pictures become one step in the world by least
squares. Pixels are shared among the lights by their windows, so that two do not climb one flare.

A light that is accurate already sits on a peak, and is left unchanged. So is one that finds no clear peak, and one in a
clipped sky, which hides the peak.
"""
from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..capture.camera import Camera, Floats
from ..capture.discs import CLIP_LEVEL
from ..colour.srgb import linear_from_srgb

WINDOWS = (0.12, 0.08, 0.05, 0.03, 0.02, 0.013)
"""Standard deviations of the windows, in frame widths. Near peaks are tried first, so that each light finds its flare.
"""
MAX_OFFSET = 1.5
"""Largest error of a light in the median view, in units of the widest window."""
MAX_STEPS, MIN_MOTION_PX = 12, 0.05
"""Largest number of steps under each window, and the motion, pixels, below which no more are made."""
PEAK_WINDOW, MIN_PEAK_RATIO, MAX_SHIFT = 0.02, 1.5, 0.3
"""Criterion of a peak.

The window PEAK_WINDOW must be MIN_PEAK_RATIO times as bright as one twice as wide, and the views' mean shift must stay
below MAX_SHIFT of the window.
"""
DISC_WINDOW, DISC_GAIN = 0.03, 10.0
"""Brightness of a clipped light disc, which hides its flare: DISC_GAIN times the flare under a window of this
deviation."""
MAX_DISC_RADIUS = 0.035
"""Radius, in frame widths, of the largest disc in a clean frame; larger clipped areas are sky."""
MAX_HIDDEN_SHARE, MIN_FLARE = 0.5, 0.25
"""A light is not moved if it stands in a clipped sky in more than this share of the views that show it. Only views
count whose flare has at least this light, relative to the mean of all."""
DAMPING = 3e-3
"""Damping of the least squares, relative to the mean curvature: the line of sight is weakly determined."""


class FlareView(NamedTuple):
    """A camera, and the brightness of a flare in its picture: (height, width), linear, not negative.

    observed: (height, width), False where the picture does not show the flare; None if it shows it everywhere.
    """

    camera: Camera
    flare: NDArray[np.float32]
    observed: NDArray[np.bool_] | None = None


def flare_view(camera: Camera, frame: NDArray[np.float32], clean: NDArray[np.float32]) -> FlareView:
    """Return the view of a flare: the light that a frame has beyond its clean frame.

    A clipped light disc, which hides its flare, is given DISC_GAIN times the flare around it; clipped sky counts as not
    observed. frame, clean: display values 0..1, (height, width, 3), of the camera's size.
    """
    import cv2

    added = (linear_from_srgb(frame) - linear_from_srgb(clean)).clip(min=0).mean(-1)
    glow = cv2.GaussianBlur(added, (0, 0), DISC_WINDOW * camera.width)
    clipped = (frame >= CLIP_LEVEL).all(-1)
    # A clipped sky hides the flare as a light's disc does, but its middle is no light.
    hidden = _components_with(clipped, _large_components((clean >= CLIP_LEVEL).all(-1), MAX_DISC_RADIUS * camera.width))
    disc = clipped & ~hidden
    flare = np.asarray(added + disc * glow * np.float32(DISC_GAIN), np.float32)
    return FlareView(camera, np.where(hidden, np.float32(0), flare), ~hidden if hidden.any() else None)


def _large_components(mask: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """Return the connected parts of a mask (height, width) with more area than a disc of this radius, pixels."""
    import cv2

    _, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return np.asarray(mask & (statistics[:, cv2.CC_STAT_AREA] > np.pi * radius * radius)[labels])


def _components_with(mask: NDArray[np.bool_], seeds: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the connected parts of a mask (height, width) that touch the seeds."""
    import cv2

    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    touched = np.zeros(count, bool)
    touched[np.unique(labels[seeds & mask])] = True
    touched[0] = False
    return np.asarray(touched[labels])


def snap_lights(views: Sequence[FlareView], lights: ArrayLike) -> Floats:
    """Return the lights' positions (n, 3), world coordinates, moved to their flares by mean shift.

    Lights that are on a peak already, that find no clear peak or that stand in clipped sky are unchanged.
    """
    initial = np.array(lights, np.float64).reshape(-1, 3)
    positions, is_done = initial.copy(), _are_on_peaks(views, initial) | _are_in_clipped_sky(views, initial)
    for widest in reversed(range(len(WINDOWS) - 2)):  # from the narrowest three windows alone to all
        if is_done.all():
            break
        moved = _mean_shift(views, positions, ~is_done, WINDOWS[widest:])
        accepted = (~is_done & _are_on_peaks(views, moved) & ~_are_merged(views, moved)
                    & _are_in_reach(views, initial, moved))
        positions[accepted], is_done = moved[accepted], is_done | accepted
    return positions


def _mean_shift(views: Sequence[FlareView], positions: Floats, free: NDArray[np.bool_],
                windows: Sequence[float]) -> Floats:
    """Return positions (n, 3) after mean shift of the lights that are `free` (n,), under one window after another.

    The other lights stay, and keep their share of the pixels. windows: standard deviations in frame widths.
    """
    positions = positions.copy()
    for window in windows:
        for _ in range(MAX_STEPS):
            largest_motion = 0.0
            for light, observations in enumerate(_observe(views, positions, window)):
                if not free[light] or len(observations) < 2:
                    continue
                step = _least_squares_step(observations)
                positions[light] += step
                motions = (float(np.linalg.norm(observation.jacobian @ step)) for observation in observations)
                largest_motion = max(largest_motion, *motions)
            if largest_motion < MIN_MOTION_PX:
                break
    return positions


def _are_on_peaks(views: Sequence[FlareView], positions: Floats) -> NDArray[np.bool_]:
    """Return (n,), True for each light on a peak of brightness.

    On a peak the light in PEAK_WINDOW is MIN_PEAK_RATIO times as bright as in one twice as wide, and the mean shift is
    small.
    """
    fine, wide = (_observe(views, positions, window) for window in (PEAK_WINDOW, 2 * PEAK_WINDOW))
    on_peak = np.zeros(len(positions), bool)
    for light, (fine_observations, wide_observations) in enumerate(zip(fine, wide, strict=True)):
        if fine_observations:
            brightness = np.array([observation.brightness for observation in fine_observations])
            shifts = np.array([np.linalg.norm(observation.shift) for observation in fine_observations])
            shift = shifts @ brightness / brightness.sum()
            peak = brightness.mean() / np.mean([observation.brightness for observation in wide_observations])
            on_peak[light] = peak > MIN_PEAK_RATIO and shift < MAX_SHIFT * PEAK_WINDOW * views[0].camera.width
    return on_peak


def _are_in_clipped_sky(views: Sequence[FlareView], positions: Floats) -> NDArray[np.bool_]:
    """Return (n,), True for each light that lies in clipped sky in more than MAX_HIDDEN_SHARE of its views.

    Its views are those with the light in frame and a flare of at least MIN_FLARE of the mean over all views.
    """
    in_sky = np.zeros(len(positions), bool)
    levels = [float(view.flare.mean()) for view in views]
    flaring = [view for view, level in zip(views, levels, strict=True) if level >= MIN_FLARE * np.mean(levels)]
    for light, position in enumerate(positions):
        hidden = []
        for camera, flare, observed in flaring:
            pixel, depth = camera.project(position[None])
            if camera.contains(pixel, depth)[0]:
                x, y = np.minimum(pixel[0].astype(int), np.array(flare.shape[::-1]) - 1)
                hidden.append(observed is not None and not observed[y, x])
        in_sky[light] = bool(hidden) and float(np.mean(hidden)) > MAX_HIDDEN_SHARE
    return in_sky


class _Observation(NamedTuple):
    """A light under its window in one view.

    brightness: mean under the window; shift: mean shift (2,), pixels; jacobian: (2, 3) derivative of the pixel by the
    light.
    """

    brightness: float
    shift: Floats
    jacobian: Floats


def _least_squares_step(observations: Sequence[_Observation]) -> Floats:
    """Return the step (3,), world units, whose projections fit the views' mean shifts by damped least squares.

    Views that are dimmer than the upper quartile have less weight.
    """
    brightness = np.array([observation.brightness for observation in observations])
    weights = np.minimum(brightness / np.quantile(brightness, 0.75), 1)
    jacobians = np.stack([observation.jacobian for observation in observations])
    shifts = np.stack([observation.shift for observation in observations])
    curvature = np.einsum("v,vij,vik->jk", weights, jacobians, jacobians)
    pull = np.einsum("v,vij,vi->j", weights, jacobians, shifts)
    return np.asarray(np.linalg.solve(curvature + DAMPING * np.trace(curvature) / 3 * np.eye(3), pull))


def _observe(views: Sequence[FlareView], positions: Floats, window: float) -> list[list[_Observation]]:
    """Return the observations of each light, one for each view that has flare under the light's Gaussian window.

    Where windows overlap, lights share a pixel in proportion to their windows. positions: of the lights, (lights, 3),
    world units. window: standard deviation in frame widths.
    """
    by_light: list[list[_Observation]] = [[] for _ in positions]
    for camera, flare, observed in views:
        height, width = flare.shape
        deviation = window * width
        across, down = np.arange(width) + 0.5, np.arange(height) + 0.5
        pixels, depth = camera.project(positions)
        profiles = {
            light: (np.exp(-0.5 * ((across - x) / deviation) ** 2), np.exp(-0.5 * ((down - y) / deviation) ** 2))
            for light, (x, y) in enumerate(pixels) if depth[light] > 0}
        windows = {light: row * column[:, None] for light, (row, column) in profiles.items()}
        total_window = sum(windows.values(), np.full((height, width), 1e-12))
        for light, window_pixels in windows.items():
            support = window_pixels * window_pixels / total_window  # the window times its share of each pixel
            if observed is not None:
                support = support * observed
            weights = support * flare
            window_sum, weight_sum = support.sum(), weights.sum()
            if weight_sum <= 1e-12 * max(window_sum, 1e-12):
                continue
            # Centroid of the light less that of the window, which the frame's edge and the other lights displace.
            shift = [(weights.sum(axis) @ coordinates) / weight_sum - (support.sum(axis) @ coordinates) / window_sum
                     for axis, coordinates in ((0, across), (1, down))]
            by_light[light].append(_Observation(float(weight_sum) / (2 * np.pi * deviation**2), np.array(shift),
                                                camera.jacobian(positions[light])))
    return by_light


def _are_merged(views: Sequence[FlareView], positions: Floats) -> NDArray[np.bool_]:
    """Return (n,), True for each light that lies nearer than PEAK_WINDOW to another one in most views."""
    coincident_views = np.zeros((len(positions), len(positions)))
    for camera, _, _ in views:
        pixels, _ = camera.project(positions)
        coincident_views += np.linalg.norm(pixels[:, None] - pixels, axis=-1) < PEAK_WINDOW * camera.width
    coincident_views -= np.diag(np.diag(coincident_views))
    return np.asarray((coincident_views > len(views) / 2).any(1))


def _are_in_reach(views: Sequence[FlareView], initial: Floats, positions: Floats) -> NDArray[np.bool_]:
    """Return (n,), true for each position that in the median view lies within MAX_OFFSET widest windows of the initial
    one.

    A position farther away would be that of a ghost of a light out of frame.
    """
    in_reach = np.zeros(len(initial), bool)
    projections = [(camera.width, *camera.project(initial), *camera.project(positions)) for camera, _, _ in views]
    for light in range(len(initial)):
        offsets = [float(np.linalg.norm(moved_pixels[light] - initial_pixels[light])) / width
                   for width, initial_pixels, initial_depth, moved_pixels, moved_depth in projections
                   if initial_depth[light] > 0 and moved_depth[light] > 0]
        in_reach[light] = bool(offsets) and float(np.median(offsets)) < MAX_OFFSET * WINDOWS[0]
    return in_reach
