# SPDX-License-Identifier: GPL-3.0-or-later
"""Test-time augmentation: predicts the flare of one frame from scaled and rotated copies, and merges the predictions.

The network runs on the frame upright and rotated by 180 degrees, at two sizes, and once more with the black point
stretched to 0; `confidence` judges by the disagreement of the predictions whether there is a flare at all.

In dark frames it runs on each channel alone, too, as a grey frame: the glow of a traffic light is seldom predicted in
colour, while in the red channel it looks like that of any other light. The prediction per channel counts where it is of
one colour and exceeds the other. For a white light it would be wrong: where one channel is clipped and another is not,
the flare would be removed in another colour than it was added in.

`remover` calls `predict_with_tta`; `temporal` merges the result with that of neighbouring frames.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ...colour.srgb import Pixels
from ..model.image_formation import GAMMA, flare_to_linear, to_display
from ..model.network import SIZE_MULTIPLE
from .confidence import MIN_MEAN, confidence_from_log_odds, extract_features, gate_by_mean, stretch_black_point
from .prediction import TtaPrediction, single_prediction

PredictFn = Callable[[Pixels], Pixels]
"""One pass of the network: display values 0..1 (h, w, 3), h and w multiples of SIZE_MULTIPLE, to (h, w, 6): what a
flare adds to them, and what of that is glow about lights."""

SCALES, QUARTER_TURNS = (1.0, 0.8), (0, 2)
"""Augmentations in colour: every scale of the frame in every rotation. Predictions are weighted by their pixels."""
CHANNEL_SCALE = 0.8
"""Scale of the augmentations of a single channel."""
CHANNEL_DISAGREEMENT_RAMP, CHANNEL_PENALTY = (0.12, 0.2), (0.0, 2.5)
"""Disagreement of the predictions of a single channel (about 0.1 for the glow of a traffic light, 0.2 for neon without
glow), and the number of standard deviations subtracted from their mean there; linear in between."""
DARK_FRAME_RAMP = (0.25, 0.4)
"""Median display value at which the per-channel prediction counts fully and not at all."""
SINGLE_COLOUR_RAMP = (0.15, 0.4)
"""Light of the second strongest channel relative to the strongest at which a flare counts as of one colour fully and
not at all."""
MIN_MEAN_PER_CHANNEL = 0.004
"""Gate (`gate_by_mean`) of what the per-channel prediction adds to the one in colour, display values."""


def predict_with_tta(display: Pixels, predict: PredictFn) -> TtaPrediction:
    """Predict the flare of display values 0..1 (h, w, 3), h and w multiples of SIZE_MULTIPLE.

    predict: one pass of the network (`PredictFn`). Channels are predicted one by one in dark frames only, and features
    computed only where the mean exceeds MIN_MEAN.
    """
    flares, glows = map(np.concatenate, zip(*(_predict_rotated(predict, display, scale) for scale in SCALES),
                                            strict=True))
    weights = np.repeat(np.square(SCALES), len(QUARTER_TURNS)).astype(np.float32)
    mean = np.average(flares, 0, weights)
    prediction = single_prediction(mean)._replace(
        glow_fraction=np.clip(np.average(glows, 0, weights) / np.maximum(mean, 1e-9), 0, 1))
    darkness = np.float32(np.interp(np.median(display), DARK_FRAME_RAMP, (1, 0)))
    if darkness > 0:
        per_channel = np.stack([_predict_channel(predict, display, channel) for channel in range(3)], -1)
        single_colour = _single_colour_weight(flare_to_linear(display, per_channel))
        prediction = prediction._replace(per_channel=per_channel, per_channel_weight=darkness * single_colour)
    if mean.mean() > MIN_MEAN:
        deviation = np.sqrt(np.average(np.square(flares - mean), 0, weights))
        regraded, _ = _predict_rotated(predict, stretch_black_point(display), SCALES[0])
        prediction = prediction._replace(features=extract_features(display, mean, deviation, regraded.mean(0)))
    return prediction


def merge_flare(prediction: TtaPrediction) -> Pixels:
    """Return what a flare adds to display values (h, w, 3): the prediction in colour, plus the weighted and gated
    excess of the per-channel prediction over it."""
    flare = prediction.mean
    if prediction.per_channel_weight > 0:
        excess = prediction.per_channel_weight * np.maximum(prediction.per_channel - flare, 0)
        flare = flare + gate_by_mean(excess, MIN_MEAN_PER_CHANNEL)
    return flare


def shot_confidence(frames: Sequence[tuple[TtaPrediction, float]], log_odds_bias: float = 0) -> np.float32:
    """Return the confidence in a predicted flare, 0..1, from the predictions of frames of one shot with their weights.

    The log odds are averaged: a flare that is plain in neighbouring frames is trusted in this one too and does not
    flicker. 1 where no frame has features. log_odds_bias: added to the log odds (`confidence.Sensitivity`).
    """
    weighted = [(prediction.features.log_odds, weight) for prediction, weight in frames
                if prediction.features is not None and weight > 0]
    if not weighted:
        return np.float32(1)
    log_odds, weights = zip(*weighted, strict=True)
    return confidence_from_log_odds(float(np.average(log_odds, weights=weights)) + log_odds_bias)


def _predict_channel(predict: PredictFn, display: Pixels, channel: int) -> Pixels:
    """Predict the flare of one channel as a grey frame, (h, w), less a penalty for disagreement."""
    grey = np.repeat(display[..., channel, None], 3, -1)
    flares, _ = _predict_rotated(predict, grey, CHANNEL_SCALE)
    predictions = flares.mean(-1)
    mean, deviation = np.mean(predictions, 0), np.std(predictions, 0)
    disagreement = deviation.mean() / max(np.abs(mean).mean(), 1e-9)
    penalty = np.float32(np.interp(disagreement, CHANNEL_DISAGREEMENT_RAMP, CHANNEL_PENALTY))
    return np.asarray(np.maximum(mean - penalty * deviation, 0), np.float32)


def _single_colour_weight(light: Pixels) -> np.float32:
    """Return how far light (h, w, 3) is of one colour, 0..1."""
    _, second, strongest = np.sort(light.mean((0, 1)))
    return np.float32(np.interp(second / max(strongest, 1e-9), SINGLE_COLOUR_RAMP, (1, 0)))


def _predict_rotated(predict: PredictFn, display: Pixels, scale: float) -> tuple[Pixels, Pixels]:
    """Return the flare predicted at one scale in every rotation, and its glow, (rotations, h, w, 3) each."""
    predictions = np.stack([_predict_augmented(predict, display, scale, turns) for turns in QUARTER_TURNS])
    return predictions[..., :3], predictions[..., 3:]


def _predict_augmented(predict: PredictFn, display: Pixels, scale: float, turns: int) -> Pixels:
    """Return what is predicted at one scale and rotation, (h, w, 6), transformed back to the frame.

    turns: number of rotations by 90 degrees. The frame is scaled in linear light.
    """
    import cv2

    height, width = display.shape[:2]
    rows, columns = (max(round(side * scale / SIZE_MULTIPLE), 2) * SIZE_MULTIPLE for side in (height, width))
    augmented = display
    if (rows, columns) != (height, width):
        augmented = to_display(np.asarray(cv2.resize(display**GAMMA, (columns, rows), interpolation=cv2.INTER_AREA)),
                               GAMMA)
    prediction = np.ascontiguousarray(np.rot90(predict(np.rot90(augmented, turns)), -turns))
    return np.asarray(cv2.resize(prediction, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
