# SPDX-License-Identifier: GPL-3.0-or-later
"""Every kernel set against the definition in float64: pictures within 1e-5, gradients within 1e-3."""
from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from core.gaussians import tiled, tiles
from core.gaussians.kernels import is_available
from tests.core.gaussian_cases import differences, scene_case, splat_case

SETS = [name for name in ("tiles", "cpu") if is_available(name)]
SCENES = 200
SPLATS = 100
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("kernels", SETS)
@pytest.mark.parametrize("part", range(10))
def test_scenes_equal_the_definition(kernels: str, part: int) -> None:
    wrong = [line for seed in range(part, SCENES, 10) for line in differences(scene_case(seed), kernels)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("kernels", SETS)
@pytest.mark.parametrize("part", range(10))
def test_splats_equal_the_definition(kernels: str, part: int) -> None:
    wrong = [line for seed in range(part, SPLATS, 10) for line in differences(splat_case(seed), kernels)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("kernels", SETS)
def test_raw_parameters_equal_activated_ones(kernels: str) -> None:
    """Compares logarithms and logits with activated parameters, also for fewer than 16 Gaussians."""
    wrong = []
    for seed in range(0, SCENES, 5):
        case = scene_case(seed)
        inputs = dict(case.inputs)
        inputs["scales"] = inputs["scales"].clamp(min=1e-12).log()
        inputs["opacities"] = torch.logit(inputs["opacities"], eps=1e-5)
        wrong += differences(replace(case, inputs=inputs, options={**case.options, "raw": True}), kernels)
    assert not wrong, "\n".join(wrong)


def test_tiles_in_small_chunks_give_the_same_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long lists are drawn in parts, tiles in groups, pictures in bands: where the parts end makes no difference."""
    monkeypatch.setattr(tiles, "ENTRIES_PER_CHUNK", 7)
    monkeypatch.setattr(tiles, "TILES_PER_GROUP", 3)
    monkeypatch.setattr(tiled, "MAX_ENTRIES", 50)
    cases = [scene_case(seed) for seed in range(11, 50, 13)] + [splat_case(seed) for seed in range(10)]
    wrong = [line for case in cases for line in differences(case, "tiles")]
    assert not wrong, "\n".join(wrong)
