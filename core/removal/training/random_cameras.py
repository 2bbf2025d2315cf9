# SPDX-License-Identifier: GPL-3.0-or-later
"""How frames come about at random: exposures, curves and grain of cameras, and how flares lie over them. Pairs that are
made one by one (`pairs`) and those that are made all at once (`card.composition`) draw from here, so that a network
learns from the same frames by both.
"""
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Random = np.random.Generator
Triple = NDArray[np.float32]
"""(3,): one for each channel."""

SECOND = 0.15
"""Share of the frames that have a second flare."""
DEVELOPED = 0.35
"""Share of the frames that a camera gave a curve and a saturation of its own."""
TRIES = 12
"""Ways of laying a flare, of which the one with its light in the brightest place is taken."""
AIMED = (0.3, 3.0)
"""How many times as bright a scene may become when it is brought to a light (`aim`)."""


def exposure(random: Random) -> Triple:
    """Day and night: gain and balance of the scene alone."""
    gain = random.uniform(0.5, 1.2) if random.random() < 0.65 else math.exp(random.uniform(math.log(0.03), 0))
    balance = np.exp(random.normal(0, 0.06, 3))
    return np.asarray(gain * balance, np.float32)


def aim(random: Random) -> float:
    """Light that the scene is brought to where the first light lies; 0 for as it is."""
    return float(random.uniform(0.4, 2)) if random.random() < 0.5 else 0.0


def graininess(random: Random) -> float:
    """Of the sensor, in parts of what is usual; 0 for none."""
    return float(random.chisquare(1)) if random.random() < 0.5 else 0.0


def bend(random: Random) -> float:
    """Of a curve that bends towards white (`formation.under_shoulder`)."""
    return float(random.uniform(0.3, 1))


class Development(NamedTuple):
    """A camera's curve and saturation."""

    contrast: float
    saturation: float
    lift: float


AS_IT_IS = Development(0.0, 1.0, 0.0)


def development(random: Random) -> Development:
    """Of a camera that has its own."""
    contrast, saturation = random.uniform(0, 0.7), random.uniform(0.8, 1.3)
    return Development(contrast, saturation, random.uniform(0, 0.04) if random.random() < 0.3 else 0.0)


def fade(random: Random) -> tuple[Triple, Triple]:
    """Display values that black and white come to."""
    black = random.uniform(0.02, 0.2) + random.normal(0, 0.015, 3)
    white = random.uniform(0.75, 1) + random.normal(0, 0.01, 3)
    return np.clip(black, 0, 1).astype(np.float32), np.clip(white, 0, 1).astype(np.float32)


def dither(random: Random) -> float:
    """In codes of 8 bits, before they are cut to whole ones."""
    return float(random.uniform(0.3, 0.7))


def quality(random: Random) -> int:
    """Of JPEG, in four of ten; 0 for none."""
    return int(random.integers(60, 99)) if random.random() < 0.4 else 0


def second_strength(random: Random) -> float:
    """Of a second flare, in parts of the first's."""
    return float(random.uniform(0.1, 1))


class Shining(NamedTuple):
    """How a flare shines: blurred by so many pixels (0 for none), in a colour, by a gain; and the mean light over the
    frame to which it is held, since frames that are washed out altogether teach nothing."""

    blur: float
    colour: Triple
    gain: np.float32
    most: float


def shining(random: Random, strength: float) -> Shining:
    """Of a flare of that strength."""
    blur = random.uniform(0.3, 2.0) if random.random() < 0.25 else 0.0
    colour = np.exp(random.normal(0, 0.12, 3)).astype(np.float32)
    gain = np.float32(math.exp(random.normal(0, 0.6)) * strength)
    return Shining(blur, colour, gain, random.uniform(0.02, 0.18))


def laid(random: Random, canvas: int, width: int, height: int, some: tuple[int, ...] = ()) -> NDArray[np.float64]:
    """(*some, 2, 3), from a canvas of so many pixels a side to a frame in pixels: turned, scaled from where the
    canvas's inner circle goes through the frame's corners on, mirrored, sheared a little; the canvas's middle at the
    frame's in four of five."""
    half = math.hypot(width, height) / 2
    zoom, turn = random.uniform(0.85, 1.5, some), random.uniform(0, 2 * math.pi, some)
    mirror = random.choice([-1.0, 1.0], some)
    longer, shear = np.exp(random.normal(0, 0.05, some)), random.normal(0, 0.05, some)
    off_middle = np.where(random.random(some) < 0.8, 0.01, 0.25)[..., None]
    shift = random.normal(0, off_middle, (*some, 2))
    stretch = _matrix(longer, shear, np.zeros(some), np.ones(some))
    spin = _matrix(np.cos(turn) * mirror, -np.sin(turn), np.sin(turn) * mirror, np.cos(turn))
    linear = (half / (canvas / 2) * zoom)[..., None, None] * spin @ stretch
    offset = np.array([width / 2, height / 2]) + shift * half - linear @ np.array([canvas / 2, canvas / 2])
    return np.concatenate([linear, offset[..., None]], -1)


def _matrix(a: Any, b: Any, c: Any, d: Any) -> NDArray[np.float64]:
    """(..., 2, 2): a and b above c and d."""
    return np.stack([np.stack([a, b], -1), np.stack([c, d], -1)], -2)
