# SPDX-License-Identifier: GPL-3.0-or-later
"""Colour spaces of plates and layers: what their numbers mean, to and from scene-linear Rec. 709.

    space = colour_space("acescg")
    light = space.to_linear(pixels)

`spaces` has those that need no library, `ocio` any space of an OpenColorIO configuration.
"""
from __future__ import annotations

from .spaces import REC_709, Chromaticities, ColourSpace, colour_space, space_of_chromaticities

__all__ = ["REC_709", "Chromaticities", "ColourSpace", "colour_space", "space_of_chromaticities"]
