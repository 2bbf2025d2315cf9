# SPDX-License-Identifier: GPL-3.0-or-later
"""The kernels for NVIDIA GPUs without one: on Warp's CPU device, and through its compiler."""
from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from core.gaussians import kernels, rasterization, tiled
from tests.core.gaussian_cases import differences, scene_case, splat_case

wp = pytest.importorskip("warp")
warp_kernels = pytest.importorskip("core.gaussians.warp_kernels")
warp_scene = pytest.importorskip("core.gaussians.warp_scene")


@pytest.fixture
def _as_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    """The name "cuda" leads to the same kernels, wherever the tensors are."""
    stand_in = SimpleNamespace(
        rasterize_scene=warp_scene.rasterize_scene,
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


@pytest.mark.usefixtures("_as_cuda")
def test_a_picture_with_too_many_entries_is_drawn_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warp_scene, "MAX_ENTRIES", 3)
    wrong = [line for seed in range(6) for line in differences(scene_case(seed), "cuda")]
    assert not wrong, "\n".join(wrong)


@pytest.mark.usefixtures("_as_cuda")
def test_raw_parameters_give_the_picture_and_the_gradients_of_the_definition() -> None:
    """Scales as logarithms, opacities as logits; an opacity of 0 has an infinite logit."""
    inputs = scene_case(9).inputs
    raw = {**inputs, "scales": inputs["scales"].log(), "opacities": inputs["opacities"].logit()}
    raw["opacities"][0] = -torch.inf
    results = {}
    for name, dtype in (("torch", torch.float64), ("cuda", torch.float32)):
        parameters = {key: value.to(dtype).requires_grad_() for key, value in raw.items()}
        rendering = rasterization(**parameters, width=33, height=17, raw=True, kernels=name)  # type: ignore[arg-type]
        rendering.colour.square().sum().backward()
        results[name] = {"colour": rendering.colour.detach(), **{
            key: parameters[key].grad for key in ("means", "quats", "scales", "opacities", "sh", "world_to_camera")}}
    for key, expected in results["torch"].items():
        tried = results["cuda"][key]
        assert torch.isfinite(tried).all() and (tried - expected).norm() <= 1e-3 * expected.norm() + 1e-5, key


@pytest.mark.usefixtures("_as_cuda")
@pytest.mark.parametrize("n", [0, 3])
def test_a_scene_that_shows_nothing_is_black(n: int) -> None:
    """Without Gaussians, and with Gaussians that are not finite or behind the camera."""
    means = torch.tensor([[0.0, 0, -1], [torch.nan, 0, 1], [0, 0, 2]])[:n].requires_grad_()
    scales = torch.tensor([[1.0, 1, 1], [1, 1, 1], [torch.inf, 1, 1]])[:n]
    rendering = rasterization(
        means, torch.ones(n, 4), scales, torch.ones(n), torch.ones(n, 16, 3), torch.eye(4),
        torch.tensor([[10.0, 0, 8], [0, 10, 8], [0, 0, 1]]), 16, 16, kernels="cuda",
    )  # fmt: skip
    assert not rendering.colour.any() and not rendering.alpha.any() and not rendering.radii.any()
    rendering.colour.sum().backward()


@pytest.mark.skipif(not wp.get_cuda_toolkit_version(), reason="this build of Warp has no CUDA compiler")
@pytest.mark.parametrize("arch", [75, 90])
def test_warp_kernels_compile_for_a_gpu(arch: int, tmp_path: Path) -> None:
    for kernel in warp_kernels._kernels(5):
        kernel.module.options["block_dim"] = warp_kernels.BLOCK
        written = wp.compile_aot_module(kernel.module, arch=arch, module_dir=tmp_path, strip_hash=False)
        assert all(Path(file).stat().st_size > 1000 for file in written) and written


@pytest.mark.skipif(not wp.get_cuda_toolkit_version(), reason="this build of Warp has no CUDA compiler")
@pytest.mark.parametrize("number", range(4))
def test_kernels_of_a_scene_compile_for_a_gpu(number: int, tmp_path: Path) -> None:
    module = warp_scene.KERNELS[number].module
    written = wp.compile_aot_module(module, arch=75, module_dir=tmp_path, strip_hash=False)
    assert written and all(Path(file).stat().st_size > 1000 for file in written)


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
