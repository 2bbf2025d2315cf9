# SPDX-License-Identifier: GPL-3.0-or-later
"""Optimisation of a scene: loss, Adam, densification, Morton order."""
from __future__ import annotations

import math
from contextlib import nullcontext
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d
from scipy.spatial import cKDTree
from torch import Tensor

from core.capture import Camera, PointCloud
from core.errors import RunError, SettingsError
from core.fit.optimisers import Optimisers
from core.fit.settings import FitSettings
from core.flare.visibility import light_visibility
from core.gaussians import Adam, Rendering, SceneGaussians, kernels, l1_ssim, ssim
from core.gaussians.densification import Classic, ClassicSettings, Mcmc, McmcSettings, relocated_opacity_and_scale
from core.gaussians.optimiser import TorchStep, adam_step, adam_steps
from core.gaussians.ordering import morton_order, nearest_distances


def pictures(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator)
    return (target + 0.2 * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


# Loss


def test_ssim_equals_scipy_filters() -> None:
    """Against the formula, windowed by scipy in double precision."""
    image, target = (p.double().numpy() for p in pictures(23, 31))
    x = np.arange(11) - 5
    window = np.exp(-(x**2) / (2 * 1.5**2))
    window /= window.sum()

    def blur(p: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(p, window, 0, mode="constant"), window, 1, mode="constant")

    a, b = blur(image), blur(target)
    va, vb, cov = blur(image**2) - a**2, blur(target**2) - b**2, blur(image * target) - a * b
    expected = (2 * a * b + 1e-4) * (2 * cov + 9e-4) / ((a**2 + b**2 + 1e-4) * (va + vb + 9e-4))
    assert float(ssim(torch.tensor(image), torch.tensor(target))) == pytest.approx(expected.mean(), abs=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (5, 40), (33, 47)])
@pytest.mark.parametrize("lam", [0.0, 0.8, 1.0])
def test_the_loss_in_single_precision_equals_double_precision(size: tuple[int, int], lam: float) -> None:
    """Whichever kernels are at hand, against plain torch in double precision."""
    image, target = pictures(*size)
    exact_image = image.double().requires_grad_()
    exact = l1_ssim(exact_image, target.double(), lam)
    exact.backward()
    image.requires_grad_()
    loss = l1_ssim(image, target, lam)
    (2 * loss).backward()
    assert loss.item() == pytest.approx(exact.item(), abs=1e-6)
    error = torch.linalg.vector_norm(image.grad / 2 - exact_image.grad)
    assert error <= 1e-4 * torch.linalg.vector_norm(exact_image.grad)


def test_the_loss_of_equal_pictures_is_zero() -> None:
    _, target = pictures(20, 20)
    assert l1_ssim(target.clone(), target, 0.8).item() == pytest.approx(0, abs=1e-6)


def test_the_loss_raises_for_different_sizes() -> None:
    with pytest.raises(SettingsError, match="must both be"):
        l1_ssim(torch.zeros(4, 5, 3), torch.zeros(5, 4, 3), 0.8)


# Adam


def test_adam_steps_equal_torch() -> None:
    generator = torch.Generator().manual_seed(0)
    start = {"a": torch.randn(7, 3, generator=generator), "b": torch.randn(5, generator=generator)}
    ours = {name: torch.nn.Parameter(value.clone()) for name, value in start.items()}
    theirs = {name: torch.nn.Parameter(value.clone()) for name, value in start.items()}
    optimiser = Adam(ours, {"a": 0.01, "b": 0.3}, epsilon=1e-8)
    reference = torch.optim.Adam(
        [{"params": [theirs["a"]], "lr": 0.01}, {"params": [theirs["b"]], "lr": 0.3}], eps=1e-8, foreach=False
    )
    for step in range(60):
        if step == 30:  # rates may change on the way
            optimiser.rates["a"] = reference.param_groups[0]["lr"] = 0.002
        for name in start:
            gradient = torch.randn(start[name].shape, generator=generator) * 10 ** (step % 5 - 3)
            ours[name].grad, theirs[name].grad = gradient.clone(), gradient.clone()
        optimiser.step()
        reference.step()
    for name in start:
        assert torch.allclose(ours[name], theirs[name], rtol=1e-5, atol=1e-6)


def test_adam_rates_by_column_equal_separate_parameters() -> None:
    rows = torch.nn.Parameter(torch.zeros(4, 2, 3))
    rate = torch.zeros(2, 3)
    rate[0], rate[1, 2] = 0.1, 0.5
    optimiser = Adam({"rows": rows}, {"rows": rate})
    rows.grad = torch.full_like(rows, 3.0)
    optimiser.step()  # the first step has the length of the rate
    assert torch.allclose(rows, (-rate).expand_as(rows), atol=1e-6)


def test_adam_selects_rows_with_their_moments() -> None:
    """Rows that move take along all that decides how they go on."""
    generator = torch.Generator().manual_seed(1)
    start, gradients = torch.randn(6, 2, generator=generator), torch.randn(10, 6, 2, generator=generator)

    def run(order: Tensor | None) -> Tensor:
        """Make all steps, with the rows re-ordered at the sixth unless `order` is None; return the rows."""
        rows = torch.nn.Parameter(start.clone())
        optimiser = Adam({"rows": rows}, 0.1)
        for step, gradient in enumerate(gradients):
            if step == 5 and order is not None:
                optimiser.keep_rows(order)
            rows.grad = gradient[order] if step >= 5 and order is not None else gradient.clone()
            optimiser.step()
        return rows.detach()

    order = torch.tensor([4, 0, 3])
    assert torch.equal(run(order), run(None)[order])


def test_adam_appends_rows_and_resets_moments() -> None:
    rows, other = torch.nn.Parameter(torch.zeros(2, 3)), torch.nn.Parameter(torch.zeros(1))
    optimiser = Adam({"rows": rows, "other": other}, 0.1)
    rows.grad = torch.ones(2, 3)
    optimiser.step()
    optimiser.append_rows({"rows": torch.full((1, 3), 7.0)})
    assert rows.shape == (3, 3) and rows.grad is None and (rows[2] == 7).all()
    assert (optimiser.moments["rows"].first[:2] > 0).all() and (optimiser.moments["rows"].first[2] == 0).all()
    optimiser.reset_moments("rows", torch.tensor([0]))
    assert (optimiser.moments["rows"].second[0] == 0).all() and (optimiser.moments["rows"].second[1] > 0).all()
    assert (other == 0).all()  # no gradient, no step


def test_adam_resumes_from_its_state() -> None:
    rows = torch.nn.Parameter(torch.zeros(3))
    optimiser = Adam({"rows": rows}, 0.1)
    for _ in range(3):
        rows.grad = torch.tensor([1.0, -2.0, 0.5])
        optimiser.step()
    again = torch.nn.Parameter(rows.detach().clone())
    resumed = Adam({"rows": again}, 0.1)
    resumed.load_state_dict(optimiser.state_dict())
    for parameter, adam in ((rows, optimiser), (again, resumed)):
        parameter.grad = torch.tensor([0.3, 0.2, -1.0])
        adam.step()
    assert torch.equal(rows, again)
    with pytest.raises(RunError, match="does not fit rows"):
        Adam({"rows": torch.nn.Parameter(torch.zeros(4))}, 0.1).load_state_dict(optimiser.state_dict())
    with pytest.raises(SettingsError, match="no parameter 'row'"):
        Adam({"rows": rows}, {"row": 0.1})


# Scene and order


def test_points_become_gaussians_of_3dgs_size_and_colour() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.normal(size=(400, 3)).astype(np.float32)
    rgb = rng.integers(0, 256, (400, 3)).astype(np.uint8)
    scene = SceneGaussians.from_points(PointCloud(xyz, rgb, np.zeros(400, np.float32)))
    distances = cKDTree(xyz.astype(np.float64)).query(xyz, 4)[0][:, 1:]
    expected = np.sqrt((distances**2).mean(1))
    assert np.allclose(scene.scales.detach().numpy(), expected[:, None], rtol=1e-4)
    assert np.allclose(scene.opacities.detach().numpy(), 0.1, atol=1e-6)
    shown = scene.sh[:, 0].detach().numpy() * 0.28209479 + 0.5
    assert np.allclose(shown * 255, rgb, atol=1e-3)
    assert not scene.sh[:, 1:].any()
    camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
    assert scene.render(camera, 0).colour.shape == (30, 40, 3)
    with pytest.raises(SettingsError, match="no points"):
        SceneGaussians.from_points(PointCloud(xyz[:0], rgb[:0], np.zeros(0, np.float32)))


@pytest.mark.parametrize("n", [1, 2, 3, 500])
def test_nearest_distances_equal_brute_force(n: int) -> None:
    generator = torch.Generator().manual_seed(n)
    points = torch.randn(n, 3, generator=generator)
    points[n // 2 :, 0] += 100  # two clusters, far apart
    found = nearest_distances(points)
    expected = torch.cdist(points.double(), points.double()).sort(-1).values[:, 1:4]
    assert found.shape == expected.shape
    assert torch.allclose(found.double(), expected, atol=1e-4)


def test_morton_order_keeps_neighbours_together() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(4096, 3, generator=generator)
    order = morton_order(points)
    assert torch.equal(order.sort().values, torch.arange(4096))
    step = torch.linalg.vector_norm(points[order].diff(dim=0), dim=-1).mean()
    assert step < 0.2 * torch.linalg.vector_norm(points.diff(dim=0), dim=-1).mean()
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]])
    assert torch.equal(morton_order(corners), torch.arange(8))  # x the lowest bit


def of_scene(scene: SceneGaussians, extent: float = 1.0, iterations: int = 100) -> Optimisers:
    """Return the optimisers of a scene in a fit without a flare."""
    return Optimisers(scene, flare=None, settings=FitSettings(iterations=iterations), extent=extent, display_white=1.0)


def test_the_rate_decays_exponentially() -> None:
    optimisers = of_scene(SceneGaussians.empty(2), extent=2.0)
    for iteration, expected in ((0, 3.2e-4), (50, 3.2e-5), (100, 3.2e-6)):
        optimisers.set_rates(iteration)
        assert optimisers.scene.rates["means"] == pytest.approx(expected)


CAMERA = Camera(36, 28, 40.0, 40.0, 18.0, 14.0, np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]))


EYE, LIGHT = torch.tensor([0.0, 0, -4]), torch.tensor([0.1, 0.2, 3])


@pytest.mark.parametrize("has_light", [False, True])
@pytest.mark.parametrize("n", [10, 60, 1029, 1060, 2100])
def test_steps_in_backward_equal_separate_steps(n: int, has_light: bool) -> None:
    """Chunks of Gaussians of which the last is short, and numbers too few for a vector, which are not stepped there."""
    target = torch.rand(28, 36, 3, generator=torch.Generator().manual_seed(1))

    def trained(early: bool) -> tuple[SceneGaussians, Adam]:
        """Make three iterations, with Adam's steps inside the backward pass if `early`; return scene and optimiser."""
        scene, optimiser = some_scene(n)
        optimiser.zero_grad()
        for degree in (1, 3, 3):
            loss = l1_ssim(scene.render(CAMERA, degree).colour, target, 0.8)
            if has_light:
                for light in (LIGHT, -LIGHT):
                    loss = loss + light_visibility(scene, EYE, light)
            with optimiser.step_in_backward() if early else nullcontext():
                loss.backward()
            optimiser.step()
            optimiser.zero_grad()
        return scene, optimiser

    (scene, optimiser), (other, later) = trained(True), trained(False)
    assert optimiser.steps == later.steps == dict.fromkeys(later.steps, 4)
    for name, parameter in other.named_parameters():
        # equal but for what the last numbers round to: a gradient of nothing has a sign, and Adam goes by it
        assert torch.allclose(dict(scene.named_parameters())[name], parameter, atol=1e-5), name
        for a, b in zip(optimiser.moments[name], later.moments[name], strict=True):
            assert torch.allclose(a, b, rtol=1e-4, atol=1e-9), name


def test_without_a_rendering_the_gradient_of_a_visibility_is_stepped_later() -> None:
    scene, optimiser = some_scene(100)
    optimiser.zero_grad()
    light_visibility(scene, EYE, LIGHT).backward()
    expected = scene.log_scales.grad
    optimiser.zero_grad()
    with optimiser.step_in_backward():
        light_visibility(scene, EYE, LIGHT).backward()
    assert expected is not None and scene.log_scales.grad is not None
    assert torch.equal(scene.log_scales.grad, expected) and float(expected.abs().max()) > 0
    before = scene.log_scales.clone()
    optimiser.step()
    assert not torch.equal(scene.log_scales, before)


@pytest.mark.skipif(not kernels.is_available("cpu"), reason="the CPU kernels step early")
def test_a_gradient_after_its_step_raises() -> None:
    scene, optimiser = some_scene(100)
    optimiser.zero_grad()
    with optimiser.step_in_backward():
        scene.render(CAMERA).colour.sum().backward()
    assert all(parameter.grad is None for parameter in scene.parameters())
    before = scene.means.clone()
    optimiser.step()  # has nothing left to do
    assert torch.equal(scene.means, before)
    with pytest.raises(RunError, match="rendered twice"), optimiser.step_in_backward():
        (scene.render(CAMERA).colour.sum() + scene.render(CAMERA).colour.sum()).backward()
    scene, optimiser = some_scene(100)
    optimiser.zero_grad()
    early = light_visibility(scene, EYE, LIGHT)  # autograd goes back to what was computed last first
    with pytest.raises(RunError, match="before the rendering"), optimiser.step_in_backward():
        (scene.render(CAMERA).colour.sum() + early).backward()


# Densification


def some_scene(n: int = 60, seed: int = 0) -> tuple[SceneGaussians, Adam]:
    """Return a random scene and its optimiser after one step, so that Adam has moments."""
    generator = torch.Generator().manual_seed(seed)
    scene = SceneGaussians(
        torch.randn(n, 3, generator=generator),
        torch.randn(n, 3, generator=generator) * 0.3 - 3,
        torch.randn(n, 4, generator=generator),
        torch.randn(n, generator=generator),
        torch.randn(n, 16, 3, generator=generator) * 0.1,
    )
    optimiser = of_scene(scene).scene
    for parameter in scene.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimiser.step()
    return scene, optimiser


def seen(n: int, gradients: Tensor) -> Rendering:
    """A rendering whose statistics are these, in half pictures, of a picture of 2 x 2."""
    zero = torch.zeros(2, 2)
    return Rendering(
        torch.zeros(2, 2, 3), zero, zero, zero, torch.zeros(n, 2), torch.ones(n),
        torch.stack([gradients, torch.zeros(n)], 1),
    )  # fmt: skip


def test_classic_clones_splits_and_prunes() -> None:
    scene, optimiser = some_scene(10)
    strategy = Classic(scene, optimiser, 1.0, torch.Generator().manual_seed(0), ClassicSettings(start=0, every=1))
    with torch.no_grad():
        scene.opacity_logits.fill_(0.0)
        scene.opacity_logits[0] = -8  # faint
        scene.log_scales.fill_(math.log(0.005))
        scene.log_scales[1] = math.log(0.05)  # to be split
    before = {name: p.detach().clone() for name, p in scene.named_parameters()}
    gradients = torch.zeros(10)
    gradients[1] = gradients[2] = 1.0
    strategy.observe(seen(10, gradients))
    assert strategy.update(1)
    assert len(scene) == 10 - 1 + 1 + 1  # pruned, split, cloned
    kept = [i for i in range(10) if i not in (0, 1)]
    assert torch.equal(scene.means[:8], before["means"][kept])
    assert torch.equal(scene.means[8], before["means"][2]) and torch.equal(scene.sh[8], before["sh"][2])
    halves = slice(9, 11)
    assert torch.allclose(scene.scales[halves], torch.tensor(0.05 / 1.6))
    away = torch.linalg.vector_norm(scene.means[halves] - before["means"][1], dim=-1)
    assert (away > 0).all() and (away < 5 * 0.05).all()
    for name, moments in optimiser.moments.items():
        assert moments.first.shape == dict(scene.named_parameters())[name].shape
        assert (moments.first[:8] != 0).any() and not moments.first[8:].any()


def test_classic_densifies_the_highest_scores_up_to_its_cap() -> None:
    scene, optimiser = some_scene(20)
    with torch.no_grad():
        scene.opacity_logits.fill_(0.0)
        scene.log_scales.fill_(-8)
    before = scene.means.detach().clone()
    settings = ClassicSettings(start=0, every=1, cap=23)
    strategy = Classic(scene, optimiser, 1.0, torch.Generator().manual_seed(0), settings)
    strategy.observe(seen(20, torch.arange(20.0)))
    strategy.update(1)
    assert len(scene) == 23
    assert torch.equal(scene.means[20:], before[[17, 18, 19]])


def test_classic_resets_opacities() -> None:
    scene, optimiser = some_scene()
    strategy = Classic(scene, optimiser, 1.0, torch.Generator(), ClassicSettings(start=10, reset_every=5))
    before = scene.opacities.detach().clone()
    assert not strategy.update(5)
    assert torch.allclose(scene.opacities, before.clamp(max=0.01))
    assert not optimiser.moments["opacity_logits"].first.any()
    assert optimiser.moments["means"].first.any()


def test_classic_resets_no_opacities_in_its_last_iteration() -> None:
    scene, optimiser = some_scene()
    strategy = Classic(scene, optimiser, 1.0, torch.Generator(), ClassicSettings(start=10, stop=10, reset_every=5))
    before = scene.opacities.detach().clone()
    strategy.update(10)
    assert torch.equal(scene.opacities, before)


def test_classic_refines_only_between_start_and_stop() -> None:
    scene, optimiser = some_scene()
    strategy = Classic(scene, optimiser, 1.0, torch.Generator(), ClassicSettings(start=500, stop=700, every=100))
    strategy.observe(seen(60, torch.ones(60)))
    assert not any(strategy.update(i) for i in (1, 100, 500, 599, 800)) and len(scene) == 60
    assert strategy.update(600)


@pytest.mark.parametrize("copies", [1, 2, 3, 10, 51])
def test_relocated_copies_render_as_one_gaussian(copies: int) -> None:
    """The double sum of the paper's equation 8, term by term."""
    for opacity in (0.01, 0.3, 0.9, 0.99):
        new, factor = relocated_opacity_and_scale(torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies]))
        assert (1 - float(new)) ** copies == pytest.approx(1 - opacity, rel=1e-9)
        total = sum(
            math.comb(i - 1, k) * (-1) ** k * float(new) ** (k + 1) / math.sqrt(k + 1)
            for i in range(1, copies + 1)
            for k in range(i)
        )
        assert float(factor) == pytest.approx(opacity / total, rel=1e-6)


def test_mcmc_relocates_dead_gaussians_and_grows_to_its_cap() -> None:
    scene, optimiser = some_scene(100)
    with torch.no_grad():
        scene.opacity_logits.fill_(0.5)
        scene.opacity_logits[:30] = -9
    alive = scene.means[30:].detach().clone()
    settings = McmcSettings(cap=110, start=0, every=1, noise=0)
    strategy = Mcmc(scene, optimiser, torch.Generator().manual_seed(0), settings)
    counts = []
    for iteration in range(1, 5):
        assert strategy.update(iteration)
        counts.append(len(scene))
    assert counts == [105, 110, 110, 110]
    found = (scene.means.detach()[:, None] == alive).all(-1).any(1)
    assert found.all()  # all are where living ones were
    assert (scene.opacities > 0.005).all()


def test_mcmc_injects_noise_into_faint_gaussians_only() -> None:
    scene, optimiser = some_scene()
    with torch.no_grad():
        scene.opacity_logits.fill_(2.0)
        scene.opacity_logits[:5] = -7
        scene.log_scales.fill_(-1.0)
    before = scene.means.detach().clone()
    strategy = Mcmc(scene, optimiser, torch.Generator().manual_seed(0), McmcSettings(start=10**6))
    assert not strategy.update(1)
    moved = torch.linalg.vector_norm(scene.means - before, dim=-1)
    assert (moved[:5] > 1e-3).all() and not moved[5:].any()
    assert strategy.regulariser().item() > 0


@pytest.mark.parametrize("kind", ["classic", "mcmc"])
def test_a_run_is_determined_by_its_seed(kind: str) -> None:
    def run(seed: int, interrupted: bool) -> Tensor:
        """Change the density for eight iterations, through a saved state at the fifth if `interrupted`; return the
        means."""
        scene, optimiser = some_scene()
        generator = torch.Generator().manual_seed(seed)

        def strategy(generator: torch.Generator) -> Classic | Mcmc:
            if kind == "classic":
                settings = ClassicSettings(start=0, every=2, small=0.0, cap=100)
                return Classic(scene, optimiser, 1.0, generator, settings)
            return Mcmc(scene, optimiser, generator, McmcSettings(cap=100, start=0, every=2))

        current = strategy(generator)
        for iteration in range(1, 9):
            current.observe(seen(len(scene), torch.linspace(0, 1, len(scene))))
            if interrupted and iteration == 5:
                state = current.state_dict()
                current = strategy(torch.Generator().manual_seed(99))
                current.load_state_dict(state)
            current.update(iteration)
            order = morton_order(scene.means)
            optimiser.keep_rows(order)
            current.reorder(order)
        return scene.means.detach()

    assert torch.equal(run(0, False), run(0, False))
    assert torch.equal(run(0, False), run(0, True))
    a, b = run(0, False), run(1, False)
    assert a.shape != b.shape or not torch.equal(a, b)


def test_training_fits_a_picture() -> None:
    """The parts together: a scene learns another one's pictures, and grows on the way."""
    truth, _ = some_scene(40, seed=3)
    with torch.no_grad():
        truth.means *= 0.5
        truth.log_scales += 1.3
        truth.opacity_logits += 2
        truth.sh[:, 0] *= 10
    cameras = []
    for x in (-0.5, 0.0, 0.5):
        pose = np.eye(4)
        pose[:3, 3] = (x, 0, 4)
        cameras.append(Camera(36, 28, 40.0, 40.0, 18.0, 14.0, pose))
    targets = [truth.render(camera, 0).colour.detach() for camera in cameras]
    rng = np.random.default_rng(0)
    points = PointCloud(
        rng.normal(0, 0.5, (30, 3)).astype(np.float32), np.full((30, 3), 128, np.uint8), np.zeros(30, np.float32)
    )
    scene = SceneGaussians.from_points(points)
    optimiser = of_scene(scene, extent=10.0).scene
    settings = ClassicSettings(start=20, every=20, stop=100, gradient=1e-3, cap=80)
    strategy = Classic(scene, optimiser, 1.0, torch.Generator().manual_seed(0), settings)
    losses, counts = [], []
    for iteration in range(1, 151):
        rendering = scene.render(cameras[iteration % 3], 0)
        loss = l1_ssim(rendering.colour, targets[iteration % 3], 0.8)
        optimiser.zero_grad()
        loss.backward()
        strategy.observe(rendering)
        optimiser.step()
        strategy.update(iteration)
        losses.append(loss.item())
        counts.append(len(scene))
    assert np.mean(losses[-6:]) < 0.35 * np.mean(losses[:6])
    assert 30 < counts[-1] <= 80 and all(b >= a - 10 for a, b in pairwise(counts))


@pytest.mark.parametrize("unit", [1.0, 1e-5])
def test_initial_sizes_scale_with_the_unit_of_the_world(unit: float) -> None:
    """Two that coincide have the floor's size, which lies below that of the others."""
    xyz = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    xyz[1] = xyz[2] = xyz[3] = xyz[0]
    cloud = PointCloud((xyz * unit).astype(np.float32), np.full((200, 3), 128, np.uint8),
                       np.zeros(200, np.float32))
    sizes = SceneGaussians.from_points(cloud).log_scales.detach().exp()[:, 0].numpy() / unit
    assert sizes[0] < 0.2 * np.median(sizes)
    assert 0.05 < np.median(sizes) < 0.5


def test_steps_on_all_parameters_at_once_equal_single_steps() -> None:
    """Also with a rate for each column, as spherical harmonics have."""
    generator = torch.Generator().manual_seed(0)
    shapes, rates = ((5, 3), (7,), (4, 6)), (0.01, 0.3, torch.rand(6, generator=generator).double())
    single, joint = ([TorchStep(torch.ones(shape).double(), torch.zeros(shape).double(), torch.zeros(shape).double(),
                                torch.zeros(shape).double(), 1, rate)
                      for shape, rate in zip(shapes, rates, strict=True)] for _ in range(2))
    options = {"beta1": 0.9, "beta2": 0.999, "epsilon": 1e-15}
    for count in range(1, 5):
        gradients = [torch.randn(shape, generator=generator).double() for shape in shapes]
        single, joint = ([step._replace(gradient=gradient, step=count + number)  # parameters that began earlier
                          for number, (step, gradient) in enumerate(zip(steps, gradients, strict=True))]
                         for steps in (single, joint))
        for step in single:
            adam_step(*step, **options)
        adam_steps(joint, **options)
    for expected, made in zip(single, joint, strict=True):
        for name in ("parameter", "first", "second"):
            torch.testing.assert_close(getattr(made, name), getattr(expected, name), rtol=1e-12, atol=1e-12)
