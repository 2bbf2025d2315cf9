# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the random parameters of cameras and flares: exposures, curves, grain, placements.

`pairs` (one by one) and `gpu.composition` (in batches) draw from here, so that a network learns from the same
distribution by both.
"""
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Random = np.random.Generator
Triple = NDArray[np.float32]
"""(3,): one for each channel."""

SECOND_FLARE_SHARE = 0.15
"""Share of the frames that have a second flare."""
DEVELOPED_SHARE = 0.35
"""Share of the frames with a camera's own curve and saturation."""
PLACEMENTS = 12
"""Number of placements that are drawn for a flare against a bright scene; the one whose light is in the brightest place
is used."""
EXPOSURE_LIMITS = (0.3, 3.0)
"""Smallest and largest factor by which a scene's exposure is changed to reach `draw_target_light`."""


def draw_exposure(random: Random) -> Triple:
    """Draw gain times white balance, (3,), of the scene alone: by day 0.5 to 1.2, by night down to 0.03."""
    gain = random.uniform(0.5, 1.2) if random.random() < 0.65 else math.exp(random.uniform(math.log(0.03), 0))
    balance = np.exp(random.normal(0, 0.06, 3))
    return np.asarray(gain * balance, np.float32)


def draw_target_light(random: Random) -> float:
    """Draw the linear light (1 is white) that the scene gets by exposure where the first light is; 0 to leave the
    exposure."""
    return float(random.uniform(0.4, 2)) if random.random() < 0.5 else 0.0


def draw_grain(random: Random) -> float:
    """Draw a sensor's noise relative to the usual; 0 for none."""
    return float(random.chisquare(1)) if random.random() < 0.5 else 0.0


def draw_shoulder(random: Random) -> float:
    """Draw the strength of a curve that bends towards white (`image_formation.add_under_shoulder`)."""
    return float(random.uniform(0.3, 1))


class Development(NamedTuple):
    """A camera's curve and saturation. contrast: share of an S-shaped curve, 0..1. saturation: a factor, 1 for none.
    lift: display value of black."""

    contrast: float
    saturation: float
    lift: float


NEUTRAL_DEVELOPMENT = Development(0.0, 1.0, 0.0)


def draw_development(random: Random) -> Development:
    """Draw the curve and saturation of a camera that has its own."""
    contrast, saturation = random.uniform(0, 0.7), random.uniform(0.8, 1.3)
    return Development(contrast, saturation, random.uniform(0, 0.04) if random.random() < 0.3 else 0.0)


def draw_fade(random: Random) -> tuple[Triple, Triple]:
    """Draw the display values that black and white become in a faded picture, (3,) each."""
    black = random.uniform(0.02, 0.2) + random.normal(0, 0.015, 3)
    white = random.uniform(0.75, 1) + random.normal(0, 0.01, 3)
    return np.clip(black, 0, 1).astype(np.float32), np.clip(white, 0, 1).astype(np.float32)


def draw_dither(random: Random) -> float:
    """Draw the offset in 8 bit codes that is added before they are truncated."""
    return float(random.uniform(0.3, 0.7))


def draw_jpeg_quality(random: Random) -> int:
    """Draw a JPEG quality for four of ten frames; 0 for none."""
    return int(random.integers(60, 99)) if random.random() < 0.4 else 0


def draw_second_strength(random: Random) -> float:
    """Draw the strength of a second flare relative to the first."""
    return float(random.uniform(0.1, 1))


class FlareAppearance(NamedTuple):
    """The appearance of a flare. blur: standard deviation in pixels, 0 for none. max_mean: limit of its mean light over
    the frame, since nothing is learned from frames that are washed out completely."""

    blur: float
    colour: Triple
    gain: np.float32
    max_mean: float


def draw_appearance(random: Random, strength: float) -> FlareAppearance:
    """Draw the appearance of a flare of that strength, 1 for the first of a frame."""
    blur = random.uniform(0.3, 2.0) if random.random() < 0.25 else 0.0
    colour = np.exp(random.normal(0, 0.12, 3)).astype(np.float32)
    gain = np.float32(math.exp(random.normal(0, 0.6)) * strength)
    return FlareAppearance(blur, colour, gain, random.uniform(0.02, 0.18))


def draw_placement(random: Random, canvas_size: int, width: int, height: int,
                   count_shape: tuple[int, ...] = ()) -> NDArray[np.float64]:
    """Draw affine matrices (*count_shape, 2, 3) from a square canvas with sides of `canvas_size` pixels to a frame in
    pixels.

    The canvas is rotated, mirrored, sheared a little, and scaled to 0.85 to 1.5 times the size at which its inscribed
    circle passes through the frame's corners. Its middle is shifted from the frame's by a random distance: in four of
    five draws about a hundredth of the frame's half diagonal, else about a quarter of it.
    """
    half_diagonal = math.hypot(width, height) / 2
    zoom, roll = random.uniform(0.85, 1.5, count_shape), random.uniform(0, 2 * math.pi, count_shape)
    mirror = random.choice([-1.0, 1.0], count_shape)
    stretch_x, shear = np.exp(random.normal(0, 0.05, count_shape)), random.normal(0, 0.05, count_shape)
    shift_deviation = np.where(random.random(count_shape) < 0.8, 0.01, 0.25)[..., None]
    shift = random.normal(0, shift_deviation, (*count_shape, 2))
    stretch = _matrix(stretch_x, shear, np.zeros(count_shape), np.ones(count_shape))
    rotation = _matrix(np.cos(roll) * mirror, -np.sin(roll), np.sin(roll) * mirror, np.cos(roll))
    linear = (half_diagonal / (canvas_size / 2) * zoom)[..., None, None] * rotation @ stretch
    frame_middle, canvas_middle = np.array([width / 2, height / 2]), np.array([canvas_size / 2, canvas_size / 2])
    offset = frame_middle + shift * half_diagonal - linear @ canvas_middle
    return np.concatenate([linear, offset[..., None]], -1)


def _matrix(a: Any, b: Any, c: Any, d: Any) -> NDArray[np.float64]:
    """Return (..., 2, 2): a and b above c and d."""
    return np.stack([np.stack([a, b], -1), np.stack([c, d], -1)], -2)
