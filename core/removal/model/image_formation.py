# SPDX-License-Identifier: GPL-3.0-or-later
"""Image formation: how flare comes into a picture, and how much of the frame a flare covers.

A flare adds in light. A plate in scene-linear light is I = S + F; a display picture is formed with a gamma
between 1.8 and 2.2 (Yenamandra et al., "Lens Flare Removal"): I = (S^g + F^g)^(1/g), clipped as the camera
clips. Layers here are linear light, float32 (height, width, 3), so that g enters where display pictures
become light and where light becomes display.
"""
from __future__ import annotations

import numpy as np

from ...colour.srgb import Pixels

GAMMAS = (1.8, 2.2)
GAMMA = 2
"""Of the light that flares are taken from display values in: the middle of what pictures are formed with, and cheap."""


def display(linear: Pixels, gamma: float) -> Pixels:
    """Linear light as display values, clipped to 0..1."""
    return np.power(np.clip(linear, 0, 1), np.float32(1 / gamma)).astype(np.float32)


def under_shoulder(scene: Pixels, flare: Pixels, bend: float) -> Pixels:
    """Linear light as a camera develops it whose curve f(x) = (1 - exp(-bend x)) / bend bends towards white:
    f(f^-1(scene) + flare), where `scene` is 0..1 as that camera shows it. A flare adds less where the scene is bright;
    a bend of 1 is what compositors call screen."""
    through = np.exp(-np.float32(bend) * flare)
    return np.asarray(np.clip(scene, 0, 1) * through + (1 - through) / np.float32(bend), np.float32)


def flare_light(display: Pixels, added: Pixels) -> Pixels:
    """Linear flare (of GAMMA): what the frame's light has more than that of the clean display values."""
    return np.asarray(display**GAMMA - np.maximum(display - added, 0) ** GAMMA, np.float32)


def coverage(flare: Pixels, share: float = 0.9) -> float:
    """Fraction of the frame that holds `share` of a flare layer's energy; 0 for an empty layer."""
    energy = np.sort(np.asarray(flare, np.float64).sum(-1).ravel())[::-1]
    total = float(energy.sum())
    if total <= 0:
        return 0.0
    return float(np.searchsorted(np.cumsum(energy), share * total) + 1) / energy.size
