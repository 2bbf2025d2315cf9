# SPDX-License-Identifier: GPL-3.0-or-later
"""The form of a flare model: its switches and sizes, as a .flare's description lists them.

`core.flare` builds the torch model from a form, and `look` reads a .flare with it.
"""
from __future__ import annotations

from dataclasses import dataclass

from ..typed import Bounds

FORM_BOUNDS = {"sh_degree": Bounds(0, 3), "latent": Bounds(0, 64), "levels": Bounds(1, 16), "base": Bounds(1, 256)}
"""Bounds of the numbers of a form; a file beyond them is damaged or hostile."""


@dataclass(frozen=True)
class FlareForm:
    """The switches of the flare model; each can be ablated alone.

    line              Gaussians lie on the line through principal point and light; else anywhere (mode `2d`)
    light_correction  delta_l, a 2D correction of the light's position for each view (paper, eq. 4)
    plane_offset      delta_f, a deformed 2D offset of each Gaussian (paper, eq. 3)
    solid             3D Gaussians with SH colour at depth 0.21 (paper); else ellipses on the plane
    sh_degree         degree of the view-dependent colour, 0 to 3 (solid only)
    static_offset     a learned 2D offset of each Gaussian, the same in all views
    rings             the radial profile exp(-(r - r0)^2 / (2 w^2)) (ours; docs/interop.md)
    arcs              factor exp(b·d) on the profile, which brightens one side: a ring that the lens barrel clips
                      (ellipses with rings only)
    latent            width of a latent code of each Gaussian, an input of the network
    levels, base      number of levels of the hash grids, and resolution of the coarsest. A cell of a fine level holds
                      one view only and learns nothing about the views between
    """

    line: bool = True
    light_correction: bool = True
    plane_offset: bool = True
    solid: bool = True
    sh_degree: int = 3
    static_offset: bool = False
    rings: bool = False
    latent: int = 0
    levels: int = 16
    base: int = 16
    arcs: bool = False

    @property
    def is_consistent(self) -> bool:
        """Return whether the switches can be combined."""
        return not self.arcs or (self.rings and not self.solid)

    @property
    def is_valid(self) -> bool:
        """Return whether the switches can be combined and the numbers lie within `FORM_BOUNDS`."""
        return self.is_consistent and all(bounds.contains(getattr(self, name)) for name, bounds in FORM_BOUNDS.items())
