# SPDX-License-Identifier: GPL-3.0-or-later
"""Highlights of a picture as lights, and their flares in a transfer."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fit_flare.headless.cli import main
from numpy.typing import NDArray

from core.bake.exr import read_layers
from core.images.write import write_png
from core.lights.highlights import REFERENCE_AREA, find_highlights
from tests.core.test_look import saved

SIZE = 160, 90


def with_spots(*spots: tuple[float, float, float, tuple[float, float, float]]) -> NDArray[np.float32]:
    """A dim picture with discs: x, y, radius, colour."""
    y, x = np.mgrid[:SIZE[1], :SIZE[0]] + 0.5
    picture = np.full((*SIZE[::-1], 3), 0.2)
    for left, top, radius, colour in spots:
        share = np.clip(radius + 0.5 - np.hypot(x - left, y - top), 0, 1)[..., None]
        picture = picture * (1 - share) + share * np.array(colour)
    return picture.astype(np.float32)


def test_a_moving_spot_keeps_its_light_and_its_place() -> None:
    totals, offsets = [], []
    for step in np.linspace(0, 30, 61):
        place = np.array([40.3 + step, 30.1 + step / 2])
        found = find_highlights(with_spots((*place, 3.0, (4.0, 4.0, 4.0))))
        totals.append(found.light.sum())
        weights = found.light.sum(1)
        offsets.append((found.xy * weights[:, None]).sum(0) / weights.sum() - place)
        assert np.abs(found.xy - place).max() < 3.5
    assert np.ptp(totals) < 0.12 * np.mean(totals)  # the edge pixels of so small a disc
    assert np.abs(np.diff(totals)).max() < 0.08 * np.mean(totals)
    assert np.abs(offsets).max() < 0.3


def test_spots_have_light_by_area_and_colour() -> None:
    assert len(find_highlights(with_spots())) == 0
    found = find_highlights(with_spots((30, 45, 6, (2, 2, 2)), (120, 45, 3, (2, 2, 0))))
    left, right = (found.light[(found.xy[:, 0] < 80) == side].sum(0) for side in (True, False))
    assert left[0] == pytest.approx(np.pi * 36 * 2 / (REFERENCE_AREA * SIZE[0] * SIZE[1]), rel=0.1)
    assert right[0] / left[0] == pytest.approx(0.25, rel=0.15)
    assert right[2] < 0.1 * right[0]
    bright = find_highlights(with_spots((30, 45, 6, (2, 2, 2))), gain=3)
    assert bright.light.sum() == pytest.approx(3 * left.sum(), rel=0.01)


def test_pixels_that_are_not_finite_are_no_lights() -> None:
    picture = with_spots((30, 45, 6, (2, 2, 2)))
    expected = find_highlights(picture).light.sum()
    picture[5, 5] = np.nan
    picture[6, 6] = np.inf
    assert find_highlights(picture).light.sum() == pytest.approx(expected)


def test_a_transfer_adds_a_flare_at_every_highlight(tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1)
    white = 0.5 * np.sqrt(SIZE[0] * SIZE[1] * REFERENCE_AREA)  # half a side of the reference area
    picture = np.full((*SIZE[::-1], 3), 0.2, np.float32)
    picture[30:30 + round(2 * white), 40:40 + round(2 * white)] = 1.0
    write_png(tmp_path / "both.png", picture)
    options = [str(tmp_path / "a.flare"), "--to", str(tmp_path / "both.png"), "--query", "source"]
    assert main(["transfer", *options, "--out", str(tmp_path / "found"), "--highlights"]) == 0
    place = f"{40 + white:.2f},{30 + white:.2f}"
    assert main(["transfer", *options, "--out", str(tmp_path / "named"), "--light", place]) == 0

    def flare(folder: str) -> NDArray[np.float32]:
        return read_layers(next((tmp_path / folder).glob("layers.*.exr"))).flare

    found, named = flare("found"), flare("named")
    factor = round(2 * white) ** 2 / (2 * white) ** 2
    assert np.linalg.norm(found - factor * named) < 0.1 * np.linalg.norm(named)


@pytest.mark.parametrize("words", [["--highlights", "0"], ["--highlight-gain", "2"],
                                   ["--fall-off"], ["--highlights", "--light", "3,3"],
                                   ["--highlights", "--highlight-gain", "-1"]])
def test_options_that_make_no_sense_are_refused(words: list[str], tmp_path: Path) -> None:
    saved(tmp_path / "a.flare", lights=1)
    write_png(tmp_path / "p.png", np.zeros((9, 16, 3), np.float32))
    assert main(["transfer", str(tmp_path / "a.flare"), "--to", str(tmp_path / "p.png"), "--out", str(tmp_path / "o"),
                 *words]) == 2
    assert not (tmp_path / "o").exists()
