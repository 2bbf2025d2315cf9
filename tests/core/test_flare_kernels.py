# SPDX-License-Identifier: GPL-3.0-or-later
"""The fused CPU kernels of a flare against their definitions in torch, in float64: values and gradients."""
from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor

from core.fit.optimisers import GridAdam
from core.flare import visibility
from core.flare.compositing import add_light
from core.flare.deformation import DeformationNetwork, QueryRange
from core.flare.encoding import HashGrid
from core.flare.model import OURS, LightFlare, ViewOfLight
from core.flare.visibility import VisibilitySettings
from core.gaussians.far_sphere import FarSphere
from core.gaussians.kernels import is_available
from core.gaussians.scene import SceneGaussians

pytestmark = pytest.mark.skipif(not is_available("cpu"), reason="numba is not installed")


def relative_error(value: Tensor, expected: Tensor) -> float:
    """Return the relative L2 error of a value."""
    return float((value.double() - expected).norm() / expected.norm().clamp_min(1e-12))


@pytest.mark.parametrize(("height", "width", "white"), [(135, 240, 1.0), (3, 5, 2.0), (64, 65, 1.5)])
@pytest.mark.parametrize("has_black", [True, False])
def test_added_light_and_its_gradients_equal_the_definition(height: int, width: int, white: float, has_black: bool
                                                            ) -> None:
    generator = torch.Generator().manual_seed(height)
    scene, light, gradient = (torch.rand(height, width, 3, generator=generator) for _ in range(3))
    scene = (1.2 * scene - 0.1) * white  # some values are clipped
    scene[0, 0], light = 0, light**4
    light[0, 1] = 0
    black = torch.rand(height, width, generator=generator) < 0.1 if has_black else None
    inputs = [part.requires_grad_() for part in (scene, light)]
    exact = [part.detach().double().requires_grad_() for part in inputs]
    results = add_light(*inputs, white, black)
    expected = add_light(*exact, white, black, kernels="torch")
    results.backward(gradient - 0.5)
    expected.backward((gradient - 0.5).double())
    assert float((results - expected).detach().abs().max()) < 2e-6
    for part, exact_part in zip(inputs, exact, strict=True):
        assert part.grad is not None and exact_part.grad is not None
        assert relative_error(part.grad, exact_part.grad) < 1e-5


def test_light_added_over_a_constant_scene_has_no_gradient_for_it() -> None:
    scene, light = torch.rand(8, 9, 3), torch.rand(8, 9, 3, requires_grad=True)
    add_light(scene, light, 1.0).sum().backward()
    assert scene.grad is None and light.grad is not None
    with torch.no_grad():
        assert torch.equal(add_light(scene, light, 1.0), add_light(scene, light.detach().requires_grad_(), 1.0))


@pytest.mark.parametrize("has_black", [True, False])
def test_added_light_keeps_nan_and_clips_infinity(has_black: bool) -> None:
    """A diverged flare or scene stays visible to the check of the loss."""
    scene, light = torch.full((4, 8, 3), 0.5), torch.full((4, 8, 3), 0.25)
    light[0, 0, 1], light[1, 1] = float("nan"), float("inf")
    scene[2, 2, 0] = float("nan")
    black = torch.zeros(4, 8, dtype=torch.bool)
    black[0, 0] = black[1, 1] = True
    result = add_light(scene, light, 1.0, black if has_black else None)
    assert torch.equal(result.isnan(), light.isnan() | scene.isnan())
    assert torch.equal(result[1, 1], torch.ones(3)) and torch.equal(result[3], result[3, :1].expand(8, 3))


@pytest.mark.parametrize(("count", "has_far_layer", "opacity_logit"), [
    (16, False, 2.0), (37, True, 0.0), (300, False, -3.0), (5000, True, -5.0), (4100, False, -5.0),
    (8200, False, -5.0)])  # counts about whole chunks
def test_visibilities_and_their_gradients_equal_the_definition(count: int, has_far_layer: bool, opacity_logit: float
                                                              ) -> None:
    """Two cameras and lights, one of them at the camera; some Gaussians lie behind these or in the far layer."""
    generator = torch.Generator().manual_seed(count)
    scene = SceneGaussians.empty(count)
    with torch.no_grad():
        scene.means.copy_(torch.randn(count, 3, generator=generator) * torch.tensor([0.4, 0.4, 1.5]))
        scene.log_scales.copy_(0.5 * torch.randn(count, 3, generator=generator) - (2 if count < 1000 else 4))
        scene.quaternions.copy_(torch.randn(count, 4, generator=generator))
        scene.opacity_logits.copy_(opacity_logit + torch.randn(count, generator=generator))
    if has_far_layer:
        scene.far = FarSphere((0.1, 0.2, 0.3), 1.5)
    eyes = torch.tensor([[0.0, 0, -3], [0.2, -0.1, -2.5], [0, 0, 1]]).double()
    lights = torch.tensor([[0.0, 0, 3], [0.5, 0.2, 2], [0, 0, 1]]).double()
    results = []
    for kernels in ("cpu", "torch"):
        scene.zero_grad()
        values = visibility._visibilities(scene, eyes, lights, VisibilitySettings(), kernels)
        (values * torch.tensor([1.0, 2.0, 3.0])).sum().backward()
        results.append([values.detach(), *(p.grad.clone() for p in (scene.means, scene.quaternions, scene.log_scales,
                                                                    scene.opacity_logits) if p.grad is not None)])
    assert len(results[0]) == 5 and float(results[0][0][2]) == 1
    if opacity_logit < 0:
        assert 0.02 < float(results[0][0].min()) < 0.98
    # The definition skips what lies behind a transmittance of 1e-4.
    assert torch.allclose(results[0][0], results[1][0], rtol=1e-4, atol=1e-4)
    for value, expected in zip(results[0][1:], results[1][1:], strict=True):
        assert float((value - expected).norm()) < 2e-3 * float(expected.norm()) + 1e-4


def test_each_layer_before_a_hidden_light_has_a_gradient() -> None:
    """The loss of a hidden light makes all of them more transparent, though the light's visibility is nil."""
    scene = SceneGaussians.empty(20)
    with torch.no_grad():
        scene.means[:, 2] = torch.linspace(-2, 2, 20)
        scene.log_scales.fill_(-1)
        scene.opacity_logits.fill_(9)
    eye, light = torch.tensor([0.0, 0, -3]), torch.tensor([0.0, 0, 3])
    with torch.no_grad():
        visible = float(visibility.light_visibility(scene, eye, light))
        assert visible < 1e-4 and float(visibility.light_visibility(scene, eye, light, kernels="torch")) < 1e-4
    loss = visibility.occlusion_loss(scene, eye, [light], VisibilitySettings())
    assert loss is not None
    loss.backward()
    assert scene.means.grad is not None and scene.log_scales.grad is not None
    # Opacities above the largest one that counts have no gradient, as in any rasterizer; the sizes have one.
    assert (scene.log_scales.grad[:, :2] != 0).all()


def test_visibilities_are_the_same_for_any_number_of_threads() -> None:
    generator = torch.Generator().manual_seed(3)
    scene = SceneGaussians.empty(10_000)
    with torch.no_grad():
        scene.means.copy_(torch.randn(10_000, 3, generator=generator))
        scene.log_scales.fill_(-4)
    eye, light = torch.tensor([[0.0, 0, -3]]), torch.tensor([[0.0, 0, 3]])
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            scene.zero_grad()
            value = visibility._visibilities(scene, eye, light, VisibilitySettings(), "cpu")
            value.sum().backward()
            assert scene.means.grad is not None
            results.append((value.detach(), scene.means.grad.clone()))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize(("count", "position_width", "latent_width"), [(1, 1, 4), (37, 2, 0), (203, 1, 4)])
def test_deformations_and_their_gradients_equal_the_definition(count: int, position_width: int, latent_width: int
                                                               ) -> None:
    torch.manual_seed(count)
    query_range = QueryRange((-1.0,) * 3, (1.0,) * 3, (1.0,) * 3)
    heads = {"positions": position_width, "sh": 3, "log_scales": 2, "rest": 12 if position_width == 2 else 3}
    network = DeformationNetwork(heads, query_range, position_width=position_width, latent_width=latent_width,
                                 levels=3, base=4)
    torch.nn.init.normal_(network.head.weight, std=0.1)
    exact = copy.deepcopy(network).double()
    positions = torch.randn(count, position_width, requires_grad=True)
    latent = torch.randn(count, latent_width, requires_grad=True) if latent_width else None
    features, gradient = torch.randn(12, requires_grad=True), torch.randn(count, sum(heads.values()))
    results = []
    for model, kernels in ((network, "auto"), (exact, "torch")):
        dtype = model.head.weight.dtype
        inputs = [None if part is None else part.detach().to(dtype).requires_grad_()
                  for part in (positions, latent, features)]
        offsets = model.offsets(*inputs, kernels=kernels)
        offsets.backward(gradient.to(dtype))
        results.append([offsets.detach(), *(part.grad for part in inputs if part is not None),
                        *(parameter.grad for parameter in model.parameters() if parameter.grad is not None)])
    assert len(results[0]) == len(results[1]) == (13 if latent_width else 12)
    for value, expected in zip(*results, strict=True):
        assert relative_error(value, expected) < 1e-5


def test_deformations_are_bitwise_the_same_each_time() -> None:
    torch.manual_seed(0)
    network = DeformationNetwork({"sh": 3}, QueryRange((-1.0,) * 3, (1.0,) * 3, (1.0,) * 3), latent_width=4, levels=3)
    torch.nn.init.normal_(network.head.weight)
    positions, latent, features = torch.randn(500, 1), torch.randn(500, 4), torch.randn(12)
    gradients = []
    for _ in range(3):
        network.zero_grad()
        network.offsets(positions, latent, features).square().sum().backward()
        gradients.append(network.layers[0].weight.grad)
    assert torch.equal(gradients[0], gradients[1]) and torch.equal(gradients[0], gradients[2])


@pytest.mark.parametrize(("levels", "base", "bits"), [(3, 4, 14), (16, 16, 8)])
def test_a_hash_grid_and_its_sparse_gradient_equal_the_definition(levels: int, base: int, bits: int) -> None:
    torch.manual_seed(0)
    grid = HashGrid(bits, 1.4, levels, base=base)
    torch.nn.init.normal_(grid.table.weight)
    for point in (torch.rand(3), torch.tensor([0.0, 1.0, -0.2]), torch.tensor([1.0, 1.3, 0.5])):
        gradient, results = torch.randn(2 * levels), []
        for interpolate in (grid, grid.interpolate):
            grid.zero_grad()
            features = interpolate(point)
            features.backward(gradient)
            assert grid.table.weight.grad is not None and grid.table.weight.grad.is_sparse
            results.append((features.detach(), grid.table.weight.grad.to_dense()))
        for value, expected in zip(*results, strict=True):
            assert relative_error(value, expected.double()) < 1e-6


def test_the_steps_of_grids_equal_those_of_torch() -> None:
    torch.manual_seed(0)
    tables = [torch.nn.Parameter(torch.zeros(50, 2)) for _ in range(2)]
    optimisers = GridAdam(tables[:1], lr=0.01), torch.optim.SparseAdam(tables[1:], lr=0.01)
    for _ in range(5):
        rows, values = torch.randint(0, 20, (1, 24)), torch.randn(24, 2)  # some rows are repeated
        for table, optimiser in zip(tables, optimisers, strict=True):
            table.grad = torch.sparse_coo_tensor(rows, values, (50, 2), check_invariants=True)
            optimiser.step()
    assert relative_error(tables[0].detach(), tables[1].detach().double()) < 1e-6
    fused, plain = (optimiser.state[table] for optimiser, table in zip(optimisers, tables, strict=True))
    assert fused["step"] == plain["step"]
    assert relative_error(fused["exp_avg_sq"], plain["exp_avg_sq"].double()) < 1e-6


@pytest.mark.parametrize("floor", [0.0, 0.5])
def test_placed_gaussians_and_their_gradients_equal_the_definition(floor: float, monkeypatch: pytest.MonkeyPatch
                                                                   ) -> None:
    generator = torch.manual_seed(3)
    flare = LightFlare(OURS, QueryRange((-1.0,) * 3, (1.0,) * 3, (1.0,) * 3), 200, generator, scale=0.7)
    for parameter in flare.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    with torch.no_grad():
        flare.gaussians["rings"][:20, 1] *= 20  # some widths are clipped
        flare.gaussians["sh"][:50] -= 2  # and some colours
    exact = copy.deepcopy(flare).double()
    results = []
    for model in (flare, exact):
        dtype = model.gaussians["sh"].dtype
        view = ViewOfLight(torch.rand(3, generator=torch.manual_seed(1)).to(dtype), torch.eye(3, dtype=dtype),
                           torch.tensor([0.2, -0.1], dtype=dtype), 1.0)
        placed = model(view, floor)
        parts = [part for part in placed if part is not None]
        weights = [torch.randn(part.shape, generator=torch.manual_seed(number)) for number, part in enumerate(parts)]
        torch.stack([(part * weight).sum() for part, weight in zip(parts, weights, strict=True)]).sum().backward()
        results.append([*(part.detach() for part in parts), *(
            parameter.grad.to_dense() for parameter in model.parameters() if parameter.grad is not None)])
    assert len(results[0]) == len(results[1]) > 20
    for value, expected in zip(*results, strict=True):
        assert relative_error(value, expected) < 2e-5
    monkeypatch.setattr(flare, "_place", None)
    flare(ViewOfLight(torch.rand(3), torch.eye(3), torch.rand(2), 1.0))  # drawn by the kernels alone
