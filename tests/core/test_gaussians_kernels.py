# SPDX-License-Identifier: GPL-3.0-or-later
"""Every kernel set against the definition in float64: pictures within 1e-5, gradients within 1e-3."""
from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

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
