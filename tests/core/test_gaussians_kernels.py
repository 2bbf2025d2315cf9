# SPDX-License-Identifier: GPL-3.0-or-later
"""Every kernel set against the definition in float64: pictures within 1e-5, gradients within 1e-3."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from core.gaussians import tiled, tiles
from core.gaussians.kernels import available
from tests.core.gaussian_cases import differences, scene_case, splat_case

SETS = [name for name in ("tiles", "cpu") if available(name)]
SCENES = 200
SPLATS = 100


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Pictures this small are only slowed down by threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("kernels", SETS)
@pytest.mark.parametrize("part", range(10))
def test_scenes(kernels: str, part: int) -> None:
    wrong = [line for seed in range(part, SCENES, 10) for line in differences(scene_case(seed), kernels)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("kernels", SETS)
@pytest.mark.parametrize("part", range(10))
def test_splats(kernels: str, part: int) -> None:
    wrong = [line for seed in range(part, SPLATS, 10) for line in differences(splat_case(seed), kernels)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("kernels", SETS)
def test_logarithms_and_logits(kernels: str) -> None:
    """The same scenes in the form in which they are optimised; of fewer than 16 Gaussians, too."""
    wrong = []
    for seed in range(0, SCENES, 5):
        case = scene_case(seed)
        inputs = dict(case.inputs)
        inputs["scales"] = inputs["scales"].clamp(min=1e-12).log()
        inputs["opacities"] = torch.logit(inputs["opacities"], eps=1e-5)
        wrong += differences(replace(case, inputs=inputs, options={**case.options, "raw": True}), kernels)
    assert not wrong, "\n".join(wrong)


def test_tiles_in_small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long lists are drawn in parts, tiles in groups, pictures in bands: where the parts end makes no difference."""
    monkeypatch.setattr(tiles, "CHUNK", 7)
    monkeypatch.setattr(tiles, "GROUP", 3)
    monkeypatch.setattr(tiled, "ENTRIES_MAX", 50)
    cases = [scene_case(seed) for seed in range(11, 50, 13)] + [splat_case(seed) for seed in range(10)]
    wrong = [line for case in cases for line in differences(case, "tiles")]
    assert not wrong, "\n".join(wrong)
