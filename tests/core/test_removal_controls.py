# SPDX-License-Identifier: GPL-3.0-or-later
"""What the artist controls of a removal: the amount, the sensitivity, and the confidence in the report."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from core.colour import colour_space
from core.errors import SettingsError
from core.images.plates import Plate
from core.removal.inference.confidence import BIAS, FEATURE_WEIGHTS, FlareFeatures
from core.removal.inference.device import select_device
from core.removal.inference.prediction import TtaPrediction, single_prediction
from core.removal.inference.remover import Remover
from core.removal.inference.test_time_augmentation import shot_confidence
from core.removal.jobs.batch import clean_plates
from core.removal.jobs.manifest import Manifest
from core.system.progress import Progress
from tests.core.removal_cases import picture, write_codes


def removed(weights: Path, amount: float) -> float:
    """Return the mean linear flare that is removed from a grey plate."""
    remover = Remover(weights, working_size=64)
    remover.use_controls(amount)
    codes = picture(64, 96) // 2 + np.uint8(100)
    flare = remover.remove(Plate(Path("plate.png"), codes, "srgb"))[1]
    return float(flare.astype(np.float32).mean())


def test_the_amount_scales_the_flare(flare_everywhere: Path) -> None:
    whole = removed(flare_everywhere, 1)
    assert removed(flare_everywhere, 0) == 0 < whole
    assert removed(flare_everywhere, 0.5) == pytest.approx(whole / 2, rel=0.03)
    assert removed(flare_everywhere, 1.5) == pytest.approx(whole * 1.5, rel=0.05)


@pytest.mark.parametrize(("amount", "sensitivity"), [(-0.1, "normal"), (1.6, "normal"), (float("nan"), "normal"),
                                                     (1, "total")])
def test_controls_outside_their_range_are_refused(flare_everywhere: Path, amount: float, sensitivity: str) -> None:
    with pytest.raises(SettingsError):
        Remover(flare_everywhere).use_controls(amount, sensitivity)


def test_each_choice_makes_the_results_again(flare_everywhere: Path) -> None:
    keys = set()
    for amount, sensitivity in ((1, "normal"), (0.5, "normal"), (1, "high"), (1, "low")):
        remover = Remover(flare_everywhere)
        remover.use_controls(amount, sensitivity)
        keys.add(remover.cache_key)
    assert len(keys) == 4 and Remover(flare_everywhere).cache_key in keys


def test_the_last_choice_alone_decides_which_results_are_made_again(flare_everywhere: Path) -> None:
    spaces = [colour_space("acescg"), colour_space("logc3")]
    changed, direct, plain = (Remover(flare_everywhere) for _ in range(3))
    for space in spaces:
        changed.use_plate_space(space)
    direct.use_plate_space(spaces[1])
    assert changed.cache_key == direct.cache_key != plain.cache_key
    changed.use_controls(0.5, "high")
    changed.use_controls(0.5, "low")
    direct.use_controls(0.5, "low")
    assert changed.cache_key == direct.cache_key
    plain.use_controls(0.5)
    plain.use_controls()
    plain.use_device("cpu")
    assert plain.cache_key == Remover(flare_everywhere).cache_key


def test_the_sensitivity_decides_on_a_doubtful_flare(flare_everywhere: Path) -> None:
    """Of flares with log odds of -0.5 and 0.5, low sensitivity accepts neither, normal the second, high both."""
    confidence = {}
    for sensitivity in ("low", "normal", "high"):
        remover = Remover(flare_everywhere)
        remover.use_controls(sensitivity=sensitivity)
        bias = remover.sensitivity.log_odds_bias
        confidence[sensitivity] = [shot_confidence([(with_log_odds(value), 1)], bias) for value in (-0.5, 0.5)]
    assert confidence == {"low": [0, 0], "normal": [0, 1], "high": [1, 1]}


def with_log_odds(value: float) -> TtaPrediction:
    features = FlareFeatures(0, 0, 0, 0, 0)
    scaled = FlareFeatures((value - BIAS) / FEATURE_WEIGHTS[0], *features[1:])
    assert scaled.log_odds == pytest.approx(value)
    return single_prediction(np.full((8, 8, 3), 0.1, np.float32))._replace(features=scaled)


def test_the_report_has_the_confidence_of_each_plate(flare_everywhere: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_codes(tmp_path / name / f"{name}.png", picture(64, 96))
    plates = [tmp_path / "a" / "a.png", tmp_path / "b" / "b.png"]
    result = clean_plates(plates, tmp_path / "clean", Remover(flare_everywhere, working_size=64), Progress())
    assert set(result["confidence"]) == {"a.png", "b.png"}
    assert all(0 <= value <= 1 for value in result["confidence"].values())
    again = clean_plates(plates, tmp_path / "clean", Remover(flare_everywhere, working_size=64), Progress())
    assert again["kept"] == 2 and again["confidence"] == result["confidence"], "kept frames keep theirs"
    assert Manifest(tmp_path / "clean").confidence([Path("a.png"), Path("c.png")]).keys() == {"a.png"}


def test_the_device_is_the_first_that_torch_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    for has_cuda, expected in ((True, "cuda"), (False, "mps")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda value=has_cuda: value)
        assert select_device("auto").type == expected
    assert select_device("cpu").type == "cpu"
    with pytest.raises(SettingsError, match="torch finds no cuda device"):
        select_device("cuda")
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    assert select_device().type == "cpu"
