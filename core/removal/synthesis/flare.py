# SPDX-License-Identifier: GPL-3.0-or-later
"""Synthesises whole flares: the layers that one seed makes, of every flare class and with one or more lights.

Linear light on the square canvas, in the layers that training needs apart: `glow` round the light, which may be kept;
`rest`, which is always removed; and `light`, the light itself, which belongs to the scene.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...optics.prescription import Prescription
from . import aspheric, ghosts, scatter, shapes
from .canvas import Array, Point, Random, canvas_grid, log_uniform, random_tint

FLARE_CLASSES = ("scatter", "ghosts", "streak", "halo", "shimmer", "glow", "rings", "mixed")
"""Flare classes, in the order of their shares."""
_CLASS_SHARES = (0.12, 0.16, 0.16, 0.11, 0.07, 0.08, 0.14, 0.16)
"""Probability of each class. Rings and halos, of which a trained network left most, have more than classes whose flares
are obvious."""


@dataclass(frozen=True)
class SynthesisedFlare:
    """A flare by layers (size, size, 3), linear light >= 0: what is always removed (`rest`), the glow round the lights,
    and the lights themselves (`light`). kind: its flare class. lights: positions of the lights on the canvas."""

    kind: str
    lights: tuple[Point, ...]
    rest: Array
    glow: Array
    light: Array

    @property
    def total(self) -> Array:
        """All light of the flare: rest and glow."""
        return self.rest + self.glow


def synthesise_flare(seed: int | Sequence[int], size: int, lenses: Sequence[Prescription],
                     kind: str | None = None) -> SynthesisedFlare:
    """Return the flare of a seed on a canvas of `size` pixels; the same arguments give the same flare.

    lenses: lenses that ghosts are traced through. kind: one of FLARE_CLASSES; None draws one.
    """
    random = np.random.default_rng(seed)
    kind = kind or str(random.choice(FLARE_CLASSES, p=_CLASS_SHARES))
    x, y = canvas_grid(size)
    rest, glow, light = (np.zeros((size, size, 3), np.float32) for _ in range(3))
    count = 1 if random.random() < 0.7 else int(random.integers(2, 4))
    positions = []
    lens_seed = int(random.integers(1 << 31))  # all lights of a picture have one lens
    for number in range(count):  # the first light is the main one, the others are fainter
        position = _draw_light_position(random, kind)
        positions.append(position)
        strength = 1.0 if number == 0 else log_uniform(random, 0.2, 1)
        colour = random_tint(random, 0.25)
        light_rest, light_glow = _draw_light_flare(random, lens_seed, kind, position, size, x, y, lenses)
        rest += light_rest * colour * strength
        glow += light_glow * colour * strength
        # A light within the canvas or just off it shows; rings have no place relative to a light, so few get one.
        if max(abs(position[0]), abs(position[1])) < 1.05 and (kind != "rings" or random.random() < 0.3) \
                and random.random() < 0.85:
            source = shapes.draw_light(random, position, x, y)
            light = np.maximum(light, source)
            if kind in ("ghosts", "mixed") and random.random() < 0.4:
                rest += ghosts.draw_mirrored_light(random, source, position) * strength
    return SynthesisedFlare(kind, tuple(positions), rest, glow, light)


def add_aspheric_ghosts(flare: SynthesisedFlare, seed: Sequence[int]) -> SynthesisedFlare:
    """Return the flare with the ghosts that its lights make in a lens of moulded aspheres added; the seed makes the
    lens."""
    return replace(flare, rest=flare.rest + aspheric.draw_ghosts(seed, flare.lights, flare.rest.shape[0]))


def _draw_light_position(random: Random, kind: str) -> Point:
    """Draw a light's position on the canvas: uniform over the disc of radius 0.85, or in 12 % of the flares (30 % of
    ghosts, glow, mixed and halo) between the radii 0.75 and 1.6. The frame's corners lie at 0.67 to 1.18
    (`random_cameras.draw_placement`)."""
    angle = random.uniform(0, 2 * math.pi)
    off_frame_share = 0.3 if kind in ("ghosts", "glow", "mixed", "halo") else 0.12
    radius = random.uniform(0.75, 1.6) if random.random() < off_frame_share else math.sqrt(random.random()) * 0.85
    return radius * math.cos(angle), radius * math.sin(angle)


def _draw_light_flare(random: Random, lens_seed: int, kind: str, position: Point, size: int, x: Array, y: Array,
                      lenses: Sequence[Prescription]) -> tuple[Array, Array]:
    """Return (rest, glow) of one light, each (size, size, 3): the parts of its class, each at a random brightness.

    random: draws what differs between the lights of a picture. lens_seed: seed of what all of them share. x, y:
    `canvas_grid`.
    """
    lens_random = np.random.default_rng(lens_seed)
    rest, glow = (np.zeros((size, size, 3), np.float32) for _ in range(2))
    parts = {kind}
    if kind == "mixed":
        parts = set(random.choice(["scatter", "ghosts", "streak", "halo", "shimmer", "glow", "veil"],
                                  int(random.integers(2, 6)), replace=False))
    if kind not in ("glow", "rings") and random.random() < 0.6:
        parts.add("glow")
    if kind in ("glow", "ghosts", "scatter") and random.random() < 0.3:
        parts.add("veil")
    for part in sorted(parts):
        if part == "scatter":
            # Only the core, a few pixels, is 1: at 3e4 the spikes, decades below it, show too.
            rest += scatter.draw_starburst(lens_random, position, size) * log_uniform(random, 3, 3e4)
        elif part == "ghosts":
            rest += _normalise_exposure(random, _draw_ghosts(lens_random, position, size, x, y, lenses), 0.02, 1.0)
        elif part == "streak":
            if lens_random.random() < 0.4:
                rest += shapes.draw_streak(lens_random, position, x, y) * log_uniform(random, 0.05, 3)
            else:
                rest += shapes.draw_smear(lens_random, position, x, y) * log_uniform(random, 0.02, 1.2)
        elif part == "halo":
            rest += shapes.draw_halo(lens_random, position, x, y) * log_uniform(random, 0.02, 0.5)
        elif part == "shimmer":
            rest += _normalise_exposure(random, scatter.draw_shimmer(lens_random, position, x, y), 0.05, 1.5)
        elif part == "rings":
            # The rings are drawn in display values; the power converts them to linear light.
            rest += shapes.draw_rings(random, x, y) ** np.float32(random.uniform(1, 2.2))
        elif part == "glow":
            glow += scatter.draw_glow(random, position, x, y) * log_uniform(random, 0.1, 6)
        elif part == "veil":
            glow += scatter.draw_veil(random, position, x, y) * log_uniform(random, 0.005, 0.3)
    return rest, glow


def _draw_ghosts(random: Random, position: Point, size: int, x: Array, y: Array,
                 lenses: Sequence[Prescription]) -> Array:
    """Return traced or freehand ghosts of one light, linear light (size, size, 3).

    Through some lenses a light makes no visible ghost, so up to six draws are tried. position: of the light, canvas
    coordinates. x, y: `canvas_grid`.
    """
    for _ in range(6):
        if random.random() < 0.7:
            layer = ghosts.draw_traced(random, ghosts.choose_lens(random, lenses), position, size)
        else:
            layer = ghosts.draw_freehand(random, position, size)
        if random.random() < 0.12:
            layer = layer + ghosts.draw_arc(random, position, size, x, y)
        if float(layer.max()) > 1e-3:
            break
    return layer


def _normalise_exposure(random: Random, layer: Array, low: float, high: float) -> Array:
    """Return a layer (size, size, 3) scaled to a random brightness between `low` and `high`, linear light.

    Brightness is the 80th percentile of the lit pixels: it follows the bright area, not a peak of few pixels.
    """
    values = layer.max(-1)
    lit = values[values > 1e-3 * max(float(values.max()), 1e-9)]
    if not lit.size:
        return layer
    return layer * np.float32(log_uniform(random, low, high) / max(float(np.percentile(lit, 80)), 1e-6))
