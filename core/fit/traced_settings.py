# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings of `make-flare`: a lens, its iris, glass and surroundings, and the fit of a flare to its tracing.

`traced_flare` follows them; `sample_scenes/make_library.py` lists the ones of the library.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any

from ..errors import SettingsError
from ..optics.flare import LensSetup
from ..optics.ghosts import GhostSettings
from ..optics.lenses import find_lens
from ..optics.starburst import Glow, Ring, Starburst, Streak
from ..typed import MAX_SEED, Bounds
from .overrides import override_field

REFERENCE_REACH = 2 / 3
"""Half the frame's width over the focal length of the frame in which the tangents of starburst, glow, rings and streaks
are given: 27 mm on a sensor of 36 mm. They scale with the frame."""
MIN_CORE = 0.6
"""Smallest softening radius of the starburst, pixels of the traced pictures: these are sampled at pixel centres, and a
smaller core would flicker as the light moves between them."""
F_NUMBER_TOLERANCE = 0.97
"""Ratio of a requested f-number to the lens's widest down to which it counts as the widest: prescriptions are rounded.
"""
HOOD = (0.7, 1.5)
"""Tangents of the field angles at which the lens hood begins to shade and lets no light in, at REFERENCE_REACH."""
LIGHT_SIZE = 0.0014
"""Standard deviation (tan) of the blur of ghosts by the extent of the light, at REFERENCE_REACH."""
ASPECT = 9 / 16
"""Height of the traced pictures over their width."""


@dataclass(frozen=True)
class Iris:
    """The aperture stop. f_number: 0 for two stops below the widest. roundness: 0 for straight blades, 1 for a circle.
    rotation: of the first corner, degrees. unevenness: of the blades, relative to the radius."""

    f_number: float = 0.0
    blades: int = 8
    roundness: float = 0.1
    rotation: float = 10.0
    unevenness: float = 0.012


@dataclass(frozen=True)
class GlassSettings:
    """The glass. coating: wavelengths in micrometres for which the coatings are made, in turn over the surfaces between
    glass and air; 0 for bare glass. dust, scratches: number of specks and lines. seed: of both, and of the blades."""

    coating: tuple[float, ...] = (0.52, 0.46, 0.58, 0.50, 0.62, 0.43)
    dust: int = 30
    scratches: int = 0
    seed: int = 0


@dataclass(frozen=True)
class TracedGhosts:
    """The ghosts. level: their root mean square over the frame and over several places of the light, relative to white.
    count: number of ghosts, the brightest first. dispersion: True if the glass splits colours. rim: how much brighter a
    ghost's edge is than its inside. limit: largest light of a pixel, relative to white. Where a ghost is in focus, or
    its rays cross in a caustic, the tracing has no bound, and a pixel would outshine the light itself."""

    level: float = 0.02
    count: int = 18
    dispersion: bool = True
    rim: float = 0.35
    limit: float = 1.0


@dataclass(frozen=True)
class TracingSettings:
    """The pictures that the flare is fitted to. width: pixels. positions: number of places of the light. field: how far
    these extend, relative to the frame. bands: number of wavelengths. supersample: samples along each side of a
    pixel."""

    width: int = 240
    positions: int = 96
    field: float = 1.25
    bands: int = 6
    supersample: int = 1


@dataclass(frozen=True)
class TracedFit:
    """The fit. gaussians: initial number. max_gaussians: largest number."""

    iterations: int = 1500
    gaussians: int = 1600
    max_gaussians: int = 2000
    seed: int = 0


@dataclass(frozen=True)
class TracedFlareSettings:
    """All settings of `make-flare`.

    lens: a name in `lens_names`, or a file. focal_length: mm, to which the prescription is scaled; 0 for its own.
    sensor: width of the sensor, mm. squeeze: of an anamorphic lens, 1 for a spherical one. colour: of the light, linear
    RGB. rings, streaks: any number. The tangents in starburst, glow, rings and streaks are those of a frame of
    REFERENCE_REACH.
    """

    lens: str = "US3576360"
    focal_length: float = 0.0
    sensor: float = 36.0
    squeeze: float = 1.0
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    iris: Iris = field(default_factory=Iris)
    glass: GlassSettings = field(default_factory=GlassSettings)
    ghosts: TracedGhosts = field(default_factory=TracedGhosts)
    starburst: Starburst = field(default_factory=lambda: Starburst(gain=700.0, peak=9.0))
    glow: Glow = field(default_factory=lambda: Glow(0.2, 0.03, 1.2, 0.02, 0.3, 0.002))
    rings: tuple[Ring, ...] = ()
    streaks: tuple[Streak, ...] = ()
    tracing: TracingSettings = field(default_factory=TracingSettings)
    fit: TracedFit = field(default_factory=TracedFit)

    def validated(self) -> TracedFlareSettings:
        """Return these settings unchanged. Raises SettingsError if a number is outside its BOUNDS."""
        for name, bounds in BOUNDS.items():
            values = attrgetter(name)(self)
            for value in values if isinstance(values, tuple) else (values,):
                if not bounds.contains(value):
                    raise SettingsError(f"The flare cannot be made: {name} must lie {bounds}.")
        for name, parts in (("rings", self.rings), ("streaks", self.streaks)):
            if any(part.gain < 0 or part.width <= 0 for part in parts):
                raise SettingsError(f"The flare cannot be made: {name} need a gain of 0 or more and a width above 0.")
        if not any(self.colour):
            raise SettingsError("The flare cannot be made: a black light has none; give another colour.")
        return self

    def override(self, values: Mapping[str, Any]) -> TracedFlareSettings:
        """Return settings with some replaced by dotted name, such as {"iris.blades": 7}. Raises SettingsError."""
        settings = self
        for name, value in values.items():
            settings = override_field(settings, name.split("."), value, name)
        return settings.validated()

    @property
    def height(self) -> int:
        """Height of the traced pictures, pixels."""
        return max(round(self.tracing.width * ASPECT), 1)

    @property
    def used_focal_length(self) -> float:
        """Focal length of the lens as it is used, mm. Raises SettingsError for what is no photographic lens."""
        length = find_lens(self.lens).focal_length()
        if not 0 < length < math.inf:
            raise SettingsError(f"The lens {self.lens} forms no picture by itself (an attachment or converter); choose "
                                "another.")
        return self.focal_length or length

    @property
    def reach(self) -> float:
        """Half the frame's width, normalised coordinates."""
        return self.sensor / 2 / self.used_focal_length

    def lens_setup(self) -> LensSetup:
        """Return the tracer's setup, with a ghost gain of 1 and all tangents scaled to this frame. Raises SettingsError
        for a lens that forms no picture, and for an f-number that it does not reach."""
        scale = self.reach / REFERENCE_REACH
        widest = find_lens(self.lens).widest_f_number()
        f_number = self.iris.f_number or 2 * widest  # two stops
        if f_number < F_NUMBER_TOLERANCE * widest:
            raise SettingsError(f"The lens {self.lens} opens to f/{widest:.2g} at most; give an f-number of that or "
                                "more, or 0.")
        return LensSetup(
            lens=self.lens, stop_down=min(widest / f_number, 1.0), blades=self.iris.blades, turn=self.iris.rotation,
            curved=self.iris.roundness, uneven=self.iris.unevenness, seed=self.glass.seed, squeeze=self.squeeze,
            coating=self.glass.coating, focal_length=self.focal_length, dust=self.glass.dust,
            scratches=self.glass.scratches, hood=(HOOD[0] * scale, HOOD[1] * scale),
            ghosts=GhostSettings(count=self.ghosts.count, gain=1.0, rim=self.ghosts.rim, size=LIGHT_SIZE * scale,
                                 bands=self.tracing.bands if self.ghosts.dispersion else 1,
                                 supersample=self.tracing.supersample, limit=self.ghosts.limit),
            starburst=replace(self.starburst, extent=self.starburst.extent * scale,
                              core=max(self.starburst.core * scale, MIN_CORE * 2 * self.reach / self.tracing.width)),
            glow=replace(self.glow, radius=self.glow.radius * scale, wide_radius=self.glow.wide_radius * scale),
            rings=tuple(replace(ring, radius=ring.radius * scale) for ring in self.rings),
            streaks=tuple(replace(streak, length=streak.length * scale, width=streak.width * scale)
                          for streak in self.streaks))


_SHARE, _NON_NEGATIVE = Bounds(0, 1), Bounds(0, 1e6)
_POSITIVE = Bounds(0, 1e6, exclusive_minimum=True)
BOUNDS: dict[str, Bounds] = {
    "focal_length": Bounds(0, 5000), "sensor": Bounds(1, 200), "squeeze": Bounds(0.5, 3), "colour": Bounds(0, 100),
    "iris.f_number": Bounds(0, 128), "iris.blades": Bounds(3, 32), "iris.roundness": _SHARE,
    "iris.rotation": Bounds(-360, 360), "iris.unevenness": Bounds(0, 0.2),
    "glass.coating": Bounds(0, 1.5), "glass.dust": Bounds(0, 10_000), "glass.scratches": Bounds(0, 10_000),
    "glass.seed": Bounds(0, MAX_SEED), "ghosts.level": _NON_NEGATIVE, "ghosts.count": Bounds(0, 200),
    "ghosts.rim": Bounds(0, 10), "ghosts.limit": _POSITIVE, "starburst.gain": _NON_NEGATIVE,
    "starburst.extent": _POSITIVE, "starburst.core": _POSITIVE, "starburst.peak": _POSITIVE, "glow.gain": _NON_NEGATIVE,
    "glow.radius": _POSITIVE, "glow.power": Bounds(0, 10, exclusive_minimum=True), "glow.wide_gain": _NON_NEGATIVE,
    "glow.wide_radius": _POSITIVE, "glow.floor": _NON_NEGATIVE,
    "tracing.width": Bounds(32, 1920), "tracing.positions": Bounds(4, 4096), "tracing.field": Bounds(0.1, 3),
    "tracing.bands": Bounds(1, 64), "tracing.supersample": Bounds(1, 8),
    "fit.iterations": Bounds(1, 10**6), "fit.gaussians": Bounds(1, 100_000),
    "fit.max_gaussians": Bounds(1, 100_000), "fit.seed": Bounds(0, MAX_SEED),
}
"""Range of each number, by its dotted name."""
