# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings survive config.toml, presets hold the paper's figures, and nonsense is refused."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from core.errors import RunError, SettingsError
from core.fit.settings import changed, preset, read_config, write_config


@pytest.mark.parametrize("name", ["draft", "standard", "high", "paper"])
@pytest.mark.parametrize("model", ["paper", "ours"])
def test_config_round_trip(tmp_path: Path, name: Any, model: Any) -> None:
    settings = changed(preset(name, model=model), {"holdout": 'odd "name"\\.json', "seed": 7})
    write_config(tmp_path / "config.toml", settings)
    assert read_config(tmp_path / "config.toml") == settings


def test_the_paper_preset_is_the_paper() -> None:
    settings = preset("paper")
    rates, density = settings.flare.rates, settings.flare.density
    assert (settings.iterations, settings.ssim_share, settings.blend) == (30000, 0.1, "over")
    assert (rates.network, rates.grids, rates.position, rates.position_final) == (1e-4, 1e-4, 1.6e-4, 1.6e-6)
    assert (rates.features, rates.opacity, rates.scale, rates.rotation) == (2.5e-3, 0.05, 0.1, 1e-3)
    assert (density.start, density.stop, density.every) == (1000, 12000, 500)
    assert (density.clone_above, density.clone_ratio, density.noise, density.prune_below) == (0.005, 0.2, 0.02, 0.002)
    assert settings.flare.count == 200
    # 23 rounds of cloning a fifth end near the 10,965 Gaussians that the paper reports.
    grown = settings.flare.count * (1 + density.clone_ratio) ** 22
    assert grown == pytest.approx(10965, rel=0.02)


@pytest.mark.parametrize(("name", "value"), [
    ("iterations", 0), ("iterations", 2.5), ("ssim_share", 2.0), ("ssim_share", float("nan")), ("mode", "fast"),
    ("width", -1), ("flare.rates.network", "quick"), ("flare.rates", 1.0), ("nothing", 1), ("seed.low", 1),
    ("flare.count", True), ("mode", "2d"),
])
def test_nonsense_is_refused_with_the_name(name: str, value: Any) -> None:
    with pytest.raises(SettingsError):
        changed(preset("draft"), {name: value})


@pytest.mark.parametrize("text", ["iterations = [", "unknown = 1", "iterations = \"many\"", "[flare]\nform = 3"])
def test_a_damaged_config_is_refused_by_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.toml"
    path.write_text(text)
    with pytest.raises(RunError, match=r"config\.toml"):
        read_config(path)
