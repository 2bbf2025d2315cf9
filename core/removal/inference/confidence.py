# SPDX-License-Identifier: GPL-3.0-or-later
"""Confidence that a predicted flare is a flare, not a part of the scene or of its grade.

A logistic regression on five features of the prediction. A flare is predicted under every test-time augmentation; a
scene that resembles one often only under some. A flare is brightest near its light and falls off from there; snow,
haze and white walls are as even or as patchy as they are in the scene. A grade that lifts black to grey looks much like
a veil, but a grade lifts display values where a veil adds light. So the frame's black point is stretched back to 0 and
the network runs again: for a lifted black it then predicts nothing, for most flares the same as before, since they are
not even.

`test_time_augmentation` computes the features, `temporal` combines those of neighbouring frames.
"""
from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...colour.srgb import Pixels
from ..model.image_formation import flare_to_linear
from .filters import downsample

MIN_MEAN = 0.0005
"""Mean of a predicted flare (display values) from which on its confidence is computed; fainter ones are gated anyway.
"""
BLACK_QUANTILE = 0.002
"""Quantile of a channel that is stretched to 0."""
REGRADED_FLOOR = 0.02
"""Added to the regraded ratio before the logarithm."""
DISAGREEMENT_FLOOR = 0.05
"""Added to the disagreement before the logarithm."""
LIGHT_FLOOR = 0.002
"""Added to the mean linear light before the logarithm."""
PATCHES_PER_SIDE = 8
"""Patches along the long side of a frame; detail narrower than one patch is fine."""
FEATURE_WEIGHTS, BIAS = (0.6, 0.6, -2.0, 0.9, -2.0), 0.5
"""Weights of the `FlareFeatures` in their order, and the bias, of the log odds of a flare; rounded."""
LOG_ODDS_RAMP = (-0.25, 0.25)
"""Log odds at which the confidence is 0 and 1; linear in between."""


class Sensitivity(NamedTuple):
    """How much evidence the removal of a flare needs.

    log_odds_bias: added to the log odds of a flare before they become the confidence. gate: factor on the
    smallest mean that a predicted flare needs in order to count (`gate_by_mean`).
    """

    log_odds_bias: float
    gate: float


SENSITIVITIES = {"low": Sensitivity(-1.0, 2.0), "normal": Sensitivity(0.0, 1.0), "high": Sensitivity(2.0, 0.25)}
"""The artist's choices by name. "high" is for plates that are known to have a flare."""


class FlareFeatures(NamedTuple):
    """Five features of a predicted flare.

    regraded_ratio: log of (mean prediction for the frame with its black point stretched / mean prediction).
    light: log of the mean linear light.
    disagreement: log of (standard deviation over test-time augmentations / mean).
    peak: log of (maximum / mean).
    fine_fraction: share of the prediction that lies in detail narrower than one patch.
    """

    regraded_ratio: float
    light: float
    disagreement: float
    peak: float
    fine_fraction: float

    @property
    def log_odds(self) -> float:
        """Log odds that the prediction is a flare."""
        return float(np.dot(FEATURE_WEIGHTS, self) + BIAS)


def extract_features(display: Pixels, mean_prediction: Pixels, deviation: Pixels,
                     regraded_prediction: Pixels) -> FlareFeatures:
    """Compute the features of a prediction, all arguments (h, w, 3).

    display: the frame, display values 0..1. mean_prediction, deviation: mean and standard deviation of the predicted
    flare over test-time augmentations. regraded_prediction: the flare predicted for `stretch_black_point(display)`.
    """
    import cv2

    mean = max(float(mean_prediction.mean()), 1e-9)
    coarse = downsample(mean_prediction.mean(-1))
    patch = max(coarse.shape) // PATCHES_PER_SIDE | 1  # odd, so that it has a centre
    # The morphological opening removes what is narrower than a patch.
    broad = cv2.morphologyEx(coarse, cv2.MORPH_OPEN, np.ones((patch, patch), np.uint8))
    return FlareFeatures(
        regraded_ratio=float(np.log(regraded_prediction.mean() / mean + REGRADED_FLOOR)),
        light=float(np.log(flare_to_linear(display, mean_prediction).mean() + LIGHT_FLOOR)),
        disagreement=float(np.log(deviation.mean() / mean + DISAGREEMENT_FLOOR)),
        peak=float(np.log(max(coarse.max(), 1e-9) / mean)),
        fine_fraction=1 - float(broad.mean()) / mean)


def stretch_black_point(display: Pixels) -> Pixels:
    """Stretch display values 0..1 (h, w, 3) so that the black of each channel is 0."""
    black = np.quantile(display.reshape(-1, 3), BLACK_QUANTILE, axis=0).astype(np.float32)
    # The bound of 0.1 keeps frames that are nearly white from being amplified without limit.
    return np.asarray(np.clip((display - black) / np.maximum(1 - black, 0.1), 0, 1), np.float32)


def confidence_from_log_odds(log_odds: float) -> np.float32:
    """Return the confidence, 0..1, of log odds that include the bias of the `Sensitivity`."""
    return np.float32(np.interp(log_odds, LOG_ODDS_RAMP, (0, 1)))


def gate_by_mean(flare: Pixels, min_mean: float) -> Pixels:
    """Scale a predicted flare by a gate that opens with its mean over the frame: 0 up to `min_mean`, 1 from twice that
    on."""
    return np.asarray(flare * np.clip((flare.mean() - min_mean) / max(min_mean, 1e-9), 0, 1), np.float32)
