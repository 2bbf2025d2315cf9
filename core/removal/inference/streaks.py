# SPDX-License-Identifier: GPL-3.0-or-later
"""Corrects the streaks of a predicted flare by what the frame shows along them.

A network of working size leaves half of a thin streak in one place and takes too much in another. But a streak is a
ridge of light on a line from its light: along it the frame is brighter than on both sides, and the amount changes
slowly. So where the predicted flare has such a ridge, the frame's own ridge is measured in a strip about it: what the
frame has above the line between the strip's edges. The predicted ridge is then clamped to the range between the running
quartiles along the streak, widened by 1.5 standard errors of the median on each side. The scene's detail widens it,
too. Over a busy scene the range is wide, and the prediction stays; over an even one, most of the streak goes, and only
a faint line stays where too much was predicted.

Only predicted ridges are corrected, so a frame without predicted streaks is unchanged. A bright or dark object of the
scene that lies along a predicted streak counts as a part of it, or hides it.

`remover.Remover.linear_flare` calls `correct_streaks`, except for frames that neighbours have corrected: these show
more of what a streak covers. Pixels are those of the working size.
"""
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels
from ..model.image_formation import GAMMA
from .filters import blur

MIN_LIGHT_BRIGHTNESS = 0.85
"""Smallest brightness (mean of the three display values) of a light that streaks may come from."""
MAX_LIGHT_AREA = 0.02
"""Greatest area of such a light, share of the frame."""
MAX_LIGHTS, MAX_STREAKS = 8, 16
"""Greatest numbers of lights, those with the most predicted flare about them, and of streaks in a frame."""
LIGHT_SURROUND = 0.03
"""Width of the surroundings of a light in which its predicted flare is measured, relative to the frame's long side."""
STREAK_START = (1.5, 0.012)
"""A streak begins at this multiple of its light's radius, plus this share of the frame's long side."""
DIRECTIONS = 720
"""Directions about a light in which streaks are looked for."""
MAX_STREAK_ANGLE = 16
"""Greatest angle that a streak covers as seen from its light, degrees."""
MIN_RIDGE = 0.001
"""Smallest mean ridge of a predicted streak, linear light; from there to twice as much the correction grows from none
to the whole."""
RIDGE_REACH = 0.12
"""Length over which that mean is taken, relative to the frame's long side."""
STRIP_WIDTH = 2.5
"""Width of a strip, relative to the width of its predicted ridge at half maximum."""
MIN_HALF_STRIP, MAX_HALF_STRIP = 5, 40
"""Bounds of half the width of a strip, pixels."""
MAX_GROWTH = 0.06
"""Greatest growth of half the width of a strip by distance."""
MAX_HALF_ANGLE = 0.7
"""Greatest angle between the middle and an edge of a strip as seen from the light, radians."""
MAX_GAIN = 3.0
"""Greatest factor by which a predicted ridge is raised."""
WINDOW_LENGTH, MAX_WINDOW = 0.05, 49
"""Length of the window of the running quartiles, relative to the frame's long side, and its bound, pixels."""
CORRELATION_LENGTH = 4.0
"""Distance at which the scene's detail is independent, pixels."""
MAX_STANDARD_ERRORS = 1.5
"""Standard errors of the median by which the range between the quartiles is widened on each side."""
FADE = 8
"""Length over which the correction fades in and out at the ends of a streak, pixels."""
EDGE_FADE = 2
"""Samples across a strip over which the correction fades at its edges."""
CLIPPED = 0.98
"""Display value from which on a pixel is clipped."""


class _Streak(NamedTuple):
    """A predicted streak.

    light: its place (x, y), pixels. direction: radians. start: distance from the light at which it begins, pixels.
    half_width, growth: half the width of its strip, pixels, as if at the light, and how much wider it gets by distance.
    strength: its mean ridge.
    """

    light: tuple[float, float]
    direction: float
    start: float
    half_width: float
    growth: float
    strength: float

    def half_width_at(self, distance: Any) -> Any:
        """Return half the width of the strip at distances from the light, pixels."""
        width = np.clip(self.half_width + self.growth * distance, MIN_HALF_STRIP, MAX_HALF_STRIP)
        return np.minimum(width, MAX_HALF_ANGLE * distance)


def correct_streaks(display: Pixels, flare: Pixels, confidence: float = 1.0) -> Pixels:
    """Return a linear flare whose streaks are corrected by the frame.

    display: the frame, display values 0..1. flare: the predicted linear flare, after its confidence. Both (h, w, 3), as
    the result. confidence: share of the measured ridges that counts, 0..1.
    """
    if not flare.any():
        return flare
    linear = np.asarray(display, np.float32) ** GAMMA
    streaks = [streak for place, radius in _find_bright_spots(display, flare)
               for streak in _find_streaks(flare, place, radius)]
    corrected = np.array(flare, np.float32)
    for streak in sorted(streaks, key=lambda streak: -streak.strength)[:MAX_STREAKS]:
        _correct_streak(display, linear, corrected, streak, confidence)
    return corrected


def _find_bright_spots(display: Pixels, flare: Pixels) -> list[tuple[tuple[float, float], float]]:
    """Return place (x, y) and radius, pixels, of the bright spots with the most predicted flare about them."""
    import cv2

    brightness, amount = display.mean(-1), flare.mean(-1)
    count, _, statistics, centres = cv2.connectedComponentsWithStats(
        (brightness > MIN_LIGHT_BRIGHTNESS).astype(np.uint8))
    side = int(LIGHT_SURROUND * max(brightness.shape)) | 1
    about = np.asarray(cv2.blur(amount, (side, side)))
    found = []
    for label in range(1, count):
        area = int(statistics[label, cv2.CC_STAT_AREA])
        if area <= MAX_LIGHT_AREA * brightness.size:
            x, y = centres[label]
            found.append((float(about[round(y), round(x)]), (float(x), float(y)), math.sqrt(area / math.pi)))
    return [(place, radius) for _, place, radius in sorted(found, reverse=True)[:MAX_LIGHTS]]


def _find_streaks(flare: Pixels, light: tuple[float, float], radius: float) -> list[_Streak]:
    """Return the streaks of one light: directions in which the predicted flare (h, w, 3) has a ridge."""
    import cv2

    long_side = max(flare.shape[:2])
    start, reach = STREAK_START[0] * radius + STREAK_START[1] * long_side, round(RIDGE_REACH * long_side)
    amount = np.ascontiguousarray(flare.mean(-1))
    radii = round(start) + 2 * reach
    polar = np.asarray(cv2.warpPolar(amount, (radii, DIRECTIONS), light, radii,
                                     cv2.INTER_LINEAR | cv2.WARP_FILL_OUTLIERS))[:, round(start):]
    window = round(MAX_STREAK_ANGLE / 360 * DIRECTIONS) | 1
    padded = np.concatenate([polar[-2 * window:], polar, polar[:2 * window]])
    ridge = padded - np.asarray(cv2.morphologyEx(padded, cv2.MORPH_OPEN, np.ones((window, 1), np.uint8)))
    # Mean ridge by direction, (DIRECTIONS + 2 window,), over three parts of the radii.
    inner, outer, far = (blur(part.mean(1)[None], 1.5)[0]
                         for part in np.split(ridge[window:-window], (reach // 2, reach), axis=1))
    near = np.minimum(inner, outer)  # a streak is long, a bright spot beside the light is not
    streaks = []
    for peak in range(window, window + DIRECTIONS):
        around = slice(peak - window, peak + window + 1)
        if near[peak] > MIN_RIDGE and peak == around.start + int(near[around].argmax()):
            widths = [_half_width(profile[around], distance) for profile, distance in
                      ((near, start + reach / 2), (far, start + 1.5 * reach))]
            growth = float(np.clip((widths[1] - widths[0]) / reach, 0, MAX_GROWTH))
            streaks.append(_Streak(light, 2 * math.pi * (peak - window) / DIRECTIONS, start,
                                   widths[0] - growth * (start + reach / 2), growth, float(near[peak])))
    return streaks


def _half_width(profile: NDArray[np.float32], distance: float) -> float:
    """Return half the width of a strip for a ridge of this profile across directions, at a distance, pixels."""
    directions = np.count_nonzero(profile > profile.max() / 2)
    return STRIP_WIDTH / 2 * directions * 2 * math.pi / DIRECTIONS * distance


def _correct_streak(display: Pixels, linear: Pixels, flare: Pixels, streak: _Streak, confidence: float) -> None:
    """Clamp the ridge of one streak of a linear flare to what the frame shows; writes to `flare`.

    display, linear: the frame, display values and linear light. flare: linear light. All (h, w, 3).
    """
    height, width = linear.shape[:2]
    length = _length_inside(streak, width, height)
    if length < 2 * MIN_HALF_STRIP:
        return
    half = math.ceil(streak.half_width_at(streak.start + length))
    offset = np.linspace(-1, 1, 2 * half + 1, dtype=np.float32)[None]
    shift = np.zeros(length, np.float32)
    for _ in range(2):
        shift += _ridge_shift(_above_edges(_sample(flare, *_strip_places(streak, offset, shift))).mean(-1), streak)
    x, y = _strip_places(streak, offset, shift)
    predicted, seen = _sample(flare, x, y), _sample(linear, x, y)
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    has_edges = inside[:, :2].all(1) & inside[:, -2:].all(1)  # without both edges there is nothing to compare with
    known = inside & has_edges[:, None] & (_sample(display, x, y).max(-1) < CLIPPED)
    window = min(round(WINDOW_LENGTH * max(height, width)), MAX_WINDOW) | 1
    own = _above_edges(predicted)
    change = _clamp_ridge(own, seen, predicted, _running_quartiles(_above_edges(seen), known, window), confidence) - own
    from_ends = np.minimum(np.arange(length), length - np.arange(length)) / FADE
    from_edges = (1 - np.abs(offset)) * half / EDGE_FADE
    change *= (np.clip(from_ends, 0, 1)[:, None] * np.clip(from_edges, 0, 1))[..., None]
    change *= min(streak.strength / MIN_RIDGE - 1, 1)
    area = tuple(slice(max(0, int(values.min()) - 1), max(0, int(values.max()) + 2)) for values in (y, x))
    _add_strip(flare, change, streak, shift, area)
    np.clip(flare[area], 0, linear[area], out=flare[area])


def _clamp_ridge(own: Pixels, seen: Pixels, predicted: Pixels, measured: tuple[Pixels, Pixels, Pixels],
                 confidence: float) -> Pixels:
    """Return the predicted ridge, clamped to the measured one; all arguments and the result (length, width, channels).

    own: the predicted ridge. seen, predicted: light of the frame, and predicted flare. measured: the result of
    `_running_quartiles` for the frame's ridge.
    """
    import cv2

    low, high, error = measured
    known = np.isfinite(error)
    error = np.where(known, MAX_STANDARD_ERRORS * error, 0)
    least = confidence * np.minimum(_unimodal(np.maximum(low - error, 0)), MAX_GAIN * own)
    # Nothing is made darker than what is beside the streak.
    least = np.minimum(least, own + np.maximum(cv2.blur(_above_edges(seen - predicted), (3, 3)), 0))
    most = np.maximum(confidence * (np.maximum(high, 0) + error), least)
    return np.asarray(np.where(known & (own > 0), np.clip(own, least, most), own), np.float32)


def _sample(picture: Pixels, x: Pixels, y: Pixels) -> Pixels:
    """Sample a picture at places (x, y), pixels, by bilinear interpolation; 0 outside."""
    import cv2

    return np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))


def _strip_places(streak: _Streak, offset: Pixels, shift: NDArray[np.float32]) -> tuple[Pixels, Pixels]:
    """Return the places (x, y) of a strip's samples, each (length, width), pixels.

    offset: across the strip, -1..1, (1, width). shift: of its middle at each distance, pixels, (length,).
    """
    distance = np.arange(len(shift), dtype=np.float32)[:, None] + np.float32(streak.start)
    angle = streak.direction + (offset * streak.half_width_at(distance) + shift[:, None]) / distance
    return (np.asarray(streak.light[0] + distance * np.cos(angle), np.float32),
            np.asarray(streak.light[1] + distance * np.sin(angle), np.float32))


def _ridge_shift(ridge: Pixels, streak: _Streak) -> NDArray[np.float32]:
    """Return how far a ridge (length, width) lies beside the middle of its strip, pixels, (length,): a parabola along
    the streak, weighted by the ridge."""
    weight = np.maximum(ridge, 0) ** 2
    distance = np.arange(len(ridge)) + streak.start
    half_width = streak.half_width_at(distance)
    place = np.linspace(-1, 1, ridge.shape[1])[None] * half_width[:, None]
    total = weight.sum(1)
    if np.count_nonzero(total > 1e-3 * total.max()) < 8:
        return np.zeros(len(ridge), np.float32)
    centre = (weight * place).sum(1) / np.maximum(total, 1e-12)
    fit = np.polynomial.Polynomial.fit(distance, centre, 2, w=np.sqrt(total / total.max()))
    return np.asarray(np.clip(fit(distance), -half_width, half_width), np.float32)


def _length_inside(streak: _Streak, width: int, height: int) -> int:
    """Return the length of a streak from its start to the border of the frame, pixels."""
    steps = []
    for place, step, size in ((streak.light[0], math.cos(streak.direction), width),
                              (streak.light[1], math.sin(streak.direction), height)):
        if abs(step) > 1e-6:
            steps.append(((size - 1 if step > 0 else 0) - place) / step)
    return max(0, int(min(steps) - streak.start))


def _above_edges(strip: Pixels) -> Pixels:
    """Return what a strip (length, width, channels) has above the straight line between its two edges."""
    share = np.linspace(0, 1, strip.shape[1], dtype=np.float32)[None, :, None]
    left, right = strip[:, :2].mean(1)[:, None], strip[:, -2:].mean(1)[:, None]
    return np.asarray(strip - (left * (1 - share) + right * share))


def _running_quartiles(strip: Pixels, known: NDArray[np.bool_], window: int) -> tuple[Pixels, Pixels, Pixels]:
    """Return the running quartiles along a strip (length, width, channels), and the median's standard error, infinite
    where less than half of the window is known. known: (length, width)."""
    half = window // 2
    values = np.where(known[..., None], strip, np.float32(np.inf))  # unknown values sort to the end
    padded = np.pad(values, ((half, half), (0, 0), (0, 0)), constant_values=np.inf)
    windows = np.sort(np.lib.stride_tricks.sliding_window_view(padded, window, axis=0), axis=-1)
    samples = np.maximum(np.isfinite(windows).sum(-1), 1)
    low, high = (np.take_along_axis(windows, ((samples - 1) * share).astype(int)[..., None], -1)[..., 0]
                 for share in (0.25, 0.75))
    unknown = samples < window / 2
    low, high = (np.where(unknown, 0, quartile) for quartile in (low, high))
    # Of normally distributed values the quartiles are 1.349 standard deviations apart, and the median's error is
    # sqrt(pi / 2) of the mean's.
    error = math.sqrt(math.pi / 2) * (high - low) / 1.349 / np.sqrt(samples / CORRELATION_LENGTH)
    return low, high, np.where(unknown, np.float32(np.inf), error)


def _unimodal(ridge: Pixels) -> Pixels:
    """Lower a ridge (length, width, channels) so that it falls from its middle to both edges."""
    middle = ridge.shape[1] // 2
    return np.concatenate([np.minimum.accumulate(ridge[:, middle::-1], 1)[:, ::-1],
                           np.minimum.accumulate(ridge[:, middle:], 1)[:, 1:]], 1)


def _add_strip(flare: Pixels, strip: Pixels, streak: _Streak, shift: NDArray[np.float32],
               area: tuple[slice, ...]) -> None:
    """Add a strip (length, width, channels) of a streak to a picture (h, w, channels), in place.

    shift: of the strip's middle, as in `_strip_places`. area: rows and columns that hold the strip.
    """
    part = flare[area]
    dx = np.arange(part.shape[1], dtype=np.float32)[None] + np.float32(area[1].start - streak.light[0])
    dy = np.arange(part.shape[0], dtype=np.float32)[:, None] + np.float32(area[0].start - streak.light[1])
    distance = np.maximum(np.hypot(dx, dy), np.float32(1e-3))
    along = distance - np.float32(streak.start)
    turn = (np.arctan2(dy, dx) - np.float32(streak.direction) + np.float32(math.pi)) % np.float32(2 * math.pi)
    beside = (turn - np.float32(math.pi)) * distance - _sample(shift[:, None], np.zeros_like(along), along)
    across = (beside / streak.half_width_at(distance) + 1) * ((strip.shape[1] - 1) / 2)
    part += _sample(strip, across.astype(np.float32), along)
