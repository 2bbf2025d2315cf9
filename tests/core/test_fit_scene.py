# SPDX-License-Identifier: GPL-3.0-or-later
"""A fit that begins with a scene trained elsewhere: frozen, it stays bit by bit; refined, it begins there."""
from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from core.capture import Capture
from core.errors import FlareFileError, SettingsError
from core.fit import FitSettings, fit, preset
from core.fit.overrides import override_settings
from core.fit.trainer import Trainer
from core.gaussians import SceneGaussians
from core.gaussians.ply import read_ply, write_ply
from tests.core.flared import flared_capture

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Without removed/ and truth/: only a frozen scene can be fitted to it by default."""
    folder = flared_capture(tmp_path_factory.mktemp("capture"), count=6, dots=80)
    for name in ("removed", "truth"):
        shutil.rmtree(folder / name)
    return Capture.open(folder)


@pytest.fixture(scope="module")
def scene(capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "elsewhere.ply"
    made = SceneGaussians.from_points(capture.points)
    with torch.no_grad():
        made.opacity_logits += 3
    write_ply(path, made)
    return path


def settings(scene: Path, **changes: Any) -> FitSettings:
    return override_settings(preset("draft", iterations=20), {
        "flare.count": 40, "holdout": 0, "scene.start": str(scene),
        "scene.classic.start": 5, "scene.classic.every": 5, **changes})


def test_a_frozen_scene_is_unchanged_while_the_flare_is_fitted(capture: Capture, scene: Path, tmp_path: Path) -> None:
    run = fit(capture, settings(scene, **{"scene.frozen": True}), tmp_path / "run")
    assert (tmp_path / "run" / "scene.ply").read_bytes() == scene.read_bytes()
    begun = Trainer(capture, settings(scene, **{"scene.frozen": True})).flare
    assert run.flare is not None
    assert begun is not None
    assert run.flare.model.lights[0].count > 0
    first, last = (model.lights[0].gaussians["sh"] for model in (begun, run.flare.model))
    assert len(first) != len(last) or not torch.equal(first, last)


def test_a_refined_scene_starts_from_the_ply(capture: Capture, scene: Path) -> None:
    trainer = Trainer(capture, settings(scene, mode="unsup"))
    for name, parameter in read_ply(scene).named_parameters():
        assert torch.equal(parameter, trainer.scene.get_parameter(name)), name
    trainer.step()
    assert not torch.equal(read_ply(scene).means, trainer.scene.means)


def test_an_unusable_initial_scene_is_refused(capture: Capture, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="PLY to start from"):
        override_settings(preset("draft"), {"scene.frozen": True})
    with pytest.raises(FlareFileError, match="cannot be read"):
        Trainer(capture, settings(tmp_path / "none.ply", **{"scene.frozen": True}))
