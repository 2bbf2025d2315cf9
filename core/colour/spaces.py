# SPDX-License-Identifier: GPL-3.0-or-later
"""Colour spaces by name, as primaries and a transfer curve.

White points are adapted by Bradford's matrix, as in ACES and ICC. Curves continue above 1 and are mirrored below 0, so
that no light is lost.
"""
from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingsError
from .curves import (
    cineon_from_light,
    hlg_from_light,
    light_from_cineon,
    light_from_hlg,
    light_from_pq,
    power_curve,
    pq_from_light,
)
from .srgb import Pixels, linear_from_srgb, srgb_from_linear

Chromaticities = tuple[float, float, float, float, float, float, float, float]
"""x and y of red, green, blue and white, in the order of OpenEXR's attribute."""
Curve = Callable[[NDArray[Any]], Pixels]

REC_709: Chromaticities = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
AP1: Chromaticities = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
AP0: Chromaticities = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
REC_2020: Chromaticities = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
P3_D65: Chromaticities = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)

_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
CHROMATICITY_TOLERANCE = 2e-3
"""Difference below which primaries count as equal: headers round them."""


@dataclass(frozen=True, eq=False)
class ColourSpace:
    """A colour space relative to scene-linear Rec. 709.

    to_linear, from_linear: convert pixels (..., 3) to and from scene-linear Rec. 709, float32. matrix: (3, 3) to linear
    Rec. 709, of a linear space; None for one with a curve. chromaticities: for the header of a file; None if
    unknown. has_headroom: True for a curve whose signal 0..1 holds light above white, 1.
    """

    name: str
    to_linear: Curve
    from_linear: Curve
    matrix: NDArray[np.float64] | None = None
    chromaticities: Chromaticities | None = None
    has_headroom: bool = False

    @property
    def is_linear(self) -> bool:
        """Return whether light adds in this space."""
        return self.matrix is not None

    @property
    def fingerprint(self) -> str:
        """A short hash of what the space does to colours.

        Two configurations may have different spaces of one name, and a configuration's file may change.
        """
        levels = np.array([0.02, 0.18, 0.9], np.float32)
        colours = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(-1, 3)
        samples = np.concatenate([self.to_linear(colours), self.from_linear(colours)]).ravel()
        digits = " ".join(f"{value:.3g}" for value in samples)  # three digits, on which machines agree
        return hashlib.blake2b(digits.encode(), digest_size=8).hexdigest()


def matrix_to_xyz(chromaticities: Chromaticities) -> NDArray[np.float64]:
    """Return the matrix (3, 3) from linear R, G, B to CIE X, Y, Z, white at Y = 1 (SMPTE RP 177)."""
    x, y = np.array(chromaticities[0::2]), np.array(chromaticities[1::2])
    columns = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    # Scales each primary such that R = G = B = 1 gives the white.
    return np.asarray(columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3]))


def matrix_between(source: Chromaticities, target: Chromaticities) -> NDArray[np.float64]:
    """Return the matrix (3, 3) from the linear R, G, B of `source` to that of `target`; its white becomes the other's
    (Bradford's adaptation)."""
    first, second = (_BRADFORD @ _white(space) for space in (source, target))
    adapted = np.linalg.inv(_BRADFORD) @ np.diag(second / first) @ _BRADFORD
    return np.asarray(np.linalg.inv(matrix_to_xyz(target)) @ adapted @ matrix_to_xyz(source))


def _white(chromaticities: Chromaticities) -> NDArray[np.float64]:
    """Return X, Y, Z of the white, with Y = 1."""
    x, y = chromaticities[6:]
    return np.array([x / y, 1.0, (1 - x - y) / y])


def linear_space(name: str, matrix: NDArray[np.float64], chromaticities: Chromaticities | None) -> ColourSpace:
    """Make a linear space from its matrix (3, 3) to linear Rec. 709. chromaticities: None where unknown."""
    if np.allclose(matrix, np.eye(3), atol=1e-12):
        return ColourSpace(name, _identity, _identity, np.eye(3), chromaticities)
    forward, inverse = matrix.T.astype(np.float32), np.linalg.inv(matrix).T.astype(np.float32)
    return ColourSpace(name, lambda pixels: np.asarray(pixels, np.float32) @ forward,
                       lambda pixels: np.asarray(pixels, np.float32) @ inverse, matrix, chromaticities)


def curved_space(name: str, decode: Curve, encode: Curve, chromaticities: Chromaticities, *,
                 has_headroom: bool = False) -> ColourSpace:
    """Make a space with a curve. decode, encode: the curve to and from light in the space's own primaries, which are
    `chromaticities`. has_headroom: the signal 0..1 holds light above white."""
    matrix = matrix_between(chromaticities, REC_709)
    if np.allclose(matrix, np.eye(3), atol=1e-4):
        return ColourSpace(name, decode, encode, None, chromaticities, has_headroom)
    forward, inverse = matrix.T.astype(np.float32), np.linalg.inv(matrix).T.astype(np.float32)
    return ColourSpace(name, lambda pixels: decode(pixels) @ forward,
                       lambda light: encode(np.asarray(light, np.float32) @ inverse), None, chromaticities,
                       has_headroom)


def space_of_chromaticities(chromaticities: Chromaticities) -> ColourSpace:
    """Return the linear space with these primaries: a built-in one where they match, else a new one.

    Raises SettingsError where they span no space.
    """
    for name, built_in in _LINEAR.items():
        if np.abs(np.subtract(chromaticities, built_in)).max() < CHROMATICITY_TOLERANCE:
            return colour_space(name)
    try:
        with np.errstate(divide="ignore", invalid="ignore"):
            matrix = matrix_between(chromaticities, REC_709)
            np.linalg.inv(matrix)  # raises where colours cannot be converted back
    except np.linalg.LinAlgError:
        matrix = np.full((3, 3), np.nan)
    if not np.isfinite(matrix).all():
        raise SettingsError(f"The chromaticities {chromaticities} span no colour space; name the plate's with "
                            "--plate-space.")
    return linear_space("by its chromaticities", matrix, chromaticities)


def colour_space(name: str, config: Path | str | None = None) -> ColourSpace:
    """Return a space by name: a built-in one, or one of an OpenColorIO configuration (`config`, else the variable
    OCIO).

    With `config`, its names take precedence over the built-in ones. Raises SettingsError for an unknown name,
    EngineError where OpenColorIO is needed and not installed.
    """
    if config is not None:
        from .ocio import ocio_space

        return ocio_space(name, config)
    normalised = _normalise_name(name)
    if normalised in _ALIASES:
        space_name = _ALIASES[normalised]
        return (_BUILT_IN.get(space_name) or _CURVED[space_name])()
    from .ocio import camera_space, has_configuration, ocio_space

    if normalised in _CAMERAS:
        return camera_space(_CAMERAS[normalised])

    if not has_configuration():
        names = ", ".join(plate_names())
        raise SettingsError(f"The colour space {name!r} is not one of {names}; for another, name an "
                            "OpenColorIO configuration with --ocio or the variable OCIO.")
    return ocio_space(name, None)


def built_in_names() -> list[str]:
    """Names of the spaces that need no configuration."""
    return list(_BUILT_IN)


def plate_names() -> list[str]:
    """Names of the spaces of plates that need no configuration: built-in ones, those of other curves, and those of
    cameras' logarithms, which need OpenColorIO."""
    return list(dict.fromkeys([*_BUILT_IN, *_CURVED, *_CAMERAS.values()]))


def is_plate_name(name: str) -> bool:
    """Return whether `colour_space` knows a name without a configuration, however people write it."""
    return _normalise_name(name) in _ALIASES or _normalise_name(name) in _CAMERAS


def _normalise_name(name: str) -> str:
    """Return a name as the tables below have it: lower case, letters and digits alone, since people write the others
    differently."""
    return "".join(character for character in name.lower() if character.isalnum())


def _identity(pixels: NDArray[Any]) -> Pixels:
    return np.asarray(pixels, np.float32)


def _rec709_from_linear(linear: NDArray[Any]) -> Pixels:
    """Encode with the camera curve of ITU-R BT.709, continued unclipped above 1 and mirrored below 0."""
    size = np.abs(np.asarray(linear, np.float32))
    curve = 1.099 * np.power(np.maximum(size, 0.018), np.float32(0.45)) - 0.099
    return np.copysign(np.where(size < 0.018, 4.5 * size, curve), linear).astype(np.float32)


def _linear_from_rec709(display: NDArray[Any]) -> Pixels:
    size = np.abs(np.asarray(display, np.float32))
    curve = np.power((np.maximum(size, 0.081) + 0.099) / 1.099, np.float32(1 / 0.45))
    return np.copysign(np.where(size < 0.081, size / 4.5, curve), display).astype(np.float32)


_LINEAR: dict[str, Chromaticities] = {"linear": REC_709, "acescg": AP1, "aces2065-1": AP0, "rec2020": REC_2020,
                                      "p3-d65": P3_D65}


def _linear_maker(name: str) -> Callable[[], ColourSpace]:
    """Return a function that makes the built-in linear space of this name."""
    return lambda: linear_space(name, matrix_between(_LINEAR[name], REC_709), _LINEAR[name])


_ADOBE_RGB: Chromaticities = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
_BUILT_IN: dict[str, Callable[[], ColourSpace]] = {
    "srgb": lambda: ColourSpace("srgb", linear_from_srgb, srgb_from_linear),
    "rec709": lambda: ColourSpace("rec709", _linear_from_rec709, _rec709_from_linear),
    **{name: _linear_maker(name) for name in _LINEAR},
}
_CURVED: dict[str, Callable[[], ColourSpace]] = {
    "display-p3": lambda: curved_space("display-p3", linear_from_srgb, srgb_from_linear, P3_D65),
    "adobergb": lambda: curved_space("adobergb", *power_curve(563 / 256), _ADOBE_RGB),
    "gamma2.2": lambda: curved_space("gamma2.2", *power_curve(2.2), REC_709),
    "gamma2.4": lambda: curved_space("gamma2.4", *power_curve(2.4), REC_709),
    "pq": lambda: curved_space("pq", light_from_pq, pq_from_light, REC_2020, has_headroom=True),
    "hlg": lambda: curved_space("hlg", light_from_hlg, hlg_from_light, REC_2020, has_headroom=True),
    "cineon": lambda: curved_space("cineon", light_from_cineon, cineon_from_light, REC_709, has_headroom=True),
}
_ALIASES = {**{_normalise_name(name): name for name in [*_BUILT_IN, *_CURVED]}, "bt709": "rec709",
            "linearrec709": "linear", "linrec709": "linear", "ap1": "acescg", "ap0": "aces2065-1",
            "linearrec2020": "rec2020", "linrec2020": "rec2020", "p3": "display-p3", "adobergb1998": "adobergb",
            "rec2100pq": "pq", "rec2100hlg": "hlg", "st2084": "pq"}
_CAMERAS = {
    **dict.fromkeys(("logc3", "arrilogc3", "logc3awg3", "logcei800", "alexalogc"), "logc3"),
    **dict.fromkeys(("logc4", "arrilogc4", "logc4awg4"), "logc4"),
    **dict.fromkeys(("slog3", "slog3sgamut3"), "slog3"),
    **dict.fromkeys(("slog3cine", "slog3sgamut3cine", "sonyslog3sgamut3cine"), "slog3-cine"),
    **dict.fromkeys(("vlog", "vlogvgamut", "panasonicvlog"), "vlog"),
    **dict.fromkeys(("log3g10", "log3g10rwg", "log3g10redwidegamutrgb", "redlog3g10"), "log3g10"),
    "acescct": "acescct", "acescc": "acescc",
    **dict.fromkeys(("clog2", "canonlog2", "clog2cgamut"), "clog2"),
    **dict.fromkeys(("clog3", "canonlog3", "clog3cgamut"), "clog3"),
    "applelog": "applelog",
}
"""Names of the cameras' spaces by what people write, as `_normalise_name` returns it."""
