# SPDX-License-Identifier: GPL-3.0-or-later
"""Lens flares by optics alone: prescriptions, traced ghosts, diffraction, scatter.

`flare.render_flare` draws the flare of one light in one lens. `core.fit.traced_flare` fits a flare model to it, the
sample captures are made with it, and `core.removal.synthesis` uses the prescriptions.
"""
