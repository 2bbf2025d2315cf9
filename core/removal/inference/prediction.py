# SPDX-License-Identifier: GPL-3.0-or-later
"""What a removal model predicts for one frame: `TtaPrediction` is what the network returns, `FlarePrediction` what a
clean frame is made with."""
from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...colour.srgb import Pixels
from .confidence import FlareFeatures


class TtaPrediction(NamedTuple):
    """The flare of a frame as predicted with test-time augmentation; flares are what is added to display values.

    mean: the predicted flare, averaged over the augmentations, (h, w, 3).
    per_channel: the flare predicted from each channel alone, given as a grey frame, (h, w, 3).
    per_channel_weight: weight of what per_channel exceeds the mean by, 0..1.
    glow_fraction: share of the mean that is glow about lights, 0..1, (h, w, 3).
    features: what the confidence is computed from; None where the mean is too faint to need one.
    """

    mean: Pixels
    per_channel: Pixels
    per_channel_weight: np.float32
    glow_fraction: Pixels
    features: FlareFeatures | None = None


class FlarePrediction(NamedTuple):
    """The flare of a frame, ready to be removed.

    display: the network's input, display values 0..1, (h, w, 3).
    flare: what a flare adds to them, if there is one, (h, w, 3).
    confidence: how sure it is that this is a flare, not the scene or its grade, 0..1.
    glow_fraction: share of the flare that is glow about lights, 0..1, (h, w, 3).
    has_neighbours: neighbouring frames corrected the flare of the frame's first view.
    """

    display: Pixels
    flare: Pixels
    confidence: np.float32
    glow_fraction: Pixels
    has_neighbours: bool = False


def single_prediction(flare: Pixels) -> TtaPrediction:
    """Return the prediction of a model that ran once, without test-time augmentation; none of it is glow."""
    zeros = np.zeros_like(flare)
    return TtaPrediction(flare, zeros, np.float32(0), zeros)
