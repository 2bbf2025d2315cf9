# SPDX-License-Identifier: GPL-3.0-or-later
"""Transfer curves that files declare: PQ and HLG of ITU-R BT.2100, film density of Cineon, and plain powers.

`spaces` has those with a name, `core/images` makes others from the tags of files. Light is relative to diffuse white:
203 cd/m² is 1 in high dynamic range (ITU-R BT.2408), as in videos.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .srgb import Pixels

REFERENCE_WHITE_NITS = 203.0
"""Luminance of diffuse white in high dynamic range, cd/m²."""
PQ_PEAK_NITS, HLG_PEAK_NITS, HLG_GAMMA = 10000.0, 1000.0, 1.2
"""Luminance of the signal 1, and the system gamma of HLG at that peak."""
_M1, _M2, _C1, _C2, _C3 = 2610 / 16384, 2523 / 4096 * 128, 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
"""Constants of PQ (ITU-R BT.2100, table 4)."""
_A, _B, _C = 0.17883277, 0.28466892, 0.55991073
"""Constants of HLG (ITU-R BT.2100, table 5)."""
_REC_2020_LUMINANCE = np.array([0.2627, 0.6780, 0.0593])
CINEON_WHITE, CINEON_BLACK = 685, 95
"""Codes of 10 bits of diffuse white and of the film's base (Kodak, Cineon)."""
_CINEON_STEP = 0.002 / 0.6
"""Exponent of ten for each code: 0.002 of film density, over the gamma of the negative, 0.6."""


def light_from_pq(signal: NDArray[Any]) -> Pixels:
    """Decode PQ, 0..1, to light: 1 at 203 cd/m²."""
    power = np.power(np.clip(signal, 0, 1).astype(np.float64), 1 / _M2)
    light = np.power(np.maximum(power - _C1, 0) / (_C2 - _C3 * power), 1 / _M1)
    return (light * (PQ_PEAK_NITS / REFERENCE_WHITE_NITS)).astype(np.float32)


def pq_from_light(light: NDArray[Any]) -> Pixels:
    """Invert `light_from_pq`; light below 0 becomes 0."""
    scaled = np.asarray(light, np.float64) * (REFERENCE_WHITE_NITS / PQ_PEAK_NITS)
    power = np.power(np.maximum(scaled, 0), _M1)
    return np.power((_C1 + _C2 * power) / (1 + _C3 * power), _M2).astype(np.float32)


def light_from_hlg(signal: NDArray[Any]) -> Pixels:
    """Decode HLG (..., 3) of Rec. 2020 to the light of a display of 1000 cd/m², 1 at 203 cd/m².

    signal: 0..1, or up to 1.09 from limited range. The inverse OETF gives the scene's light, and the OOTF multiplies it
    by a power of its luminance (ITU-R BT.2100, table 5).
    """
    value = np.clip(signal, 0, 1.1).astype(np.float64)
    scene = np.where(value <= 0.5, value**2 / 3, (np.exp((np.maximum(value, 0.5) - _C) / _A) + _B) / 12)
    luminance = np.maximum(scene @ _REC_2020_LUMINANCE, 1e-9)[..., None]
    return (scene * luminance ** (HLG_GAMMA - 1) * (HLG_PEAK_NITS / REFERENCE_WHITE_NITS)).astype(np.float32)


def hlg_from_light(light: NDArray[Any]) -> Pixels:
    """Invert `light_from_hlg`; light below 0 becomes 0."""
    display = np.maximum(np.asarray(light, np.float64) * (REFERENCE_WHITE_NITS / HLG_PEAK_NITS), 0)
    luminance = np.maximum(display @ _REC_2020_LUMINANCE, 1e-12)[..., None]
    scene = display * luminance ** ((1 - HLG_GAMMA) / HLG_GAMMA)
    upper = _A * np.log(np.maximum(12 * scene - _B, 1e-9)) + _C
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), upper).astype(np.float32)


def light_from_cineon(signal: NDArray[Any]) -> Pixels:
    """Decode film density, codes 0..1023 as 0..1, to light: `CINEON_BLACK` is 0, `CINEON_WHITE` 1."""
    black = 10 ** ((CINEON_BLACK - CINEON_WHITE) * _CINEON_STEP)
    light = np.power(10.0, (np.asarray(signal, np.float64) * 1023 - CINEON_WHITE) * _CINEON_STEP)
    return ((light - black) / (1 - black)).astype(np.float32)


def cineon_from_light(light: NDArray[Any]) -> Pixels:
    """Invert `light_from_cineon`; light darker than code 0 becomes code 0."""
    black = 10 ** ((CINEON_BLACK - CINEON_WHITE) * _CINEON_STEP)
    linear = np.maximum(np.asarray(light, np.float64) * (1 - black) + black, 10 ** (-CINEON_WHITE * _CINEON_STEP))
    return ((CINEON_WHITE + np.log10(linear) / _CINEON_STEP) / 1023).astype(np.float32)


def power_curve(gamma: float) -> tuple[Callable[[NDArray[Any]], Pixels], Callable[[NDArray[Any]], Pixels]]:
    """Return (decode, encode) of the curve light = value**gamma, mirrored below 0."""
    def decode(values: NDArray[Any]) -> Pixels:
        return (np.sign(values) * np.power(np.abs(values), np.float32(gamma))).astype(np.float32)

    def encode(light: NDArray[Any]) -> Pixels:
        return (np.sign(light) * np.power(np.abs(light), np.float32(1 / gamma))).astype(np.float32)

    return decode, encode
