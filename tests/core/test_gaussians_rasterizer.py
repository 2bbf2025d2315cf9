# SPDX-License-Identifier: GPL-3.0-or-later
"""The public functions and the definition, compared with formulas and independent computations."""
from __future__ import annotations

import logging
import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch import Tensor

from core.errors import EngineError, SettingsError
from core.gaussians import kernels as registry
from core.gaussians import rasterization, splat
from core.gaussians.projection import project, rotation_matrices
from core.gaussians.reference import profiles
from core.gaussians.rendering import ALPHA_MIN, OPACITY_MAX, PROFILE_MIN, arc_strengths, cutoff_radii, normalise_arcs
from core.gaussians.spherical_harmonics import basis, colours

SETS = [name for name in ("torch", "tiles", "cpu") if registry.is_available(name)]
K = torch.tensor([[40.0, 0, 10], [0, 40.0, 8], [0, 0, 1]])
SIZE = (20, 16)


def scene(n: int = 3, **changes: Tensor) -> dict[str, Tensor]:
    """Return inputs of `rasterization`: round Gaussians of different colours one behind the other, from z = 2 on, one
    apart.

    changes: inputs to replace.
    """
    z = torch.arange(n) + 2.0
    sh = torch.zeros(n, 1, 3)
    sh[torch.arange(n), 0, torch.arange(n) % 3] = 0.5 / 0.28209479177387814  # 1 there, 1/2 elsewhere
    zero = torch.zeros(n)
    return {
        "means": torch.stack([zero, zero, z], 1), "quats": torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        "scales": torch.full((n, 3), 0.1), "opacities": torch.full((n,), 0.6), "sh": sh,
        "world_to_camera": torch.eye(4), "intrinsics": K, **changes,
    }  # fmt: skip


@pytest.mark.parametrize("kernels", SETS)
def test_three_gaussians_in_a_row_blend_front_to_back(kernels: str) -> None:
    """Colour, alpha and depths at the middle of the picture, term by term."""
    background = torch.tensor([0.2, 0.4, 0.8])
    order = torch.tensor([2, 0, 1])  # given out of order
    given = scene()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        given[name] = given[name][order]
    r = rasterization(**given, width=SIZE[0], height=SIZE[1], background=background, kernels=kernels)
    t, colour, depth = 1.0, torch.zeros(3), 0.0
    median = 0.0
    for i, z in enumerate((2.0, 3.0, 4.0)):
        variance = (40 * 0.1 / z) ** 2 + 0.3
        alpha = 0.6 * math.exp(-0.5 * (0.5**2 + 0.5**2) / variance)
        shown = torch.full((3,), 0.5)
        shown[i] = 1.0
        colour += t * alpha * shown
        depth += t * alpha * z
        median = z if median == 0 and t * (1 - alpha) < 0.5 else median
        t *= 1 - alpha
    assert torch.allclose(r.colour[8, 10], colour + t * background, atol=1e-5)
    assert r.alpha[8, 10].item() == pytest.approx(1 - t, abs=1e-5)
    assert r.depth[8, 10].item() == pytest.approx(depth / (1 - t), abs=1e-4)
    assert r.median_depth[8, 10].item() == pytest.approx(median)
    assert torch.allclose(r.colour[0, 0], background) and r.alpha[0, 0] == 0  # 1/255 is reached before the corner
    assert r.depth[0, 0] == 0 and r.median_depth[0, 0] == 0
    assert torch.allclose(r.centres, torch.tensor([10.0, 8.0]).repeat(3, 1))
    expected = [3 * math.sqrt((4 / z) ** 2 + 0.3) for z in (4.0, 2.0, 3.0)]
    assert torch.allclose(r.radii, torch.tensor(expected), atol=1e-4)


def test_projection_equals_the_covariance_of_projected_samples() -> None:
    """The mean and covariance of a small Gaussian's points, projected one by one."""
    rng = np.random.default_rng(0)
    quat, scales = rng.normal(size=4), np.array([0.02, 0.05, 0.01])
    w, x, y, z = quat / np.linalg.norm(quat)
    axis, angle = np.array([x, y, z]) / math.sqrt(1 - w * w), 2 * math.acos(w)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    rotation = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross  # Rodrigues
    assert np.allclose(rotation_matrices(torch.tensor(quat[None])).numpy()[0], rotation)

    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    pose[:3, 3] = (0.3, -0.2, 0.5)
    mean = np.array([4.0, 0.5, 0.6])
    points = mean + (rng.normal(size=(400_000, 3)) * scales) @ rotation.T
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    pixels = seen[:, :2] / seen[:, 2:] * [300, 250] + [100, 90]
    intrinsics = torch.tensor([[300.0, 0, 100], [0, 250, 90], [0, 0, 1]], dtype=torch.float64)
    found = project(
        *(torch.tensor(v[None]) for v in (mean, quat, scales)), torch.tensor(pose), intrinsics, 200, 180, 0.2, 0.0
    )
    assert np.allclose(found.centres[0], pixels.mean(0), atol=0.05)
    covariance = np.cov(pixels.T)
    assert np.allclose(found.covariances[0], covariance[[0, 0, 1], [0, 1, 1]], rtol=0.02, atol=0.05)


def test_spherical_harmonics_are_orthonormal() -> None:
    """Integrals over the sphere, by Gauss-Legendre in z and evenly round it; exact for these."""
    z, weights = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * math.tau / 16
    ring = np.sqrt(1 - z[:, None] ** 2)
    directions = np.stack([ring * np.cos(phi), ring * np.sin(phi), np.broadcast_to(z[:, None], (8, 16))], -1)
    functions = basis(torch.tensor(directions.reshape(-1, 3)), 3).numpy()
    area = np.repeat(weights, 16) * math.tau / 16
    assert np.allclose(functions.T @ (functions * area[:, None]), np.eye(16), atol=1e-12)
    # Their signs and order, where each function is simple.
    toward = basis(torch.eye(3, dtype=torch.float64), 3).numpy()
    assert np.allclose(toward[:, 1:4], -0.4886025119029199 * np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0]]))
    assert toward[2, 6] > 0 and toward[0, 8] > 0 and toward[2, 12] > 0 and toward[0, 15] < 0 and toward[1, 9] > 0
    diagonal = basis(torch.tensor([[1.0, 1, 1]], dtype=torch.float64), 3).numpy()[0]
    assert diagonal[4] > 0 and diagonal[5] < 0 and diagonal[7] < 0 and diagonal[10] > 0


def test_colours_are_not_negative() -> None:
    sh = torch.full((1, 1, 3), -5.0, requires_grad=True)
    shown = colours(torch.ones(1, 3), sh, 0)
    assert (shown == 0).all()
    assert torch.isfinite(colours(torch.zeros(1, 3), torch.ones(1, 16, 3), 3)).all()  # the camera inside a mean


@pytest.mark.parametrize("kernels", SETS)
def test_rings_arcs_and_blends_equal_their_formulas(kernels: str) -> None:
    centre, covariance = torch.tensor([[10.0, 8.0]]), torch.tensor([[9.0, 0.0, 4.0]])
    opacity, colour = torch.tensor([0.8]), torch.tensor([[1.0, 2.0, 3.0]])
    rings, arcs = torch.tensor([[1.5, 0.4]]), torch.tensor([[0.2, -0.1]])
    d = np.array([12.5, 9.5]) - [10, 8]
    r = math.sqrt(d[0] ** 2 / 9 + d[1] ** 2 / 4)
    beta = math.hypot(0.2 * 3, 0.1 * 2)
    peak = math.exp(beta * 1.5 + beta**2 * 0.4**2 / 2)
    ring = math.exp(-((r - 1.5) ** 2) / (2 * 0.4**2)) * math.exp(0.2 * d[0] - 0.1 * d[1]) / peak
    laid = splat(centre, covariance, opacity, colour, *SIZE, rings=rings, arcs=arcs, blend="add", kernels=kernels)
    assert torch.allclose(laid.colour[9, 12], 0.8 * ring * colour[0], atol=1e-5)
    assert (laid.transmittance == 1).all()
    twice = [t.repeat(2, *[1] * (t.ndim - 1)) for t in (centre, covariance, opacity, colour)]
    laid = splat(*twice, *SIZE, kernels=kernels)
    alpha = 0.8 * math.exp(-0.5 * r * r)
    assert torch.allclose(laid.colour[9, 12], (alpha + alpha * (1 - alpha)) * colour[0], atol=1e-5)
    assert laid.transmittance[9, 12].item() == pytest.approx((1 - alpha) ** 2, abs=1e-5)
    opaque = splat(centre, covariance * 100, torch.ones(1), torch.ones(1, 3), *SIZE, kernels=kernels)
    assert opaque.transmittance.min().item() == pytest.approx(1 - OPACITY_MAX, abs=1e-3)


@pytest.mark.parametrize("kernels", SETS)
def test_an_arc_of_a_plain_gaussian_is_its_shift(kernels: str) -> None:
    """The shift is covariance b; the peak is unchanged, and an arc of 0 changes nothing."""
    centre, covariance = torch.tensor([[10.0, 8.0]]), torch.tensor([[9.0, 2.0, 4.0]])
    shown = torch.tensor([0.8]), torch.tensor([[1.0, 2.0, 3.0]])
    b = torch.tensor([[0.5, -0.3]])
    shift = torch.tensor([[9 * 0.5 - 2 * 0.3, 2 * 0.5 - 4 * 0.3]])
    for blend in ("over", "add"):
        plain = splat(centre, covariance, *shown, *SIZE, blend=blend, kernels=kernels)
        nothing = splat(centre, covariance, *shown, *SIZE, arcs=torch.zeros(1, 2), blend=blend, kernels=kernels)
        assert torch.allclose(nothing.colour, plain.colour, atol=1e-6)
        moved = splat(centre + shift, covariance, *shown, *SIZE, blend=blend, kernels=kernels)
        arc = splat(centre, covariance, *shown, *SIZE, arcs=b, blend=blend, kernels=kernels)
        assert torch.allclose(arc.colour, moved.colour, atol=1e-5)
        assert torch.allclose(arc.transmittance, moved.transmittance, atol=1e-5)


@pytest.mark.parametrize("seed", range(20))
def test_arcs_have_a_peak_of_one_and_end_at_their_extent(seed: int) -> None:
    """At the radius r0 + w² beta towards covariance b, and nowhere beyond what `cutoff_radii` says."""
    rng = np.random.default_rng(seed)
    factor = torch.tensor([[3.0, 0.0], [rng.normal(), rng.uniform(1, 4)]], dtype=torch.float64)
    (xx, xy), (_, yy) = (factor @ factor.T).tolist()
    covariance = torch.tensor([[xx, xy, yy]], dtype=torch.float64)
    rings = torch.tensor([[rng.uniform(0, 4), rng.uniform(0.2, 2)]], dtype=torch.float64)
    a = torch.tensor(rng.normal(0, 1, 2))
    b = torch.linalg.solve(factor.T, a)[None]
    arcs = normalise_arcs(b, covariance, rings)
    r0, w = rings[0].tolist()
    beta = math.hypot(*a.tolist())
    assert arc_strengths(covariance, b).item() == pytest.approx(beta)
    grid = torch.cartesian_prod(*[torch.linspace(-30, 30, 401, dtype=torch.float64)] * 2)  # whitened
    brightest = (r0 + w * w * beta) * a / beta
    peak, *g = profiles(torch.cat([brightest[None], grid]) @ factor.T, torch.zeros(1, 2), covariance, rings, arcs)[0]
    assert peak.item() == pytest.approx(1) and max(g) <= 1
    for opacity, blend, least in ((1.0, "add", PROFILE_MIN), (0.3, "over", ALPHA_MIN / 0.3)):
        reach = cutoff_radii(torch.tensor([opacity]), blend, rings, arc_strengths(covariance, b)).item()
        drawn = grid[torch.stack(g) >= least]
        assert drawn.norm(dim=1).max() <= reach * (1 + 1e-6)
        edge = reach * a / beta  # on the bright side nothing is given away
        at_edge = profiles((edge @ factor.T)[None], torch.zeros(1, 2), covariance, rings, arcs).item()
        assert at_edge == pytest.approx(least, rel=1e-5)


def test_gradients_of_arcs_equal_finite_differences() -> None:
    inputs = [torch.tensor(values, dtype=torch.float64, requires_grad=True) for values in (
        [[7.3, 6.1], [11.0, 9.5]], [[9.0, 2.0, 4.0], [5.0, -1.0, 8.0]], [0.6, 0.8], [[1.0, 2.0, 3.0], [0.5, 1.0, 0.2]],
        [[1.5, 0.6], [0.0, 1.0]], [[0.3, -0.2], [-0.2, 0.1]])]  # fmt: skip

    def picture(*given: Tensor) -> Tensor:
        *rest, rings, arcs = given
        return splat(*rest, 12, 10, rings=rings, arcs=arcs, blend="over", kernels="torch").colour.sum((0, 1))

    assert torch.autograd.gradcheck(picture, inputs, atol=1e-4)


@pytest.mark.parametrize("kernels", SETS)
def test_empty_inputs_render_an_empty_picture(kernels: str) -> None:
    background = torch.tensor([0.1, 0.2, 0.3], requires_grad=True)
    empty = {name: value[:0] for name, value in scene().items() if name not in ("world_to_camera", "intrinsics")}
    empty["means"].requires_grad_()
    empty |= {"world_to_camera": torch.eye(4), "intrinsics": K}
    r = rasterization(**empty, width=5, height=3, background=background, kernels=kernels)
    assert torch.allclose(r.colour, background.expand(3, 5, 3)) and not r.alpha.any() and r.radii.shape == (0,)
    r.colour.sum().backward()
    assert torch.allclose(background.grad, torch.tensor(15.0))
    behind = scene(means=torch.tensor([[0.0, 0, 0.19], [0, 0, -3], [0, 0, 0]]))
    r = rasterization(**behind, width=5, height=3, kernels=kernels)
    assert not r.colour.any() and not r.radii.any()
    laid = splat(torch.zeros(0, 2), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 3), 5, 3, kernels=kernels)
    assert not laid.colour.any() and (laid.transmittance == 1).all()
    flat = splat(torch.ones(1, 2), torch.tensor([[1.0, 1, 1]]), torch.ones(1), torch.ones(1, 3), 5, 3, kernels=kernels)
    assert not flat.colour.any()


@pytest.mark.parametrize("kernels", SETS)
def test_gradients_of_degenerate_gaussians_are_finite(kernels: str) -> None:
    """Zero quaternions, scales that vanish or cover all, a centre on a pixel's, an opacity of one."""
    given = scene(
        quats=torch.tensor([[0.0, 0, 0, 0], [1e-20, 0, 0, 0], [0, 0, 0, 1e15]]),
        scales=torch.tensor([[0.0, 0, 0], [1e-18, 1e4, 1e-18], [1e5, 1e5, 1e5]]),
        opacities=torch.tensor([1.0, 0.0, 0.99]),
    )
    leaves = {name: value.clone().requires_grad_() for name, value in given.items()}
    r = rasterization(**leaves, width=21, height=17, kernels=kernels)
    (r.colour.sum() + r.depth.sum() + r.alpha.sum()).backward()
    assert all(torch.isfinite(t).all() for t in (r.colour, r.alpha, r.depth, r.median_depth, r.radii))
    for name, leaf in leaves.items():
        assert torch.isfinite(leaf.grad).all(), name

    flat = {
        "centres": torch.tensor([[10.5, 8.5]]), "covariances": torch.tensor([[4.0, 0, 4.0]]),
        "opacities": torch.ones(1), "colours": torch.ones(1, 3), "rings": torch.tensor([[0.0, 1.0]]),
        "arcs": torch.zeros(1, 2),
    }  # fmt: skip
    for blend in ("over", "add"):
        leaves = {name: value.clone().requires_grad_() for name, value in flat.items()}
        laid = splat(**leaves, width=21, height=17, blend=blend, kernels=kernels)
        (laid.colour.sum() + laid.transmittance.sum()).backward()
        for name, leaf in leaves.items():
            assert torch.isfinite(leaf.grad).all() and leaf.grad.abs().max() < 1e4, (name, blend)


@pytest.mark.parametrize("kernels", SETS)
def test_sh_degree_and_dilation_take_effect(kernels: str) -> None:
    given = scene(1, sh=torch.cat([scene(1)["sh"], torch.ones(1, 3, 3)], 1))
    flat = rasterization(**given, width=20, height=16, sh_degree=0, kernels=kernels).colour
    full = rasterization(**given, width=20, height=16, kernels=kernels).colour
    assert not torch.allclose(flat, full)
    given["sh"] = given["sh"][:, :1]
    assert torch.allclose(rasterization(**given, width=20, height=16, kernels=kernels).colour, flat)
    wide = rasterization(**given, width=20, height=16, dilation=9.0, kernels=kernels)
    assert wide.radii.item() == pytest.approx(3 * math.sqrt(4 + 9), abs=1e-4)


@pytest.mark.parametrize("kernels", SETS)
def test_depth_can_be_omitted(kernels: str) -> None:
    """Compares pictures and gradients."""
    found = []
    for depth in (True, False):
        means = scene()["means"].requires_grad_()
        r = rasterization(**{**scene(), "means": means}, width=20, height=16, depth=depth, kernels=kernels)
        r.colour.square().sum().backward()
        assert r.depth.shape == r.median_depth.shape == ((16, 20) if depth else (0, 0))
        found.append((r.colour, r.alpha, means.grad))
    for full, fast in zip(*found, strict=True):
        assert torch.allclose(full, fast, rtol=1e-5, atol=1e-6)


def test_invalid_shapes_and_values_raise() -> None:
    good = scene() | {"width": 5, "height": 5}
    for name, value, message in (
        ("means", torch.zeros(3, 2), r"means has the shape \(3, 2\)"),
        ("quats", torch.zeros(2, 4), "quats"),
        ("scales", torch.zeros(3), "scales"),
        ("opacities", torch.zeros(3, 1), "opacities"),
        ("sh", torch.zeros(3, 5, 3), "1, 4, 9 or 16"),
        ("sh", torch.zeros(3, 3), "sh"),
        ("intrinsics", torch.zeros(4, 4), "intrinsics"),
        ("world_to_camera", torch.zeros(3, 4), "world_to_camera"),
        ("background", torch.zeros(1, 3), "background"),
        ("sh_degree", 1, "sh_degree is 1"),
        ("width", 0, "0 x 5"),
        ("kernels", "gpu", "not 'gpu'"),
    ):
        with pytest.raises(SettingsError, match=message):
            rasterization(**{**good, name: value})
    flat = (torch.zeros(2, 2), torch.ones(2, 3), torch.ones(2), torch.ones(2, 3), 5, 5)
    for changes, message in (
        ({"blend": "under"}, "over or add"),
        ({"resolution": "half"}, "full or mixed"),
        ({"rings": torch.ones(2, 3)}, "rings"),
        ({"arcs": torch.ones(2, 3)}, "arcs"),
    ):
        with pytest.raises(SettingsError, match=message):
            splat(*flat, **changes)


def test_auto_selects_the_fastest_available_kernels(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    single, double = torch.zeros(1), torch.zeros(1, dtype=torch.float64)
    tiles = registry.select_kernels("tiles", single)
    if registry.is_available("cpu"):
        assert registry.select_kernels("auto", single) is registry.select_kernels("cpu", single)
    assert registry.select_kernels("auto", double) is tiles  # the CPU kernels would lose half of the digits

    load = registry._load_kernel_set
    monkeypatch.setattr(
        registry, "_load_kernel_set", lambda name: ImportError("no numba") if name == "cpu" else load(name)
    )
    registry._warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert registry.select_kernels("auto", single) is tiles
        assert registry.select_kernels("auto", single) is tiles
    assert [record.message for record in caplog.records] == [
        "The cpu kernels cannot be used here (no numba); slower torch ones take their place."
    ]
    with pytest.raises(EngineError, match="no numba"):
        registry.select_kernels("cpu", single)
    assert registry.fused_kernels(single) is None


def test_rendering_works_without_numba() -> None:
    """A Python that cannot import numba renders, and trains, by torch."""
    code = (
        "import sys; sys.modules['numba'] = None\n"
        "import torch\n"
        "from core.gaussians import rasterization, splat, l1_ssim, kernels\n"
        "assert not kernels.is_available('cpu')\n"
        "x = torch.ones(1, 2, requires_grad=True)\n"
        "s = splat(x * 4, torch.tensor([[4., 0, 4.]]), torch.ones(1), torch.ones(1, 3), 9, 9)\n"
        "l1_ssim(s.colour, torch.zeros(9, 9, 3), 0.8).backward()\n"
        "assert x.grad.isfinite().all() and s.colour.max() > 0.9\n"
        "print('done')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "done", done.stderr
    assert "slower torch ones" in done.stderr


def test_cuda_kernels_raise_without_a_gpu() -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a GPU here")
    with pytest.raises(EngineError, match="cuda kernels cannot be used here"):
        registry.select_kernels("cuda", torch.zeros(1))


def test_centre_gradients_equal_the_gradient_by_a_shift() -> None:
    """The statistic of densification equals the gradient by a shift of the picture."""
    given = scene(2)
    weight = torch.linspace(0, 1, 20).expand(16, 20)
    found = []
    for kernels in SETS:
        means = given["means"].clone().requires_grad_()
        r = rasterization(**{**given, "means": means}, width=20, height=16, kernels=kernels)
        assert not r.centre_gradients.any()
        (r.colour * weight[..., None]).sum().backward(retain_graph=True)
        found.append(r.centre_gradients.clone())
        (r.colour * weight[..., None]).sum().backward()
        assert torch.allclose(r.centre_gradients, 2 * found[-1]), "backward adds"
    for gradients in found:
        assert torch.allclose(gradients, found[0], rtol=1e-3, atol=1e-4)
        assert (gradients[:, 0] > 1e-3).all() and gradients[:, 1].abs().max() < 1e-3
