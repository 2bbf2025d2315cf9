# SPDX-License-Identifier: GPL-3.0-or-later
"""The lens setups of the sample captures; `core.optics` renders their flares."""
from __future__ import annotations

from core.optics.flare import LensSetup, render_flare
from core.optics.ghosts import GhostSettings
from core.optics.starburst import Glow, Ring, Starburst, Streak

__all__ = ["LENS_SETUPS", "LensSetup", "render_flare"]

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
    "normal": LensSetup("US4621909", stop_down=0.4, blades=9, turn=12.0, seed=47,
                        coating=(0.52, 0.58, 0.45, 0.63, 0.49, 0.55), ghosts=GhostSettings(count=22, gain=420.0),
                        starburst=Starburst(gain=1400.0, peak=9.0), glow=Glow(0.2, 0.03, 1.2, 0.025, 0.3, 0.002)),
}
"""Setups by name, one for each sample capture."""
