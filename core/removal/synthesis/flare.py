# SPDX-License-Identifier: GPL-3.0-or-later
"""A whole flare: the layers that one seed makes, of every class and with one or more lights.

A `Flare` holds linear light on the square canvas, apart for what the two ways of removal need: `glare`, the
glow round the light, which the gentle way keeps; `rest`, which both take away; and `light`, the source, which
belongs to the scene and stays in both.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from . import aspheric, ghosts, scatter, shapes
from .canvas import Array, Point, Random, grid, tint, uniform_log
from .prescription import Prescription

CLASSES = ("scatter", "ghosts", "streak", "halo", "shimmer", "glare", "rings", "mixed")
_SHARES = (0.12, 0.16, 0.16, 0.11, 0.07, 0.08, 0.14, 0.16)
"""Of the classes where none is asked for. Rings and halos, of which training left most where they were, have more than
the classes whose flares are plain to see."""


@dataclass(frozen=True)
class Flare:
    """Layers (size, size, 3), linear light >= 0, and where the lights are on the canvas."""

    kind: str
    lights: tuple[Point, ...]
    rest: Array
    glare: Array
    light: Array

    @property
    def whole(self) -> Array:
        """All the flare."""
        return self.rest + self.glare


def flare(seed: int | Sequence[int], size: int, lenses: Sequence[Prescription], kind: str | None = None) -> Flare:
    """The flare of a seed, on a canvas of `size` pixels; `kind` is one of CLASSES, drawn where not given.

    The same arguments give the same flare. `lenses` are those that ghosts are traced through.
    """
    random = np.random.default_rng(seed)
    kind = kind or str(random.choice(CLASSES, p=_SHARES))
    x, y = grid(size)
    rest, glare, light = (np.zeros((size, size, 3), np.float32) for _ in range(3))
    count = 1 if random.random() < 0.7 else int(random.integers(2, 4))
    places = []
    same = int(random.integers(1 << 31))  # several lights shine through one lens
    for number in range(count):
        place = _place(random, kind)
        places.append(place)
        strength = 1.0 if number == 0 else uniform_log(random, 0.2, 1)
        colour = tint(random, 0.25)
        part, glow = _flare_of(random, same, kind, place, size, x, y, lenses)
        rest += part * colour * strength
        glare += glow * colour * strength
        if max(abs(place[0]), abs(place[1])) < 1.05 and (kind != "rings" or random.random() < 0.3) \
                and random.random() < 0.85:
            source = shapes.source(random, place, x, y)
            light = np.maximum(light, source)
            if kind in ("ghosts", "mixed") and random.random() < 0.4:
                rest += ghosts.mirrored(random, source, place) * strength
    return Flare(kind, tuple(places), rest, glare, light)


def through_aspheres(one: Flare, seed: Sequence[int]) -> Flare:
    """The same flare through a lens of moulded aspheres, that of a seed: its ghosts come to the others."""
    return replace(one, rest=one.rest + aspheric.ghosts(seed, one.lights, one.rest.shape[0]))


def _place(random: Random, kind: str) -> Point:
    """Lights lie anywhere on the frame, a fifth of them off it; the disc of radius 1 holds every frame's corners."""
    angle = random.uniform(0, 2 * math.pi)
    off = 0.3 if kind in ("ghosts", "glare", "mixed", "halo") else 0.12
    radius = random.uniform(0.75, 1.6) if random.random() < off else math.sqrt(random.random()) * 0.85
    return radius * math.cos(angle), radius * math.sin(angle)


def _flare_of(random: Random, same: int, kind: str, place: Point, size: int, x: Array, y: Array,
              lenses: Sequence[Prescription]) -> tuple[Array, Array]:
    """(rest, glare) of one light, in exposure: the parts that a class has, each at a brightness of its own."""
    lens = np.random.default_rng(same)  # the same for every light of the picture
    rest, glow = (np.zeros((size, size, 3), np.float32) for _ in range(2))
    parts = {kind}
    if kind == "mixed":
        parts = set(random.choice(["scatter", "ghosts", "streak", "halo", "shimmer", "glare", "veil"],
                                  int(random.integers(2, 6)), replace=False))
    if kind not in ("glare", "rings") and random.random() < 0.6:
        parts.add("glare")
    if kind in ("glare", "ghosts", "scatter") and random.random() < 0.3:
        parts.add("veil")
    for part in sorted(parts):
        if part == "scatter":
            rest += scatter.starburst(lens, place, size) * uniform_log(random, 3, 3e4)
        elif part == "ghosts":
            rest += _exposed(random, _ghosts(lens, place, size, x, y, lenses), 0.02, 1.0)
        elif part == "streak":
            if lens.random() < 0.4:
                rest += shapes.streak(lens, place, x, y) * uniform_log(random, 0.05, 3)
            else:
                rest += shapes.smear(lens, place, x, y) * uniform_log(random, 0.02, 1.2)
        elif part == "halo":
            rest += shapes.halo(lens, place, x, y) * uniform_log(random, 0.02, 0.5)
        elif part == "shimmer":
            rest += _exposed(random, scatter.rays(lens, place, x, y), 0.05, 1.5)
        elif part == "rings":
            rest += shapes.rings(random, x, y) ** np.float32(random.uniform(1, 2.2))
        elif part == "glare":
            glow += scatter.glare(random, place, x, y) * uniform_log(random, 0.1, 6)
        elif part == "veil":
            glow += scatter.veil(random, place, x, y) * uniform_log(random, 0.005, 0.3)
    return rest, glow


def _ghosts(random: Random, place: Point, size: int, x: Array, y: Array, lenses: Sequence[Prescription]) -> Array:
    for _ in range(6):  # some lenses show nothing of some lights
        if random.random() < 0.7:
            layer = ghosts.traced(random, ghosts.lens_of(random, lenses), place, size)
        else:
            layer = ghosts.freehand(random, place, size)
        if random.random() < 0.12:
            layer = layer + ghosts.arc(random, place, size, x, y)
        if float(layer.max()) > 1e-3:
            break
    return layer


def _exposed(random: Random, layer: Array, low: float, high: float) -> Array:
    """At a brightness between low and high, by what is bright in the layer rather than by its one peak."""
    values = layer.max(-1)
    lit = values[values > 1e-3 * max(float(values.max()), 1e-9)]
    if not lit.size:
        return layer
    return layer * np.float32(uniform_log(random, low, high) / max(float(np.percentile(lit, 80)), 1e-6))
