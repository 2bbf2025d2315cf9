# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders a whole flare: what one light causes in one lens, as scene-linear light on a camera's pixels."""
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from core.removal.synthesis.prescription import read_prescription

from .aperture import Aperture
from .ghosts import GhostSettings, Optics, coatings, draw_ghosts
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

LENS_FOLDER = Path(__file__).parent / "lenses"
"""Prescriptions, .lens."""
HOOD_BEGIN, HOOD_END = 0.7, 1.5
"""tan of the field angle where the lens hood begins to shade, and where it lets no light in."""


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

    lens: a prescription's file name in LENS_FOLDER. stop_down: radius of the stop relative to the widest. squeeze: of
    an anamorphic lens, which stretches its ghosts along x. coating: wavelengths in micrometres, in turn over the
    air-glass surfaces.
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


@lru_cache(maxsize=8)
def build_optics(setup: LensSetup) -> tuple[Optics, list[tuple[int, int]]]:
    """Return the setup's lens, ready to trace, and the pairs of surfaces of its brightest ghosts."""
    lens = read_prescription(LENS_FOLDER / f"{setup.lens}.lens")
    aperture = Aperture(float(lens.semi_aperture[lens.stop]) * setup.stop_down, setup.blades, setup.turn, setup.curved,
                        setup.uneven, seed=setup.seed)
    optics = Optics(lens, coatings(lens, setup.coating), aperture)
    return optics, optics.pairs(setup.ghosts.count)


def render_flare(setup: LensSetup, camera: Camera, light: Sequence[float] | NDArray[np.float64], *,
                 colour: Sequence[float] = (1.0, 1.0, 1.0), intensity: float = 1.0, visible_share: float = 1.0
                 ) -> Pixels:
    """Return the flare of one light: scene-linear Rec. 709, (height, width, 3) float32, never negative.

    light: (x, y, z) in the camera's axes (x right, y down, z forward; any unit), or normalised (x/z, y/z) of a light in
    front. The flare is zero for a light behind the camera, one that is hidden, and one so far to the side that the hood
    shades it. colour: linear RGB. visible_share: 0..1, scales the flare.
    """
    black = np.zeros((camera.height, camera.width, 3), np.float32)
    if len(light) == 3:
        if light[2] <= 1e-6:
            return black
        light = (light[0] / light[2], light[1] / light[2])
    at = (float(light[0]), float(light[1]))
    shade = min(max((HOOD_END - math.hypot(*at)) / (HOOD_END - HOOD_BEGIN), 0.0), 1.0)
    shade *= shade * (3 - 2 * shade)
    strength = intensity * visible_share * shade
    if strength <= 0:
        return black
    optics, pairs = build_optics(setup)
    flare = draw_ghosts(optics, pairs, setup.ghosts, (at[0] / setup.squeeze, at[1]),
                        (camera.fx * setup.squeeze, camera.fy), (camera.cx, camera.cy), camera.width, camera.height)
    x, y = np.meshgrid(((np.arange(camera.width) + 0.5 - camera.cx) / camera.fx).astype(np.float32),
                       ((np.arange(camera.height) + 0.5 - camera.cy) / camera.fy).astype(np.float32))
    u, v = x - np.float32(at[0]), y - np.float32(at[1])
    flare += draw_starburst(optics.aperture, setup.starburst, u, v)
    flare += draw_glow(setup.glow, u, v)
    for ring in setup.rings:
        flare += draw_ring(ring, at, x, y)
    for streak in setup.streaks:
        flare += draw_streak(streak, at, x, y)
    return np.maximum(flare * (np.float32(strength) * np.asarray(colour, np.float32)), 0)


LENS_SETUPS: dict[str, LensSetup] = {
    "fast": LensSetup("US3576360", stop_down=0.34, blades=8, seed=3, coating=(0.44, 0.62, 0.50, 0.68, 0.47, 0.56),
                      ghosts=GhostSettings(count=26, gain=480.0), starburst=Starburst(gain=1500.0, peak=9.0),
                      glow=Glow(0.2, 0.03, 1.2, 0.02, 0.28, 0.002),
                      rings=(Ring(gain=0.08, radius=0.25, width=0.02),)),
    "anamorphic": LensSetup("FR1233449", stop_down=0.33, blades=6, turn=0.0, seed=8, squeeze=1.6,
                            coating=(0.50, 0.60, 0.46, 0.54, 0.66, 0.44), ghosts=GhostSettings(count=18, gain=260.0),
                            starburst=Starburst(gain=700.0, peak=9.0), glow=Glow(0.2, 0.03, 1.2, 0.03, 0.3, 0.002),
                            streaks=(Streak(gain=1.6, length=0.05, power=0.75, width=0.0035),
                                     Streak(gain=0.25, length=0.25, power=1.0, width=0.011, mirror=0.3))),
    "wide": LensSetup("DE2205380", stop_down=0.55, blades=5, turn=27.0, seed=12,
                      coating=(0.48, 0.63, 0.55, 0.44, 0.68), ghosts=GhostSettings(count=16, gain=500.0),
                      starburst=Starburst(gain=1300.0, peak=9.0), glow=Glow(0.15, 0.03, 1.2, 0.015, 0.3, 0.002),
                      rings=(Ring(gain=0.05, radius=0.16, width=0.05, follow=-0.55, lean=0.6, grow=0.1),)),
    "ringed": LensSetup("US4099850", stop_down=0.55, blades=7, turn=5.0, seed=21,
                        coating=(0.56, 0.47, 0.62, 0.51), ghosts=GhostSettings(count=8, gain=350.0),
                        starburst=Starburst(gain=250.0, peak=6.0), glow=Glow(0.12, 0.025, 1.3, 0.01, 0.3, 0.001),
                        rings=(Ring(gain=0.28, radius=0.20, width=0.025),
                               Ring(gain=0.22, radius=0.09, width=0.09, dispersion=0.2, lean=0.2),
                               Ring(gain=0.16, radius=0.13, width=0.06, follow=-0.7, grow=0.15, lean=0.8,
                                    dispersion=0.5))),
    "rimmed": LensSetup("US4099850", stop_down=0.55, blades=7, turn=5.0, seed=34,
                        coating=(0.56, 0.47, 0.62, 0.51), ghosts=GhostSettings(count=6, gain=250.0),
                        starburst=Starburst(gain=120.0, peak=5.0), glow=Glow(0.12, 0.025, 1.3, 0.01, 0.3, 0.001),
                        rings=(Ring(gain=0.30, radius=0.20, width=0.03, dispersion=0.12, lean=0.3),
                               Ring(gain=0.26, radius=0.09, width=0.05, dispersion=0.1, lean=0.2),
                               Ring(gain=0.22, radius=0.13, width=0.035, follow=-0.7, grow=0.15, lean=0.5,
                                    dispersion=0.15),
                               Ring(gain=0.20, radius=0.055, width=0.06, follow=0.45, lean=0.2, dispersion=0.1),
                               Ring(gain=0.14, radius=0.27, width=0.025, follow=-0.3, grow=-0.1, dispersion=0.1))),
}
"""Setups by name, one for each sample capture."""
