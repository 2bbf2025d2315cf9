# SPDX-License-Identifier: GPL-3.0-or-later
"""The trainers of the studies in benchmarks/ keep step with the fit's own."""
from __future__ import annotations

import pytest
import torch

from benchmarks.bilateral import BilateralTrainer
from benchmarks.exact_scene import ExactSceneTrainer
from core.capture import Capture
from core.fit import preset
from core.fit.overrides import override_settings
from tests.core.flared import flared_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return Capture.open(flared_capture(tmp_path_factory.mktemp("capture"), count=5))


def test_the_flare_alone_is_fitted_over_the_exact_scene(capture: Capture) -> None:
    settings = override_settings(preset("draft", iterations=4),
                                 {"flare.count": 60, "flare.occlusion": False, "holdout": 4})
    trainer = ExactSceneTrainer(capture, settings)
    assert trainer.flare is not None
    before = _values(trainer.flare)
    scene = _values(trainer.scene)
    assert trainer.step()["loss"] > 0
    assert _changed(before, _values(trainer.flare))
    assert not _changed(scene, _values(trainer.scene))


def test_a_scene_and_the_grid_of_the_frame_are_fitted_together(capture: Capture) -> None:
    settings = override_settings(preset("draft", iterations=4, mode="3dgs"), {"holdout": 4})
    trainer = BilateralTrainer(capture, settings)
    scene, cells = _values(trainer.scene), _values(trainer.grids)
    assert trainer.step()["loss"] > 0
    assert _changed(scene, _values(trainer.scene))
    number = trainer.views.index(trainer._pick_view())
    assert _changed(cells, _values(trainer.grids)) == {f"cells.{number}"}


def _values(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in module.named_parameters()}


def _changed(before: dict[str, torch.Tensor], after: dict[str, torch.Tensor]) -> set[str]:
    return {name for name, value in before.items() if not torch.equal(value, after[name])}
