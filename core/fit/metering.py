# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures the exposure of each frame by the brightness of the capture's points, and the light at which frames clip.

An automatic exposure darkens the frame as a lamp comes into it, which is where its flare begins; a fit with a fixed
exposure would take the difference for flare. The luminances that a frame shows of the points are a linear function of
those in a usual frame: the slope is the exposure, and a veil of flare only adds an offset. `trainer` and `run_loop`
call this before a fit.
"""
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture, View
from ..colour.srgb import LUMINANCE, linear_from_srgb
from ..conventions.exposures import MIN_EXPOSURE
from ..images.read import has_float_pixels
from ..system.progress import Progress
from .frames import Frames, sample_colours, subsample
from .settings import FitSettings

MIN_SPREAD = 0.25
"""Spread of the exposures, stops, above which they are not taken for equal."""
MAX_STANDARD_ERROR = 0.1
"""Standard error, stops, above which a frame's exposure counts as unknown."""
SAMPLED_VIEWS = 40
"""Approximate number of frames that are measured first."""
MIN_POINTS, SAMPLED_POINTS = 50, 500
"""Points that a frame must show, and the approximate number that is used of it. The solve's colours of points are
useless here: they follow the exposure of the few frames in which each was found."""
MIN_LEVEL, MAX_LEVEL = 0.05, 0.9
"""Display values between which pixels are used."""
OUTLIER_SHARE = 0.1
"""Share of the frames, on either side, that the spread ignores."""
MAX_ROUNDS, REFINEMENTS, TOLERANCE = 20, 3, 1e-3
"""Bound of the rounds of an iteration, rounds between lines and luminances, and change in stops at which one ends."""
MAX_CONDITION = 1e9
"""Condition number above which the points of a view have one brightness, and a line is undetermined."""
ERROR_FLOOR = 0.05
"""Linear light added to the base of relative errors: those of dark points are rounding."""
MAX_WHITE = 64.0
"""Scene-linear light at which frames with light above white are clipped: six stops above it, which is as far as cameras
reach, so that a rendered sun does not dominate the fit."""

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


def measure_exposures(capture: Capture, frames: Frames, progress: Progress | None = None) -> dict[str, float]:
    """Return the exposure of each view, by name, relative to the median frame; empty if all are about equal, or if too
    few can be measured.

    A view that cannot be measured takes the exposure of the nearest measured one in the capture's order, if possible of
    the same folder. Raises Cancelled.
    """
    progress = progress or Progress()
    stops = PointObservations.of(capture, subsample(capture.views, SAMPLED_VIEWS), frames, progress).estimate_stops()
    # All frames are measured only if some of the first differ.
    if exposure_spread(stops) >= MIN_SPREAD and len(stops) < len(capture.views):
        stops = PointObservations.of(capture, capture.views, frames, progress).estimate_stops()
    if exposure_spread(stops) < MIN_SPREAD:
        return {}
    filled = _fill_unmeasured(stops, [Path(view.name).parent for view in capture.views]) - np.nanmedian(stops)
    exposures = 2 ** filled.clip(math.log2(MIN_EXPOSURE), -math.log2(MIN_EXPOSURE))
    return {view.name: round(float(exposure), 6) for view, exposure in zip(capture.views, exposures, strict=True)}


def _fill_unmeasured(stops: Floats, folders: Sequence[Path]) -> Floats:
    """Return exposures (n,) in which each that is not finite is replaced by the nearest finite one.

    One of the same folder is preferred: a folder often has the frames of one camera. folders: folder of each frame.
    """
    usable = np.flatnonzero(np.isfinite(stops))

    def nearest(index: int) -> int:
        return int(min(usable, key=lambda other: (folders[other] != folders[index], abs(other - index))))

    return np.asarray(stops[[nearest(index) for index in range(len(stops))]])


def exposure_spread(stops: Floats) -> float:
    """Return the spread, stops, of exposures (n,) without the darkest and the brightest tenth; 0 if fewer than three,
    or fewer than half of all, are finite."""
    usable = stops[np.isfinite(stops)]
    if len(usable) < max(3, len(stops) / 2):
        return 0.0
    low, high = np.quantile(usable, (OUTLIER_SHARE, 1 - OUTLIER_SHARE))
    return float(high - low)


def exposure_warnings(exposures: Mapping[str, float]) -> tuple[str, ...]:
    """Return sentences for the user about exposures that differ."""
    if not exposures:
        return ()
    stops = exposure_spread(np.log2(list(exposures.values())))
    return (f"The frames' exposure changes, by about {stops:.1f} stops: each is fitted, baked and scored as it was "
            "exposed, and the flare is that of a frame in the middle.",)


@dataclass(frozen=True)
class PointObservations:
    """The luminances that views show of points, scene-linear (n,); for each the view, an index below `count`, and the
    point's index."""

    count: int
    views: Indices
    points: Indices
    light: Floats

    @classmethod
    def of(cls, capture: Capture, views: Sequence[View], frames: Frames, progress: Progress) -> PointObservations:
        """Sample the clean frames of views, or the frames where there are none, at the points that the camera solve
        found in each view. Pixels that are too dark, clipped or masked are left out."""
        # Points whose index is a multiple of `step`, so that views have them in common.
        step = max(int(np.median([len(view.points) for view in views])) // SAMPLED_POINTS, 1)
        samples = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
        progress.stage("look at exposures", len(views))
        for number, view in enumerate(views):
            progress.advance()
            chosen = view.points[view.points % step == 0]
            if not len(chosen):
                continue
            camera, frame, clean = frames.targets(view)
            inside, observed = sample_colours(capture.points.xyz[chosen], camera, frame if clean is None else clean)
            usable = ((observed > MIN_LEVEL) & (observed < MAX_LEVEL)).all(-1)
            if (mask := frames.mask(view)) is not None:
                _, counts = sample_colours(capture.points.xyz[chosen], camera, mask)
                usable &= counts
            points = chosen[inside][usable]
            light = linear_from_srgb(observed[usable]).astype(np.float64) @ LUMINANCE
            samples.append((np.full(len(points), number), points, light))
        numbers, points, light = (np.concatenate(arrays) for arrays in zip(*samples, strict=True))
        return cls(len(views), numbers, points, light)

    def estimate_stops(self) -> Floats:
        """Return the exposure of each view (count,), stops, not finite where it cannot be measured.

        Alternates between two steps: a line observed = slope * luminance + veil is fitted to each view, and each
        point's luminance becomes the median over the lines. The slopes are the exposures.
        """
        luminances = self._initial_luminances()
        for _ in range(REFINEMENTS):
            slopes, veils = self._fit_lines(luminances)
            exposed = (self.light - veils[self.views]) / slopes[self.views]
            luminances = _group_medians(exposed, self.points, len(luminances))
        slopes, _ = self._fit_lines(luminances)
        return np.log2(slopes)

    def _initial_luminances(self) -> Floats:
        """Return a first estimate of each point's luminance in a view of the usual exposure, by the point's index.

        Veils are ignored. In stops, points and exposures alternately become the medians of the light less the other
        (median polish). NaN for points that are not observed.
        """
        light, stops = np.log2(self.light), np.zeros(self.count)
        count = int(self.points.max(initial=-1)) + 1
        for _ in range(MAX_ROUNDS):
            previous, luminances = stops, _group_medians(light - stops[self.views], self.points, count)
            stops = _group_medians(light - luminances[self.points], self.views, self.count)
            if np.allclose(previous, stops, atol=TOLERANCE, equal_nan=True):
                break
        return np.asarray(2**luminances)

    def _fit_lines(self, luminances: Floats) -> tuple[Floats, Floats]:
        """Return slope and veil (count,) of each view's line over the points' luminances; NaN where too few points are
        known, or the slope is too uncertain."""
        slopes, veils = np.full((2, self.count), np.nan)
        for number in range(self.count):
            in_view = self.views == number
            known, observed = luminances[self.points[in_view]], self.light[in_view]
            finite = np.isfinite(known)
            if finite.sum() >= MIN_POINTS:
                (slope, veil), error = _fit_line(known[finite], observed[finite])
                # The relative error of a slope is its error in stops times ln 2.
                if slope > 0 and error / slope < MAX_STANDARD_ERROR * np.log(2):
                    slopes[number], veils[number] = slope, veil
        return slopes, veils


def _group_medians(values: Floats, groups: Indices, count: int) -> Floats:
    """Return the lower median (count,) of each group's finite values; NaN for a group without any.

    groups: index of the group of each value.
    """
    finite = np.isfinite(values)
    values, groups = values[finite], groups[finite]
    order = np.lexsort((values, groups))
    starts = np.searchsorted(groups[order], np.arange(count + 1))
    first_rows, sizes = starts[:-1], np.diff(starts)
    medians = np.full(count, np.nan)
    medians[sizes > 0] = values[order][(first_rows + (sizes - 1) // 2)[sizes > 0]]
    return medians


def _fit_line(known: Floats, observed: Floats) -> tuple[Floats, float]:
    """Fit observed = slope * known + veil, (n,) linear light; return (slope, veil) and the slope's standard error.

    Iteratively reweighted least squares on relative errors, with Cauchy weights: the glow about a light lifts the
    points beside it. The error is infinite where the points have one brightness.
    """
    columns = np.stack([known, np.ones_like(known)], 1)
    error_weights = 1 / (known.clip(min=0) + ERROR_FLOOR) ** 2
    line = np.array([np.median(observed / known.clip(min=ERROR_FLOOR)), 0.0])
    for _ in range(MAX_ROUNDS):
        errors = (observed - columns @ line) ** 2 * error_weights
        # The variance of a normal distribution is 2.2 times the median of its squared errors.
        robust_weights = 1 / (1 + errors / (2.2 * np.median(errors) + 1e-12))
        weights = robust_weights * error_weights
        product = columns.T @ (weights[:, None] * columns)
        if np.linalg.cond(product) > MAX_CONDITION:
            return np.zeros(2), np.inf
        line = np.linalg.solve(product, columns.T @ (weights * observed))
    scatter = weights @ (observed - columns @ line) ** 2 / max(robust_weights.sum() - 2, 1)
    return line, float(np.sqrt(scatter * np.linalg.inv(product)[0, 0]))


def resolve_white(settings: FitSettings, capture: Capture) -> tuple[FitSettings, tuple[str, ...]]:
    """Return the settings with `white` resolved, the light at which frames are clipped, and sentences for the user.

    White is 1, as in most formats, or MAX_WHITE if a training frame holds more than 1 and all files of the fit,
    clean frames included, are float files.
    """
    if settings.white is not None:
        return settings, ()
    views, _ = capture.split(settings.holdout)
    if not any(_is_above_white(capture, view) for view in views):
        return replace(settings, white=1.0), ()
    files = [(capture.frame_path(view), capture.plate_space) for view in views]
    if capture.has_clean_frames and settings.needs_clean_frames:
        files += [(capture.clean_frame_path(view), capture.plate_space) for view in views]
    clipped_file = next((path for path, space in files if not has_float_pixels(path, space)), None)
    if clipped_file is not None:
        return replace(settings, white=1.0), (
            f"The frames hold light above white (1.0), and {clipped_file} cannot: it is fitted as white, and flares "
            "that are brighter come out wrong; EXR files for all would keep it.",)
    return replace(settings, white=MAX_WHITE), (
        f"The frames hold light above white (1.0); it is fitted up to {MAX_WHITE:g}.",)


def _is_above_white(capture: Capture, view: View) -> bool:
    """Return whether a pixel of the frame is above 1; only a frame whose format can hold that is decoded."""
    return capture.holds_light_above_white(view) and bool(capture.frame(view).pixels.max() > 1)
