# SPDX-License-Identifier: GPL-3.0-or-later
"""Lens flares by optics alone: traced ghosts, diffraction, scatter. See `render_flare`."""
from __future__ import annotations

from .flare import LOOKS, Look, render_flare

__all__ = ["LOOKS", "Look", "render_flare"]
