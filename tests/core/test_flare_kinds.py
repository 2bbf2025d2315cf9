# SPDX-License-Identifier: GPL-3.0-or-later
"""The kinds of light, and their parts by place, sum to the flare that is traced."""
from __future__ import annotations

import numpy as np
import pytest

from benchmarks.flare_kinds import CORE, draw_kinds, partition
from core.capture import Camera
from core.capture.discs import squared_light_distances
from sample_scenes.description import LightSource
from sample_scenes.flares import LENS_SETUPS, render_flare


@pytest.mark.parametrize(("lens", "kinds"), [("fast", {"ghosts", "starburst", "glow", "rings"}),
                                             ("anamorphic", {"ghosts", "starburst", "glow", "streaks"})])
def test_kinds_sum_to_the_flare(lens: str, kinds: set[str]) -> None:
    camera = Camera(96, 54, 90.0, 90.0, 47.0, 28.0, np.eye(4))
    light = LightSource("lamp", (0.2, -0.1, 1.0), (1.0, 0.8, 0.5), 0.1, 1.0, 1.0, 1.0, 1.0, distant=True)
    layers = draw_kinds(LENS_SETUPS[lens], camera, (light,), {"lamp": 0.5})
    assert set(layers) == kinds
    whole = render_flare(LENS_SETUPS[lens], camera, light.xyz, colour=light.colour, intensity=light.flare,
                         visible_share=0.5).mean(axis=2)
    assert whole.max() > 0.01
    assert sum(layers.values()) == pytest.approx(whole, abs=1e-4)
    near_light = squared_light_distances(camera, np.array([light.xyz])) < CORE**2
    parts = partition(layers, near_light)
    assert sum(parts.values()) == pytest.approx(whole, abs=1e-4)
    assert {"ghosts, edges", "ghosts, faces", "starburst, core", "starburst, beyond"} <= set(parts)
    assert near_light.any() and parts["starburst, core"].max() > parts["starburst, beyond"].max()
