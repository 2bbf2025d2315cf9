# SPDX-License-Identifier: GPL-3.0-or-later
"""Image formation: how flare adds to a frame, and how much of the frame a flare covers.

Flare adds in linear light: a scene-linear plate is I = S + F. A display picture is formed with a gamma between 1.8 and
2.2 (Yenamandra et al., "Lens Flare Removal"): I = (S^g + F^g)^(1/g), clipped as the camera clips. Layers here are
linear light, float32 (height, width, 3), so that g only enters between display values and light.

`training.pairs` composes frames with it; `inference` converts predictions with it.
"""
from __future__ import annotations

import numpy as np

from ...colour.srgb import Pixels

GAMMA_RANGE = (1.8, 2.2)
"""Least and greatest gamma that frames of a training are formed with."""
GAMMA = 2
"""Gamma at which inference converts display values to light: the middle of GAMMA_RANGE, and cheap."""


def to_display(linear: Pixels, gamma: float) -> Pixels:
    """Convert linear light to display values, clipped to 0..1."""
    return np.power(np.clip(linear, 0, 1), np.float32(1 / gamma)).astype(np.float32)


def add_under_shoulder(scene: Pixels, flare: Pixels, strength: float) -> Pixels:
    """Add a flare to a scene under a tone curve with a shoulder, f(x) = (1 - exp(-strength x)) / strength:
    f(f^-1(scene) + flare), linear light.

    scene: 0..1, after the curve. A flare adds less where the scene is bright; a strength of 1 is the compositing
    operation "screen".
    """
    transmitted = np.exp(-np.float32(strength) * flare)
    return np.asarray(np.clip(scene, 0, 1) * transmitted + (1 - transmitted) / np.float32(strength), np.float32)


def flare_to_linear(display: Pixels, flare: Pixels) -> Pixels:
    """Return the linear flare (by GAMMA) that accounts for what a flare adds to display values: the frame's light minus
    the clean frame's. display: the frame, 0..1. flare: what it adds, of the same shape."""
    return np.asarray(display**GAMMA - np.maximum(display - flare, 0) ** GAMMA, np.float32)


def coverage(flare: Pixels, energy_share: float = 0.9) -> float:
    """Return the smallest fraction of the frame, 0..1, that holds this share of the energy of a flare (h, w, 3); 0 for
    an empty layer."""
    energy = np.sort(np.asarray(flare, np.float64).sum(-1).ravel())[::-1]
    total = float(energy.sum())
    if total <= 0:
        return 0.0
    return float(np.searchsorted(np.cumsum(energy), energy_share * total) + 1) / energy.size
