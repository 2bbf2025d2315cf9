# SPDX-License-Identifier: GPL-3.0-or-later
"""The kernels for NVIDIA GPUs without one: on Warp's CPU device, and through its compiler."""
from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from core.gaussians import kernels, tiled
from tests.core.gaussian_cases import differences, scene_case, splat_case

wp = pytest.importorskip("warp")
warp_kernels = pytest.importorskip("core.gaussians.warp_kernels")


@pytest.fixture
def _as_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    """The name "cuda" leads to the same kernels, wherever the tensors are."""
    stand_in = SimpleNamespace(
        rasterize_scene=partial(tiled.rasterize_scene, warp_kernels.draw, warp_kernels.TILE),
        splat=partial(tiled.splat, warp_kernels.draw, warp_kernels.TILE),
    )
    load = kernels._load_kernel_set
    monkeypatch.setattr(kernels, "_load_kernel_set", lambda name: stand_in if name == "cuda" else load(name))


@pytest.mark.usefixtures("_as_cuda")
@pytest.mark.parametrize("part", range(4))
def test_warp_kernels_equal_the_definition(part: int) -> None:
    cases = [scene_case(seed) for seed in range(part, 80, 4)] + [splat_case(seed) for seed in range(part, 40, 4)]
    wrong = [line for case in cases for line in differences(case, "cuda")]
    assert not wrong, "\n".join(wrong)


@pytest.mark.skipif(not wp.get_cuda_toolkit_version(), reason="this build of Warp has no CUDA compiler")
@pytest.mark.parametrize("arch", [75, 90])
def test_warp_kernels_compile_for_a_gpu(arch: int, tmp_path: Path) -> None:
    for kernel in warp_kernels._kernels(5):
        kernel.module.options["block_dim"] = warp_kernels.BLOCK
        written = wp.compile_aot_module(kernel.module, arch=arch, module_dir=tmp_path, strip_hash=False)
        assert all(Path(file).stat().st_size > 1000 for file in written) and written


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU")
@pytest.mark.parametrize("part", range(4))
@pytest.mark.parametrize("name", ["cuda", "tiles"])
def test_cuda_kernels_equal_the_definition_on_a_gpu(name: str, part: int) -> None:
    cases = [scene_case(seed) for seed in range(part, 200, 4)] + [splat_case(seed) for seed in range(part, 100, 4)]
    wrong = [line for case in cases for line in differences(case, name, "cuda")]
    assert not wrong, "\n".join(wrong)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU")
def test_auto_selects_cuda_kernels_on_a_gpu() -> None:
    assert kernels._fastest_kernel_set(torch.zeros(1, device="cuda")) == "cuda"
