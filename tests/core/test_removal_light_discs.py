# SPDX-License-Identifier: GPL-3.0-or-later
"""Light discs and the glow that stays about them."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.removal.inference import light_discs
from core.removal.inference.prediction import FlarePrediction
from core.removal.inference.remover import Glow, Remover
from tests.core.removal_cases import lit_street


@pytest.mark.parametrize("inside_matte", [False, True])
def test_a_light_disc_stays_as_bright_as_filmed(flare_everywhere: Path, inside_matte: bool) -> None:
    """The disc is found by its contrast without the flare; its glow is removed, with most of what clips around it."""
    display, flare = lit_street(10, level=0.7)
    prediction = FlarePrediction(display, flare, np.float32(1), 0 * flare)
    clean = display**2 - Remover(flare_everywhere).linear_flare(prediction, inside_matte=inside_matte)
    np.testing.assert_allclose(clean[62:68, 62:68], 1)
    np.testing.assert_allclose(clean[50:58, 50:58], 0.15**2, rtol=1e-4)
    assert 0 < np.sqrt(clean[60, 60:70]).max() < 0.35


@pytest.mark.parametrize(("size", "level", "glow"), [
    pytest.param(10, 0.2, 0.5, id="a ghost, removed like its surroundings"),
    pytest.param(44, 0.7, 1, id="as large as a window"),
    pytest.param(44, 0.2, 1, id="as large as what a glow clips"),
    pytest.param(1, 0.7, 1, id="a pixel, which noise is too"),
])
def test_other_bright_regions_are_not_retained(size: int, level: float, glow: float) -> None:
    """No light is kept in a ghost, in a region as large as a window or a clipped glow, or in a single pixel."""
    display, flare = lit_street(size, level)
    assert light_discs.retained_fraction(display, flare, np.full_like(flare, glow)).max() == 0


@pytest.mark.parametrize(("about", "glow", "part"), [
    pytest.param(0.5, 1.0, 1.0, id="in a glow"),
    pytest.param(0.5, 0.65, 0.5, id="half of it a glow"),
    pytest.param(0.9, 1.0, 0.5, id="hardly brighter than its surroundings"),
])
def test_a_disc_without_contrast_is_found_by_its_glow(about: float, glow: float, part: float) -> None:
    """The middle of the disc is kept fully, its rim less."""
    display, flare = lit_street(10, level=0.15)
    flare[display == 0.5] += about - 0.5
    display[display == 0.5] = about
    stays = light_discs.retained_fraction(display, flare, np.full_like(flare, glow))[..., 0]
    np.testing.assert_allclose(stays[63:67, 63:67], part, rtol=0.02)
    assert stays[60, 65] < 0.7 * part


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_uniform_frame_has_no_light_discs(value: float) -> None:
    display = np.full((64, 96, 3), value, np.float32)
    with np.errstate(all="raise"):
        assert not light_discs.retained_fraction(display, display * 0.5, np.ones_like(display)).any()


def test_part_of_the_glow_stays_near_a_light_at_night() -> None:
    """The less, the farther off; of what is no glow nothing does."""
    display, flare = lit_street(10, level=0.7)
    stays = light_discs.retained_fraction(display, flare, np.float32((1, 0.5, 0)) * np.ones_like(flare))
    for off in (2, 8):
        expected = light_discs.MAX_GLOW_KEPT * np.exp(-off / (light_discs.GLOW_FALLOFF * 240)) * np.array((1, 0.5, 0))
        np.testing.assert_allclose(stays[65, 60 - off], expected, rtol=0.02)


@pytest.mark.parametrize(("about", "part"), [(0.2, 1.0), (0.25, 0.5), (0.3, 0.0)])
def test_no_glow_stays_by_day(about: float, part: float) -> None:
    """The share of the glow that stays falls to 0 as the surroundings of the light become bright."""
    display, flare = lit_street(10, level=0.7)
    display[display < 0.2] = about
    stays = light_discs.retained_fraction(display, flare, np.ones_like(flare))[65, 58, 0]
    assert stays == pytest.approx(part * light_discs.MAX_GLOW_KEPT * np.exp(-2 / 12), rel=0.02, abs=1e-3)


@pytest.mark.parametrize(("white", "part"), [(0.905, 0.0), (0.935, 0.5), (0.98, 1.0)])
def test_a_dimmer_light_disc_keeps_less_glow(white: float, part: float) -> None:
    display, flare = lit_street(10, level=0.7)
    stays = light_discs.retained_fraction(np.minimum(display, white), flare, np.ones_like(flare))[65, 58, 0]
    assert stays == pytest.approx(part * light_discs.MAX_GLOW_KEPT * np.exp(-2 / 12), rel=0.05, abs=0.03)


@pytest.mark.parametrize(("glow", "inside_matte"), [("keep at lights", True), ("remove", False)])
def test_no_glow_stays_inside_a_matte_or_with_all_glow(flare_everywhere: Path, glow: Glow, inside_matte: bool) -> None:
    """The light disc itself stays."""
    display, flare = lit_street(10, level=0.15)
    prediction = FlarePrediction(display, flare, np.float32(1), np.ones_like(flare))
    whole = Remover(flare_everywhere, glow=glow).linear_flare(prediction, inside_matte=inside_matte)
    np.testing.assert_allclose(whole[65, 58], 0.5**2 - 0.15**2, rtol=1e-3)
    assert (Remover(flare_everywhere).linear_flare(prediction)[65, 58] < 0.8 * whole[65, 58]).all()
    assert whole[65, 65].max() == 0
