# SPDX-License-Identifier: GPL-3.0-or-later
"""The overlay's shaders, in Blenders that draw without a window."""
from __future__ import annotations

from pathlib import Path

import pytest
from blenders import Blender
from test_work import a_flare


def test_the_shaders_draw_what_numpy_draws(blender: Blender, package: Path, tmp_path: Path) -> None:
    """Whole pictures of two shapes, whose levels end beyond their edges; one level alone; and a look with more than a
    thousand Gaussians, whose core is a sum of many faint ones. Block of gpu_overlay.py: "beginning"."""
    flare = a_flare(tmp_path / "lamp.flare")
    facts = blender.run(Path(__file__).parent / "scripts" / "gpu_overlay.py", package, flare, user=tmp_path / "user")
    if "missing" in facts:
        pytest.skip(facts["missing"])
    for off, brightest, _ in [*facts["pictures"], facts["many in one place"]]:
        assert brightest > 0.1 and off < 1e-3 * brightest
    first, _, alone = (count for _, _, count in facts["pictures"])
    assert first > 1 == alone
