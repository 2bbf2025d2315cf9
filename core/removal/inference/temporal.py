# SPDX-License-Identifier: GPL-3.0-or-later
"""Temporal filter: corrects the prediction for a frame with those for neighbouring frames of its shot.

A flare moves as nothing in the scene does: what it covers in one frame is visible in another. So each place is followed
by optical flow into the neighbouring frames. The scene there is estimated as the weighted median of the clean frames,
at one exposure; weights are the confidence of the flow and the absence of flare, since where hardly any flare is
predicted the scene was seen. The difference to the frame's own clean estimate is the residual flare, which is added to
the prediction. That makes the clean frames steady, too: a network that sees single frames predicts a little more in one
and a little less in the next.

Only the smooth part of the residual is used, since a frame has detail of its own, and its magnitude is bounded by the
flare predicted about a place: where there is no flare, a light that turns on changes nothing. Places that no
neighbouring frame shows keep the prediction.

The confidence (`confidence`) is that of the shot: a flare that is plain in most frames does not vanish in the others.
Frames belong to one shot by their detail (`shot_similarity`). `neighbours` finds them among the files and calls
`filter_in_time`.
"""
from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...colour.srgb import Pixels
from . import optical_flow
from .filters import blur, downsample, upsample
from .plate_light import CLIPPING_LEVEL
from .prediction import FlarePrediction, TtaPrediction
from .test_time_augmentation import merge_flare, shot_confidence

HALF_WEIGHT_FLARE = 0.03
"""Predicted flare, in display values, at which a frame has half the weight that it has without flare."""
RESIDUAL_SIGMA, BOUND_SIGMA = 2.5, 4.0
"""Standard deviations of the blurs of the residual and of the flare that bounds it, pixels of the flow."""
SCENE_SIGMA = 0.7
"""Standard deviation of the blur that the scene is compared after, pixels of the flow."""
FULL_SUPPORT, SUPPORT_FLOOR = 2.0, 0.1
"""Sum of flow confidences over the neighbouring frames from which on the residual counts fully; and the support below
which the blurred residual fades out."""
MIN_EXPOSURE_LEVEL, MIN_EXPOSURE_AREA = 0.05, 0.02
"""Smallest display value of the pixels by which the exposures of two frames are compared, and the smallest share of the
frame that these pixels must cover."""
FINE_SIGMA, COARSE_SIGMA, DETAIL_STRIDE = 0.01, 0.08, 4
"""The detail of a frame is a difference of Gaussians: their standard deviations relative to the long side, and the
stride in pixels that it is sampled with."""
SIMILARITY_RAMP = (0.2, 0.4)
"""Correlation of the detail of two frames at which they are of different shots and of the same: of 120 pairs of
unrelated photographs it is 0.22 at most, of consecutive frames 0.3 at least."""
MIN_DETAIL_POWER = 1e-6
"""Mean square of the detail below which a frame counts as having none: that of a quarter of an 8 bit code."""


class FrameFeatures(NamedTuple):
    """What frames are compared and aligned by: the network's input (h, w, 3), its grey codes for the flow, and its
    detail."""

    display: Pixels
    grey: NDArray[np.uint8]
    detail: Pixels


class FramePrediction(NamedTuple):
    """A frame's features, and the prediction for it alone."""

    features: FrameFeatures
    prediction: TtaPrediction


class Neighbour(NamedTuple):
    """A neighbouring frame: its weight 0..1 (`shot_similarity`), the flow from the filtered frame to it and back."""

    frame: FramePrediction
    weight: np.float32
    flow_forward: Pixels
    flow_backward: Pixels


def frame_features(display: Pixels) -> FrameFeatures:
    """Compute the features of the network's input."""
    long_side = max(display.shape[:2])
    fine = np.ascontiguousarray(blur(display, FINE_SIGMA * long_side)[::DETAIL_STRIDE, ::DETAIL_STRIDE])
    detail = fine - blur(fine, COARSE_SIGMA * long_side / DETAIL_STRIDE)
    return FrameFeatures(display, optical_flow.to_grey_codes(display), detail)


def shot_similarity(first: FrameFeatures, second: FrameFeatures) -> np.float32:
    """Return how likely two frames belong to one shot, 0..1, by the correlation of their detail; 0 if sizes differ."""
    if first.display.shape != second.display.shape:
        return np.float32(0)
    a, b = first.detail, second.detail
    # MIN_DETAIL_POWER on both sides of the fraction makes two frames without detail alike.
    correlation = (((a * b).mean() + MIN_DETAIL_POWER)
                   / (np.sqrt(np.square(a).mean() * np.square(b).mean()) + MIN_DETAIL_POWER))
    low, high = SIMILARITY_RAMP
    return np.float32(np.clip((correlation - low) / (high - low), 0, 1))


def filter_in_time(frame: FramePrediction, neighbours: Sequence[Neighbour],
                   log_odds_bias: float = 0) -> FlarePrediction:
    """Return the prediction for a frame, corrected with the predictions for its neighbours.

    log_odds_bias: added to the log odds of a flare (`confidence.Sensitivity`).
    """
    display, prediction = frame.features.display, frame.prediction
    confidence = shot_confidence([(prediction, 1.0), *((neighbour.frame.prediction, float(neighbour.weight))
                                                       for neighbour in neighbours)], log_odds_bias)
    flare = np.minimum(merge_flare(prediction), display)
    if neighbours:
        reference = _clean_estimate(frame)
        residual = _residual_flare(reference, [_warped_neighbour(reference, neighbour) for neighbour in neighbours])
        flare = np.clip(flare + upsample(residual, display), 0, display)
    return FlarePrediction(display, flare, confidence, prediction.glow_fraction, bool(neighbours))


class _CleanEstimate(NamedTuple):
    """A frame at the size of the flow.

    scene: display values without flare and fine detail (h, w, 3). flare: the flare in its strongest channel (h, w).
    flow_confidence: how sure it is that a pixel shows the same place as in the frame to be filtered, 0..1 (h, w).
    """

    scene: Pixels
    flare: Pixels
    flow_confidence: Pixels

    @property
    def weights(self) -> Pixels:
        """Weights in the median, (h, w): less where there is more flare."""
        return self.flow_confidence / (1 + np.square(self.flare / np.float32(HALF_WEIGHT_FLARE)))


def _clean_estimate(frame: FramePrediction) -> _CleanEstimate:
    """Return the clean estimate of a frame from the prediction for it alone; its flow confidence is 1."""
    flare = downsample(merge_flare(frame.prediction))
    scene = blur(downsample(frame.features.display) - flare, SCENE_SIGMA)
    greatest: Pixels = flare.max(-1)
    return _CleanEstimate(scene, greatest, np.ones_like(greatest))


def _warped_neighbour(reference: _CleanEstimate, neighbour: Neighbour) -> _CleanEstimate:
    """Return the clean estimate of a neighbour, warped to the frame to be filtered and scaled to its exposure."""
    scene, flare, _ = _clean_estimate(neighbour.frame)
    warped = optical_flow.warp(np.dstack([scene, flare]), neighbour.flow_forward)
    flow_confidence = optical_flow.forward_backward_confidence(neighbour.flow_forward, neighbour.flow_backward)
    estimate = _CleanEstimate(warped[..., :3], warped[..., 3], neighbour.weight * flow_confidence)
    return estimate._replace(scene=estimate.scene * _exposure_ratio(reference, estimate))


def _exposure_ratio(reference: _CleanEstimate, other: _CleanEstimate) -> np.float32:
    """Return the factor that brings the scene of `other` to the exposure of the reference: the median of their ratio
    over the pixels that have no flare and are neither dark nor clipped in both; 1 if there are too few of these.

    Without it a change of the camera's exposure, or a fade, would pass for a flare.
    """
    reference_level, other_level = reference.scene.mean(-1), other.scene.mean(-1)
    comparable = np.minimum(reference_level, other_level) > MIN_EXPOSURE_LEVEL
    comparable &= np.maximum(reference.scene.max(-1), other.scene.max(-1)) < CLIPPING_LEVEL
    comparable &= np.maximum(reference.flare, other.flare) < HALF_WEIGHT_FLARE
    weights = other.flow_confidence[comparable]
    if weights.sum() < MIN_EXPOSURE_AREA * comparable.size:
        return np.float32(1)
    return np.float32(_weighted_median(reference_level[comparable] / other_level[comparable], weights))


def _residual_flare(reference: _CleanEstimate, others: Sequence[_CleanEstimate]) -> Pixels:
    """Return the flare that the prediction for a frame misses, display values (h, w, 3) at the size of the flow; below
    0 where the prediction is too great.

    It is the frame's own clean estimate minus the weighted median of all, smoothed, and bounded by the flare about it.
    others: the clean estimates of the warped neighbours.
    """
    estimates = [reference, *others]
    scene = _weighted_median(np.stack([estimate.scene for estimate in estimates]),
                             np.stack([estimate.weights for estimate in estimates])[..., None])
    support = np.minimum(np.sum([other.flow_confidence for other in others], 0) / np.float32(FULL_SUPPORT), 1)
    smooth = blur((reference.scene - scene) * support[..., None], RESIDUAL_SIGMA)
    # A mean over the supported places; SUPPORT_FLOOR lets it fade out where there are few.
    smooth /= (blur(support, RESIDUAL_SIGMA) + np.float32(SUPPORT_FLOOR))[..., None]
    greatest = np.max([reference.flare, *(other.flow_confidence * other.flare for other in others)], 0)
    bound = blur(greatest, BOUND_SIGMA)[..., None]
    return np.clip(smooth, -bound, bound)


def _weighted_median(values: Pixels, weights: Pixels) -> Pixels:
    """Return the weighted median over the first axis, the lower of two middle values; weights broadcast to the values.
    """
    order = np.argsort(values, 0)
    sums = np.cumsum(np.take_along_axis(np.broadcast_to(weights, values.shape), order, 0), 0)
    middle = (sums >= sums[-1:] / 2).argmax(0)[None]
    return np.take_along_axis(values, np.take_along_axis(order, middle, 0), 0)[0]
