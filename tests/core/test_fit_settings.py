# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings survive config.toml, presets hold the paper's figures, and nonsense is refused."""
from __future__ import annotations

import typing
from collections.abc import Iterator
from dataclasses import is_dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest

from core.choices import Mode
from core.errors import RunError, SettingsError
from core.fit.config import read_config, write_config
from core.fit.overrides import RENAMED, override_settings
from core.fit.settings import BOUNDS, FitSettings, preset
from tests.core.recording_progress import RecordingProgress


@pytest.mark.parametrize("name", ["draft", "standard", "high", "paper"])
@pytest.mark.parametrize("model", ["paper", "ours"])
def test_a_config_is_read_as_it_was_written(tmp_path: Path, name: Any, model: Any) -> None:
    settings = override_settings(preset(name, model=model), {"holdout": 'odd "name"\\.json', "seed": 7})
    write_config(tmp_path / "config.toml", settings)
    assert read_config(tmp_path / "config.toml") == settings


def test_a_run_from_before_sparse_captures_keeps_its_schedule(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    write_config(path, preset("draft", mode="split"))
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join(line for line in lines if not line.startswith("few_views")), encoding="utf-8")
    assert read_config(path).split.few_views == 0


def test_a_config_with_a_retired_setting_opens(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    write_config(path, preset("draft", mode="split"))
    path.write_text(path.read_text().replace("[split]\n", "[split]\nexcess_unfound = 0.5\n"))
    assert "excess_unfound" in path.read_text()
    assert read_config(path) == preset("draft", mode="split")


def other_value(name: str) -> bool | float:
    """A valid value of a renamed setting that no preset has."""
    value = attrgetter(RENAMED[name])(preset("draft"))
    return not value if isinstance(value, bool) else value + 1 if isinstance(value, int) else value / 2 + 0.1


@pytest.mark.parametrize("old", RENAMED)
def test_a_renamed_setting_is_read_under_its_old_name_and_reported(tmp_path: Path, old: str) -> None:
    new, value, heard = RENAMED[old], other_value(old), RecordingProgress()
    expected = override_settings(preset("draft"), {new: value}, heard)
    assert expected != preset("draft") and not heard.texts
    assert override_settings(preset("draft"), {old: value}, heard) == expected
    assert len(heard.texts) == 1 and old in heard.texts[0] and new in heard.texts[0]
    with pytest.raises(SettingsError):  # an old name is parsed and bounded like the new one
        override_settings(preset("draft"), {old: "many"})

    path = tmp_path / "config.toml"
    write_config(path, expected)
    *table, key = new.split(".")
    head, tail = path.read_text().split("\n[" + ".".join(table) + "]\n") if table else ("", path.read_text())
    before, line = f"\n{key} = ", f"\n{old.split('.')[-1]} = "
    assert f"\n{tail}".count(before) >= 1
    section = f"\n{tail}".replace(before, line, 1)[1:]
    path.write_text(head + "\n[" + ".".join(table) + "]\n" + section if table else section)
    assert read_config(path, heard) == expected
    assert len(heard.texts) == 2 and f"{old} is now {new}" in heard.texts[1]


def test_every_present_name_of_a_renamed_setting_exists_and_no_old_one() -> None:
    settings = preset("draft")
    for old, new in RENAMED.items():
        attrgetter(new)(settings)
        with pytest.raises(AttributeError):
            attrgetter(old)(settings)


def test_a_renamed_value_is_read(tmp_path: Path) -> None:
    assert override_settings(preset("draft"), {"exposure": "found"}).exposure == "measured"
    path = tmp_path / "config.toml"
    write_config(path, preset("draft"))
    path.write_text(path.read_text().replace('"measured"', '"found"'))
    assert read_config(path) == preset("draft")


@pytest.mark.parametrize("mode", ["split", "estimated"])
def test_a_fit_by_parallax_is_a_fifth_longer_unless_its_length_is_given(mode: Mode) -> None:
    made = preset("draft", mode=mode)
    assert (preset("draft").iterations, made.iterations) == (1500, 1800)
    assert made == preset("draft", mode=mode, iterations=1800)
    assert preset("draft", mode=mode, iterations=400).iterations == 400


@pytest.mark.parametrize("name", ["a\nb\r.ply", "a\tb\x00\x1b\x7f.ply", "Straße 写真 \U0001f526.ply"])
def test_names_of_any_characters_survive_config_toml(tmp_path: Path, name: str) -> None:
    settings = override_settings(preset("draft"), {"scene.start": name})
    write_config(tmp_path / "config.toml", settings)
    assert read_config(tmp_path / "config.toml").scene.start == name


def test_a_name_that_is_not_utf_8_is_refused() -> None:
    for setting in ("scene.start", "holdout"):
        with pytest.raises(SettingsError, match="not UTF-8"):
            override_settings(preset("draft"), {setting: "cap\udcff"})


def numbers(kind: Any, prefix: str = "") -> Iterator[tuple[str, bool]]:
    """Dotted names of the settings that can be numbers, and whether those are whole."""
    for name, of in typing.get_type_hints(kind).items():
        if is_dataclass(of):
            yield from numbers(of, f"{prefix}{name}.")
        elif {int, float} & {of, *typing.get_args(of)}:
            yield f"{prefix}{name}", float not in (of, *typing.get_args(of))


NUMBERS = dict(numbers(FitSettings))


def test_every_number_has_bounds() -> None:
    assert NUMBERS.keys() == BOUNDS.keys()


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_lies_within_its_bounds(name: str) -> None:
    bounds, settings = BOUNDS[name], preset("draft")
    step = 1 if NUMBERS[name] else 1e-9
    good = [bounds.minimum + step * bounds.exclusive_minimum, bounds.maximum - step * bounds.exclusive_maximum]
    bad = [bounds.minimum - step * (not bounds.exclusive_minimum), -1, -1e30,
           bounds.maximum * 1.01 + step, 10**30, 10**400]
    if bounds.exclusive_maximum:
        bad.append(bounds.maximum)
    for value in good:
        override_settings(settings, {name: value})
    for value in bad:
        with pytest.raises(SettingsError, match=f"{name}.* (must lie|cannot be used so)"):
            override_settings(settings, {name: int(value) if NUMBERS[name] else value})


def test_numbers_too_long_to_be_written_are_refused() -> None:
    for name, value in (("mode", 1 << 20_000), ("ssim_share", 1 << 20_000), ("holdout", "9" * 5000)):
        with pytest.raises(SettingsError):
            override_settings(preset("draft"), {name: value})


def test_a_preset_of_an_invalid_length_is_refused_in_one_line() -> None:
    for length in (0, -5, 10**400):
        with pytest.raises(SettingsError, match="iterations must lie"):
            preset("draft", iterations=length)


def test_the_paper_preset_is_the_paper() -> None:
    """The preset has the paper's numbers, and its cloning ends near the paper's number of Gaussians."""
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


def test_the_paper_preset_of_another_length_is_the_paper_stretched() -> None:
    settings = preset("paper", iterations=3000)
    density, scene = settings.flare.density, settings.scene
    assert (density.start, density.stop, density.every) == (100, 1200, 50)
    assert (scene.classic.start, scene.classic.stop, scene.classic.every) == (50, 1500, 10)
    assert (scene.classic.reset_every, scene.sh_every) == (300, 100)
    assert preset("paper", iterations=30000) == preset("paper")


@pytest.mark.parametrize(("name", "value", "kind"), [
    ("flare.count", "abc", "a whole number"), ("flare.rates.network", "quick", "a number"),
    ("flare.snap_lights", 1, "true or false"), ("scene.start", 3, "text")])
def test_errors_name_the_type_of_a_setting(name: str, value: Any, kind: str) -> None:
    with pytest.raises(SettingsError, match=f"{value!r} is not {kind}"):
        override_settings(preset("draft"), {name: value})


@pytest.mark.parametrize("name", ["draft", "standard", "high", "paper"])
def test_every_schedule_lies_within_a_fit_of_any_length(name: Any) -> None:
    for length in (300, 1500, 30000):
        scene = preset(name, iterations=length).scene
        for strategy in (scene.classic, scene.mcmc):
            assert strategy.start < strategy.stop < length
    assert preset("draft").scene.mcmc.cap == preset("draft").scene.classic.cap


@pytest.mark.parametrize(("name", "value"), [
    ("iterations", 0), ("iterations", 2.5), ("ssim_share", 2.0), ("ssim_share", float("nan")), ("mode", "fast"),
    ("width", -1), ("flare.rates.network", "quick"), ("flare.rates", 1.0), ("nothing", 1), ("seed.low", 1),
    ("flare.count", True), ("mode", "2d"), ("holdout", "²"), ("holdout", "+-5"),
])
def test_an_unknown_setting_or_value_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(SettingsError):
        override_settings(preset("draft"), {name: value})


@pytest.mark.parametrize("text", [
    "", "iterations = 100", "mode = \"split\"\niterations = [", "mode = \"split\"\nunknown = 1",
    "mode = \"split\"\niterations = \"many\"", "mode = \"split\"\n[flare]\nform = 3"])
def test_a_damaged_config_is_refused_by_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.toml"
    path.write_text(text)
    with pytest.raises(RunError, match=r"config\.toml"):
        read_config(path)
