# SPDX-License-Identifier: GPL-3.0-or-later
"""How each frame of a capture is exposed, by how bright it shows the capture's points; and at which light all clip.

A camera left to itself darkens the picture as a lamp comes into it, which is where its flare begins; to a fit that
takes the exposure to be fixed the difference is flare. What a frame shows of points is a straight line over what is
known of them: the slope is its exposure, while a veil of flare only lifts the line.
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
from ..conventions.exposures import LEAST
from ..images.read import holds_floats
from ..system.progress import Progress
from ..thinning import thinned
from .frames import Frames, colours_at
from .settings import FitSettings

UNLIKE = 0.25
"""Stops, the spread over the frames, from which on they are taken to be exposed otherwise."""
SURE = 0.1
"""Stops, the standard error from which on a frame does not tell its exposure."""
ASKED = 40
"""About as many frames are looked at first."""
FEWEST, POINTS = 50, 500
"""Points that a frame has to show at least, and about as many of them that are looked at. What a solve says of their
colours is of no use: they follow the exposure of the few frames that each was found in."""
DARK, BRIGHT = 0.05, 0.9
"""Display values between which pixels tell."""
RARE = 0.1
"""Share of the frames, to either side, that do not count."""
ROUNDS, REFINED, SETTLED = 20, 3, 1e-3
SOFT = 0.05
"""Linear light that is added to what errors are parts of: those of dark points are rounding."""
WHITEST = 64.0
"""Scene-linear light at which frames that hold light above white are clipped: six stops above it, as far as cameras
reach; a fit that is shown a rendered sun is not drawn to it alone."""

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


def found(capture: Capture, frames: Frames, progress: Progress | None = None) -> dict[str, float]:
    """Of each view, times the light of the frame in the middle; empty where all are exposed alike, or too few tell.
    Views that do not tell are taken for as exposed as the nearest, by name, that do. Raises Cancelled when asked to
    stop."""
    progress = progress or Progress()
    stops = Seen.of(capture, thinned(capture.views, ASKED), frames, progress).stops()
    if spread(stops) >= UNLIKE and len(stops) < len(capture.views):  # all only where some differ
        stops = Seen.of(capture, capture.views, frames, progress).stops()
    if spread(stops) < UNLIKE:
        return {}
    filled = _filled(stops, [Path(view.name).parent for view in capture.views]) - np.nanmedian(stops)
    times = 2 ** filled.clip(math.log2(LEAST), -math.log2(LEAST))
    return {view.name: round(float(one), 6) for view, one in zip(capture.views, times, strict=True)}


def _filled(stops: Floats, folders: Sequence[Path]) -> Floats:
    """Those that do not tell by the nearest that does, of the same folder if there is one: a camera's, often."""
    tells = np.flatnonzero(np.isfinite(stops))

    def nearest(at: int) -> int:
        return int(min(tells, key=lambda other: (folders[other] != folders[at], abs(other - at))))

    return np.asarray(stops[[nearest(at) for at in range(len(stops))]])


def spread(stops: Floats) -> float:
    """Stops by which exposures (n,) differ, but for the darkest and the brightest tenth; 0 where fewer than three, or
    half of all, tell (the others are not finite)."""
    tells = stops[np.isfinite(stops)]
    if len(tells) < max(3, len(stops) / 2):
        return 0.0
    low, high = np.quantile(tells, (RARE, 1 - RARE))
    return float(high - low)


def says(exposures: Mapping[str, float]) -> tuple[str, ...]:
    """Sentences for the person who asked for the fit."""
    if not exposures:
        return ()
    stops = spread(np.log2(list(exposures.values())))
    return (f"The frames' exposure changes, by about {stops:.1f} stops: each is fitted, baked and scored as it was "
            "exposed, and the flare is that of a frame in the middle.",)


@dataclass(frozen=True)
class Seen:
    """What views show of points: (n,) luminances, scene-linear, each of a view, by its place among `count`, and of a
    point, by its index."""

    count: int
    views: Indices
    points: Indices
    light: Floats

    @classmethod
    def of(cls, capture: Capture, views: Sequence[View], frames: Frames, progress: Progress) -> Seen:
        """Where the solve found the points, neither too dark nor clipped, in the flare-free frames if there are any."""
        step = max(int(np.median([len(view.points) for view in views])) // POINTS, 1)  # the same points of all views
        parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
        progress.stage("look at exposures", len(views))
        for number, view in enumerate(views):
            progress.advance()
            chosen = view.points[view.points % step == 0]
            if not len(chosen):
                continue
            camera, frame, removed = frames.targets(view)
            inside, shown = colours_at(capture.points.xyz[chosen], camera, frame if removed is None else removed)
            tells = ((shown > DARK) & (shown < BRIGHT)).all(-1)
            points = chosen[inside][tells]
            light = linear_from_srgb(shown[tells]).astype(np.float64) @ LUMINANCE
            parts.append((np.full(len(points), number), points, light))
        numbers, points, light = (np.concatenate(part) for part in zip(*parts, strict=True))
        return cls(len(views), numbers, points, light)

    def stops(self) -> Floats:
        """Exposure of each view (count,); not finite where it does not tell. What the points show in a view of the
        usual exposure is found along with it."""
        usual = self._usual()
        for _ in range(REFINED):
            slopes, veils = self._lines(usual)
            usual = _medians((self.light - veils[self.views]) / slopes[self.views], self.points, len(usual))
        return np.log2(self._lines(usual)[0])

    def _usual(self) -> Floats:
        """Luminance of each point in a view of the usual exposure, by index, as if there were no veils."""
        light, stops = np.log2(self.light), np.zeros(self.count)
        most = int(self.points.max(initial=-1)) + 1
        for _ in range(ROUNDS):
            before, usual = stops, _medians(light - stops[self.views], self.points, most)
            stops = _medians(light - usual[self.points], self.views, self.count)
            if np.allclose(before, stops, atol=SETTLED, equal_nan=True):
                break
        return np.asarray(2**usual)

    def _lines(self, usual: Floats) -> tuple[Floats, Floats]:
        """Slope and veil of each view (count,), given the points' usual luminances; not finite where it does not
        tell."""
        lines = np.full((2, self.count), np.nan)
        for number in range(self.count):
            own = self.views == number
            known, shown = usual[self.points[own]], self.light[own]
            there = np.isfinite(known)
            if there.sum() >= FEWEST:
                line, error = _line(known[there], shown[there])
                if line[0] > 0 and error / line[0] < SURE * np.log(2):
                    lines[:, number] = line
        return lines[0], lines[1]


def _medians(values: Floats, groups: Indices, count: int) -> Floats:
    """(count,): the (lower) median of each group's values that are finite; not finite for groups without any."""
    there = np.isfinite(values)
    values, groups = values[there], groups[there]
    order = np.lexsort((values, groups))
    begins = np.searchsorted(groups[order], np.arange(count + 1))
    first, sizes = begins[:-1], np.diff(begins)
    medians = np.full(count, np.nan)
    medians[sizes > 0] = values[order][(first + (sizes - 1) // 2)[sizes > 0]]
    return medians


def _line(known: Floats, shown: Floats) -> tuple[Floats, float]:
    """(slope, veil) of shown = slope * known + veil, both (n,) linear light, and the slope's standard error. Errors
    count in parts of the light, and less the larger they are (Cauchy's weights): the glow about a light lifts the
    points beside it."""
    columns = np.stack([known, np.ones_like(known)], 1)
    parts = 1 / (known.clip(min=0) + SOFT) ** 2
    line = np.array([np.median(shown / known.clip(min=SOFT)), 0.0])
    for _ in range(ROUNDS):
        errors = (shown - columns @ line) ** 2 * parts
        trust = 1 / (1 + errors / (2.2 * np.median(errors) + 1e-12))
        weights = trust * parts
        product = columns.T @ (weights[:, None] * columns)
        if np.linalg.cond(product) > 1e9:  # points of one brightness
            return np.zeros(2), np.inf
        line = np.linalg.solve(product, columns.T @ (weights * shown))
    scatter = weights @ (shown - columns @ line) ** 2 / max(trust.sum() - 2, 1)
    return line, float(np.sqrt(scatter * np.linalg.inv(product)[0, 0]))


def with_white(settings: FitSettings, capture: Capture) -> tuple[FitSettings, tuple[str, ...]]:
    """The settings with the light at which frames are clipped, where that was left open, and what is to be said of it.

    It is 1, the white of most formats, or more where all are float files and some frame holds more.
    """
    if settings.white is not None:
        return settings, ()
    views, _ = capture.split(settings.holdout)
    if not any(_is_above_white(capture, view) for view in views):
        return replace(settings, white=1.0), ()
    files = [capture.frame_path(view) for view in views]
    if capture.has_removed and settings.looks_at_removed:
        files += [capture.removed_path(view) for view in views]
    clipped = next((path for path in files if not holds_floats(path)), None)
    if clipped is not None:
        return replace(settings, white=1.0), (
            f"The frames hold light above white (1.0), and {clipped} cannot: it is fitted as white, and flares that "
            "are brighter come out wrong; EXR files for all would keep it.",)
    return replace(settings, white=WHITEST), (
        f"The frames hold light above white (1.0); it is fitted up to {WHITEST:g}.",)


def _is_above_white(capture: Capture, view: View) -> bool:
    return holds_floats(capture.frame_path(view)) and bool(capture.frame(view).pixels.max() > 1)
