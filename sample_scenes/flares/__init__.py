# SPDX-License-Identifier: GPL-3.0-or-later
"""Lens flares by optics alone: traced ghosts, diffraction, scatter. See `render_flare`."""
from __future__ import annotations

from .flare import LENS_SETUPS, LensSetup, render_flare

__all__ = ["LENS_SETUPS", "LensSetup", "render_flare"]
