# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders a whole flare: what one light causes in one lens, as scene-linear light on a camera's pixels."""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .aperture import Aperture
from .ghosts import GhostSettings, Optics, coatings, draw_ghosts
from .lenses import find_lens
from .starburst import (
    Glow,
    Ring,
    Starburst,
    Streak,
    draw_glow,
    draw_ring,
    draw_starburst,
    draw_streak,
)

Pixels = NDArray[np.float32]



class Camera(Protocol):
    """The attributes of a camera that a flare depends on; pixel centres at +0.5."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...


@dataclass(frozen=True)
class LensSetup:
    """A lens and how it flares.

    lens: name or file of a prescription, see `find_lens`. stop_down: radius of the stop relative to the widest.
    blades, turn, curved, uneven, seed: see `Aperture`.
    squeeze: of an anamorphic lens, which stretches its ghosts along x. coating: wavelengths in micrometres, in turn
    over the air-glass surfaces. focal_length: mm, to which the prescription is scaled; 0 for its own. dust, scratches:
    on the glass at the stop. hood: tan of the field angles where the lens hood begins to shade, and where it lets no
    light in.
    """

    lens: str
    stop_down: float
    blades: int
    turn: float = 10.0
    curved: float = 0.1
    uneven: float = 0.012
    seed: int = 0
    squeeze: float = 1.0
    coating: tuple[float, ...] = (0.52, 0.46, 0.58, 0.50, 0.62, 0.43)
    ghosts: GhostSettings = field(default_factory=GhostSettings)
    starburst: Starburst = field(default_factory=Starburst)
    glow: Glow = field(default_factory=Glow)
    rings: tuple[Ring, ...] = ()
    streaks: tuple[Streak, ...] = ()
    focal_length: float = 0.0
    dust: int = 30
    scratches: int = 0
    hood: tuple[float, float] = (0.7, 1.5)


@lru_cache(maxsize=8)
def build_optics(setup: LensSetup) -> tuple[Optics, list[tuple[int, int]]]:
    """Return the setup's lens, ready to trace, and the pairs of surfaces of its brightest ghosts."""
    lens = find_lens(setup.lens)
    if setup.focal_length:
        lens = lens.scaled(setup.focal_length / lens.focal_length())
    aperture = Aperture(float(lens.semi_aperture[lens.stop]) * setup.stop_down, setup.blades, setup.turn, setup.curved,
                        setup.uneven, setup.dust, setup.seed, setup.scratches)
    optics = Optics(lens, coatings(lens, setup.coating), aperture)
    return optics, optics.brightest_pairs(setup.ghosts.count)


def render_flare(setup: LensSetup, camera: Camera, light: Sequence[float] | NDArray[np.float64], *,
                 colour: Sequence[float] = (1.0, 1.0, 1.0), intensity: float = 1.0, visible_share: float = 1.0
                 ) -> Pixels:
    """Return the flare of one light: scene-linear Rec. 709, (height, width, 3) float32, never negative.

    light: (x, y, z) in the camera's axes (x right, y down, z forward; any unit), or normalised (x/z, y/z) of a light in
    front. The flare is black if the light is behind the camera, hidden, or so far to the side that the hood shades it.
    colour: of the light, linear RGB. intensity: factor on the flare. visible_share: visible share of the light, 0..1, a
    factor too.
    """
    black = np.zeros((camera.height, camera.width, 3), np.float32)
    if len(light) == 3:
        if light[2] <= 1e-6:
            return black
        light = (light[0] / light[2], light[1] / light[2])
    position = (float(light[0]), float(light[1]))
    shade = min(max((setup.hood[1] - math.hypot(*position)) / (setup.hood[1] - setup.hood[0]), 0.0), 1.0)
    shade *= shade * (3 - 2 * shade)  # smoothstep
    strength = intensity * visible_share * shade
    if strength <= 0:
        return black
    optics, pairs = build_optics(setup)
    # Ghosts are traced in the coordinates of the lens without its squeeze.
    flare = draw_ghosts(optics, pairs, setup.ghosts, (position[0] / setup.squeeze, position[1]),
                        (camera.fx * setup.squeeze, camera.fy), (camera.cx, camera.cy), camera.width, camera.height)
    x, y = np.meshgrid(((np.arange(camera.width) + 0.5 - camera.cx) / camera.fx).astype(np.float32),
                       ((np.arange(camera.height) + 0.5 - camera.cy) / camera.fy).astype(np.float32))
    u, v = x - np.float32(position[0]), y - np.float32(position[1])
    flare += draw_starburst(optics.aperture, setup.starburst, u, v)
    flare += draw_glow(setup.glow, u, v)
    for ring in setup.rings:
        flare += draw_ring(ring, position, x, y)
    for streak in setup.streaks:
        flare += draw_streak(streak, position, x, y)
    return np.maximum(flare * (np.float32(strength) * np.asarray(colour, np.float32)), 0)
