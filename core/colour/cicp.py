# SPDX-License-Identifier: GPL-3.0-or-later
"""Colour spaces by the code points of ITU-T H.273 (CICP), which PNG, AVIF, HEIC and ICC profiles hold."""
from __future__ import annotations

from .curves import light_from_pq, power_curve, pq_from_light
from .spaces import P3_D65, REC_709, REC_2020, Chromaticities, ColourSpace, colour_space, curved_space

PRIMARIES: dict[int, Chromaticities] = {
    1: REC_709, 2: REC_709, 4: (0.67, 0.33, 0.21, 0.71, 0.14, 0.08, 0.310, 0.316),
    5: (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, 0.3127, 0.3290), 6: (0.63, 0.34, 0.31, 0.595, 0.155, 0.07, 0.3127, 0.3290),
    7: (0.63, 0.34, 0.31, 0.595, 0.155, 0.07, 0.3127, 0.3290), 9: REC_2020,
    11: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351), 12: P3_D65,
    22: (0.630, 0.340, 0.295, 0.605, 0.155, 0.077, 0.3127, 0.3290)}
"""Primaries by number; 2 is unspecified."""
_GAMMAS = {4: 2.2, 5: 2.8}
"""Exponents of the transfer characteristics that are plain powers, by number."""
PQ, HLG = 16, 18
"""Numbers of the transfer characteristics."""


def space_of_code_points(primaries: int, transfer: int) -> ColourSpace | None:
    """Return the space of two code points; None where one of them is not known here.

    Unspecified primaries (2) count as Rec. 709. An unspecified transfer (2) and the curves of video cameras (1, 6, 14,
    15) count as sRGB's (13): screens show them so, and still pictures with these numbers mean that.
    """
    chromaticities = PRIMARIES.get(primaries)
    if chromaticities is None:
        return None
    if transfer in (PQ, HLG):
        base = colour_space("pq" if transfer == PQ else "hlg")
        if chromaticities == REC_2020 or transfer == HLG:  # HLG needs Rec. 2020, by whose luminance it decodes
            return base
        return curved_space("pq of other primaries", light_from_pq, pq_from_light, chromaticities, has_headroom=True)
    if transfer == 8:  # linear
        name = "linear"
        return colour_space(name) if chromaticities == REC_709 else curved_space(
            "linear by its code points", *power_curve(1.0), chromaticities)
    if transfer in _GAMMAS:
        return curved_space(f"gamma {_GAMMAS[transfer]}", *power_curve(_GAMMAS[transfer]), chromaticities)
    if transfer in (1, 2, 6, 13, 14, 15):
        srgb = colour_space("srgb")
        return srgb if chromaticities == REC_709 else curved_space(
            "sRGB curve by its code points", srgb.to_linear, srgb.from_linear, chromaticities)
    return None

