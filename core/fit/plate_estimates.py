# SPDX-License-Identifier: GPL-3.0-or-later
"""Improves the plates of a shot by what neighbouring frames show of the same background.

The removal network cleans each frame by itself, and misses the same sharp ghosts in many. Other frames show the
background without flare in that place. So each frame is compared with the median of its aligned neighbours, the
background, times a gain that changes smoothly over the picture, since light on the walls changes from frame to frame.
The gain ignores what is small: ghosts. It follows the texture too, for light on a wall raises its texture, and a flare
does not.

A flare adds light and hides nothing. So something before the background shows itself: a channel is darker than the
background, the background's texture is absent, or the gain is far from 1. There the network's plate stays. Elsewhere
the background counts.

Where the camera stands, the background is exact: the gain is that of the frame, so that light on walls stays where the
network has removed it, and the background replaces the network's plate. Where frames are aligned, the gain is that of
the network's plate, and the plate only becomes darker, by small differences: those over large areas come from the gain
as often as from a flare.

`plate_trainer` calls it before a fit, and during it with the fitted flare subtracted, if the settings say so.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..colour.srgb import linear_from_srgb, srgb_from_linear
from .plate_alignment import Alignment

Pixels = NDArray[np.float32]

DARK = 0.02
"""Linear light that is added to denominators, so that relative errors of dark pixels are those of display values."""
MIN_NEIGHBOURS = 3
"""Number of aligned neighbours from which the background counts fully."""
GAIN_WINDOW, TEXTURE_WINDOW = 0.06, 0.012
"""Standard deviations of the windows of the gain and of the test of texture, as shares of the frame's width."""
GAIN_ERROR, GAIN_REWEIGHTINGS = 0.04, 8
"""Relative error at which a pixel counts half for the gain, and the number of reweightings."""
LIGHT_WINDOW, MAX_LOCAL_GAIN = 0.025, 2.5
"""Standard deviation of the window of the local gain, as a share of the frame's width, and the largest local gain."""
USABLE = 0.9
"""Linear light above which a frame is as good as clipped."""
NOISE = 0.004
"""Noise of display values, as a standard deviation."""
DISPLAY_SLOPE = 2.4
"""Change of the logarithm of linear light with that of display values."""
WINDOW_SAMPLES, TEXTURE_TOLERANCE, MAX_DEVIATION = 20.0, 0.25, 2.0
"""Independent pixels of the window of texture; error of the local gain where the fit is exact; and deviations below 1
at which the local gain says that the background's texture is absent."""
MAX_GAIN = 2.2
"""Gain, or its inverse, at which the background counts as half hidden."""
GHOST_RADIUS = 0.06
"""Half the side of the window, as a share of the frame's width, about which missed flare is smaller."""
MAX_MISSED_FLARE = 0.6
"""Difference of display values that the network does not miss: a larger one counts as half hidden."""
GROWTH = 0.012
"""Radius by which hidden areas are grown, as a share of the frame's width."""


class HidingTest(NamedTuple):
    """What counts as hidden: the mean relative deficit of a channel at which the background is half hidden, and the
    radius by which hidden areas are closed, as a share of the frame's width."""

    max_deficit: float
    closing: float


STANDING_TEST, MOVING_TEST = HidingTest(0.25, 0.02), HidingTest(0.08, 0.05)
"""The tests for a camera that stands and for one that moves. Where it stands, deficits come mostly from the gain, and a
thing that keeps its place in the picture belongs to the background. Where it moves, such a thing looks like a flare."""


@dataclass(frozen=True)
class ShotFrames:
    """The frames and the network's plates of a shot by name, in order, display values (height, width, 3), one size."""

    frames: Mapping[str, Pixels]
    plates: Mapping[str, Pixels]


class PlateEstimator:
    """Estimates plates of a shot; the alignments of its frames are computed once."""

    def __init__(self, shot: ShotFrames) -> None:
        self._shot = shot
        self.alignment = Alignment(shot.plates)

    def estimate(self, name: str, cleaned: Mapping[str, Pixels] | None = None) -> Pixels:
        """Return the plate of a frame, display values (height, width, 3); the network's if no neighbour can be aligned.

        The background is the median of the aligned plates, times a smooth gain. Where nothing hides it, it replaces the
        network's plate; if the camera moves, it only makes the plate darker, in small parts. cleaned: frames minus the
        fitted flare, which replace the network's plates in the median. The frame itself is used as filmed: a flare
        subtracted from the frame that it was fitted to would hide its own errors.
        """
        shot, alignment = self._shot, self.alignment
        plates = shot.plates if cleaned is None else cleaned
        aligned = [warped for other in alignment.neighbours(name)
                   if (warped := alignment.align(plates[other], other, name)) is not None]
        if not aligned:
            return shot.plates[name]
        stack = np.stack([plates[name], *aligned])
        count = np.isfinite(stack[..., 0]).sum(0) - 1  # neighbours only
        background = linear_from_srgb(_median(stack))
        frame, network_plate = linear_from_srgb(shot.frames[name]), linear_from_srgb(shot.plates[name])
        usable = (frame.max(-1, keepdims=True) < USABLE).astype(np.float32)
        gain_source = frame if alignment.stands else network_plate
        gain = smooth_gain(gain_source, background, usable)
        gain = gain * local_gain(gain_source, gain * background)
        test = STANDING_TEST if alignment.stands else MOVING_TEST
        hidden = hidden_share(frame, gain * background, gain, test)
        confidence = ((1 - hidden) * np.clip(count / MIN_NEIGHBOURS, 0, 1))[..., None]
        expected = np.minimum(gain * background, frame)  # a flare only adds light: no plate is brighter than its frame
        if alignment.stands:
            change = srgb_from_linear(expected.clip(0)) - shot.plates[name]
        else:  # the plate only becomes darker
            change = -_small_parts(shot.plates[name] - srgb_from_linear(np.minimum(expected, network_plate).clip(0)))
        # A change that is very large is no missed flare.
        confidence = confidence / (1 + (change.min(-1, keepdims=True) / MAX_MISSED_FLARE) ** 4)
        return np.asarray(shot.plates[name] + confidence * change, np.float32)


def _median(stack: Pixels) -> Pixels:
    """Return the median (height, width, 3) of pictures (n, height, width, 3), without NaN; the first has none."""
    count = np.isfinite(stack[..., 0]).sum(0)
    ordered = np.sort(stack, 0)  # NaN comes last
    low, high = ((count - 1) // 2)[None, ..., None], (count // 2)[None, ..., None]
    middle = np.take_along_axis(ordered, low, 0)[0] + np.take_along_axis(ordered, high, 0)[0]
    return np.asarray(middle / 2, np.float32)


def _small_parts(excess: Pixels) -> Pixels:
    """Return by how much an excess (height, width, 3), display values of 0 or more, exceeds its median in a window.

    So only parts smaller than the window remain. The network misses what is small, and an excess over a large area
    comes from a wrong gain as often as from a flare.
    """
    import cv2

    size = 2 * max(int(GHOST_RADIUS * excess.shape[1]), 1) + 1
    codes = np.clip(excess * 255 + 0.5, 0, 255).astype(np.uint8)
    wide = np.stack([cv2.medianBlur(codes[..., channel], size) for channel in range(3)], -1)
    return np.asarray(np.maximum(excess - wide.astype(np.float32) / 255, 0), np.float32)


def _blur(values: Pixels, sigma: float) -> Pixels:
    import cv2

    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma), np.float32).reshape(values.shape)


def smooth_gain(picture: Pixels, background: Pixels, usable: Pixels) -> Pixels:
    """Return a smooth gain (height, width, 3) of a picture over a background: picture = gain * background nearby.

    It is fitted to relative errors in a Gaussian window by iteratively reweighted least squares: pixels that differ
    from gain * background count less, since they may hold flare. picture, background: (height, width, 3), linear light.
    usable: (height, width, 1), weights of the pixels.
    """
    sigma = max(GAIN_WINDOW * picture.shape[1], 1.0)
    base = usable / (background + DARK) ** 2
    weight, prior = base, 1e-5  # prior: weight of a gain of 1, which is taken where nothing is usable
    for _ in range(GAIN_REWEIGHTINGS):
        gain = (_blur(weight * picture * background, sigma) + prior) / (_blur(weight * background**2, sigma) + prior)
        error = (picture - gain * background) / (background + DARK)
        weight = base / (1 + (error / GAIN_ERROR) ** 2)
    return np.asarray(gain, np.float32)


def hidden_share(frame: Pixels, expected: Pixels, gain: Pixels, test: HidingTest) -> NDArray[np.float32]:
    """Return (height, width), 0..1, how likely something hides the background of a frame.

    The largest of three likelihoods counts: a channel is darker than expected, the background's texture is absent, or
    the gain is far from 1. frame: (height, width, 3), linear light. expected: the frame expected without flare,
    background times gain. gain: `smooth_gain` times `local_gain`. test: thresholds,
    for a camera that stands or for one that moves.
    """
    import cv2

    width = frame.shape[1]
    sigma = max(TEXTURE_WINDOW * width, 1.0)
    deficit = _blur(np.maximum(-((frame - expected) / (expected + DARK)).min(-1), 0).clip(0, 1), sigma)
    visible = expected.mean(-1) > NOISE
    change = np.abs(np.log(np.maximum(gain.mean(-1), 1e-3)))
    hidden = np.maximum(_logistic(deficit, test.max_deficit, 60),
                        _logistic(_texture_deviation(frame, expected, sigma), MAX_DEVIATION, 4))
    hidden = np.maximum(hidden, visible * _logistic(change, np.log(MAX_GAIN), 8)).astype(np.float32)

    def disc(share: float) -> NDArray[np.uint8]:
        return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * int(share * width) + 1,) * 2), np.uint8)

    hidden = cv2.dilate(cv2.morphologyEx(hidden, cv2.MORPH_CLOSE, disc(test.closing)), disc(GROWTH))
    return _blur(np.asarray(hidden, np.float32), max(GROWTH * width / 2, 0.5))


def _logistic(values: Pixels, middle: float, steepness: float) -> Pixels:
    """Return the logistic function of values: 0 far below `middle`, 0.5 there, 1 far above it. steepness: 4 times the
    slope there."""
    return np.asarray(1 / (1 + np.exp(np.clip(-steepness * (values - middle), -50, 50))), np.float32)


def local_gain(picture: Pixels, expected: Pixels) -> Pixels:
    """Return the gain (height, width, 1) of the texture of a picture over that of the expected one, linear light.

    Light on a wall raises the wall's texture too; a flare adds light alone. The gain returned is the estimate less one
    standard error, the smallest that the texture makes likely, between 1 and MAX_LOCAL_GAIN.
    """
    sigma = max(LIGHT_WINDOW * picture.shape[1], 1.0)
    gain, error = _line_gain(picture, expected, sigma)
    change = np.clip(gain - error, 1, MAX_LOCAL_GAIN)
    return np.asarray(change, np.float32)[..., None]


def _texture_deviation(frame: Pixels, expected: Pixels, sigma: float) -> Pixels:
    """Return (height, width), by how many standard errors the gain of a local line frame = gain * expected + flare lies
    below 1.

    A flare leaves the gain at 1, since it adds light that does not depend on the texture; where something hides the
    background, its texture is missing and the gain falls.
    """
    gain, error = _line_gain(frame, expected, sigma)
    return np.asarray((1 - gain) / np.hypot(error, TEXTURE_TOLERANCE), np.float32)


def _line_gain(frame: Pixels, expected: Pixels, sigma: float) -> tuple[Pixels, Pixels]:
    """Return the gain of a local line frame = gain * expected + flare, and its standard error, (height, width) each.

    frame, expected: (height, width, 3), linear light. sigma: standard deviation of the window, pixels. The channels
    share one gain. Where the texture is weaker than the noise, the gain tends to 1.
    """
    weight = 1 / (expected.mean(-1, keepdims=True) + DARK) ** 2
    total = _blur(weight, sigma)

    def mean(values: Pixels) -> Pixels:
        return _blur(np.asarray(weight * values, np.float32), sigma) / total

    mean_frame, mean_expected = mean(frame), mean(expected)
    variance = (mean(expected**2) - mean_expected**2).sum(-1).clip(0)
    covariance = (mean(frame * expected) - mean_frame * mean_expected).sum(-1)
    spread = (mean(frame**2) - mean_frame**2).sum(-1).clip(0)
    noise = 3 * (NOISE * (mean_expected.mean(-1) + DARK) * DISPLAY_SLOPE) ** 2  # variance of linear light, 3 channels
    gain = (covariance + noise) / (variance + noise)
    unexplained = (spread - np.clip(gain, 0, 2) * covariance).clip(0)
    return gain, np.sqrt((unexplained + noise) / (WINDOW_SAMPLES * (variance + noise)))
