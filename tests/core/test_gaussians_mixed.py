# SPDX-License-Identifier: GPL-3.0-or-later
"""Splatting at mixed resolution: errors against full resolution, upsampling and compositing."""
from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from core.gaussians import Splats, layers, mixed, over, splat
from core.gaussians.rendering import PROFILE_MIN, arc_strengths

SIZE = (150, 110)


def ellipses(n: int, smallest: float, largest: float, seed: int) -> tuple[Tensor, Tensor]:
    """Return random centres (n, 2) in the middle of the picture, and covariances (n, 3), xx, xy, yy.

    smallest, largest: of the standard deviations, pixels.
    """
    generator = torch.Generator().manual_seed(seed)
    sigma = smallest * (largest / smallest) ** torch.rand(n, 2, generator=generator)
    theta = math.pi * torch.rand(n, generator=generator)
    c, s = theta.cos(), theta.sin()
    a, b = sigma.square().unbind(1)
    covariances = torch.stack([c * c * a + s * s * b, c * s * (a - b), s * s * a + c * c * b], 1)
    return torch.tensor(SIZE) * (0.2 + 0.6 * torch.rand(n, 2, generator=generator)), covariances


@pytest.mark.parametrize("what", ["plain", "rings", "arcs"])
def test_each_reduced_gaussian_is_within_its_error_bound(what: str) -> None:
    n = 60
    centres, covariances = ellipses(n, 4, 40, 1)
    generator = torch.Generator().manual_seed(2)
    rings = arcs = None
    if what != "plain":
        rings = torch.stack([3 * torch.rand(n, generator=generator), 0.2 + torch.rand(n, generator=generator)], 1)
    if what == "arcs":
        slopes = torch.randn(n, 2, generator=generator)
        arcs = slopes * (3 * torch.rand(n, generator=generator) / arc_strengths(covariances, slopes)).float()[:, None]
    factors = mixed.choose_reductions(covariances, rings, arcs)
    assert (factors == 1).any() and (factors == 2).any() and (factors == 4).any()
    largest = 0.0
    for i in range(n):
        one = slice(i, i + 1)
        arguments = {
            "rings": None if rings is None else rings[one], "arcs": None if arcs is None else arcs[one],
            "blend": "add", "kernels": "torch",
        }  # fmt: skip
        inputs = (centres[one], covariances[one], torch.ones(1), torch.ones(1, 3), *SIZE)
        error = splat(*inputs, **arguments, resolution="mixed").colour - splat(*inputs, **arguments).colour
        factor = int(factors[i])
        bounds = mixed.error_bounds(covariances[one], arguments["rings"], arguments["arcs"])
        bound = bounds[mixed.REDUCTIONS.index(factor)]
        assert error.abs().max() <= (bound if factor > 1 else 0) + PROFILE_MIN
        assert factor == 1 or bound <= mixed.TOLERANCE
        largest = max(largest, error.abs().max().item())
    assert largest > mixed.TOLERANCE / 4, "the bound says nothing if errors are far below it"


@pytest.mark.parametrize(("blend", "limit"), [("over", 6e-3), ("add", 1e-3)])
def test_a_flare_at_mixed_resolution_is_close_to_the_full_one(blend: str, limit: float) -> None:
    """Faint Gaussians end in a step of 1/255 when blended, large against their peak: so "over" is off by more."""
    n = 300
    centres, covariances = ellipses(n, 2, 60, 3)
    generator = torch.Generator().manual_seed(4)
    opacities = 0.01 + 0.02 * torch.rand(n, generator=generator)
    colours = torch.rand(n, 3, generator=generator)
    full = splat(centres, covariances, opacities, colours, *SIZE, blend=blend, kernels="tiles")
    fast = splat(centres, covariances, opacities, colours, *SIZE, blend=blend, kernels="tiles", resolution="mixed")
    assert full.colour.mean() > 0.1
    assert (fast.colour - full.colour).square().mean().sqrt() < limit
    assert (fast.transmittance - full.transmittance).square().mean().sqrt() < limit


def test_gradients_at_mixed_resolution_are_close_to_the_full_ones() -> None:
    centres, covariances = ellipses(20, 8, 40, 5)
    found = []
    for resolution in ("full", "mixed"):
        inputs = [t.clone().requires_grad_() for t in (centres, covariances, torch.full((20,), 0.2), torch.ones(20, 3))]
        laid = splat(*inputs, *SIZE, blend="add", kernels="tiles", resolution=resolution)
        pattern = torch.linspace(0, 3, SIZE[0]).sin()[None, :, None] + torch.linspace(0, 2, SIZE[1])[:, None, None]
        (laid.colour * pattern).sum().backward()
        found.append([t.grad for t in inputs])
    for full, fast in zip(*found, strict=True):
        assert torch.linalg.vector_norm(fast - full) < 0.02 * torch.linalg.vector_norm(full)


def test_upsampled_gaussians_have_no_artefacts_at_the_border() -> None:
    """A ramp that runs off the frame: without neighbours outside, the outermost pixels would be level."""
    inputs = (torch.tensor([[-20.0, 10.0]]), torch.tensor([[900.0, 0, 900.0]]), torch.ones(1), torch.ones(1, 3))
    full = splat(*inputs, 50, 30, blend="add", kernels="torch").colour
    fast = splat(*inputs, 50, 30, blend="add", kernels="torch", resolution="mixed").colour
    assert (fast - full).abs().max() < 0.005


@pytest.mark.parametrize("factor", [2, 4])
def test_upsampling_equals_torch_interpolation(factor: int) -> None:
    generator = torch.Generator().manual_seed(0)
    small = torch.rand(7, 5, 4, dtype=torch.float64, generator=generator, requires_grad=True)
    planes = small.permute(2, 0, 1)[None]
    expected = torch.nn.functional.interpolate(planes, scale_factor=factor, mode="bilinear")[0].permute(1, 2, 0)
    assert torch.allclose(layers.upsample(small, factor), expected[factor:-factor, factor:-factor])
    assert torch.autograd.gradcheck(lambda s: layers.upsample(s, factor), small)


@pytest.mark.parametrize("factor", [2, 4])
@pytest.mark.parametrize("size", [(150, 111), (64, 32), (17, 1), (5, 3)])
def test_fused_layers_equal_the_torch_layers(factor: int, size: tuple[int, int]) -> None:
    """The fused kernels, pictures that no vector and no small pixel divides, and those too small for them."""
    width, height = size
    small = (-(-height // factor) + 2, -(-width // factor) + 2)
    generator = torch.Generator().manual_seed(0)
    values = [torch.rand(*shape, generator=generator) for shape in ((*small, 3), small, (height, width, 3))]
    pattern = torch.rand(height, width, 3, generator=generator)
    found = []
    for dtype in (torch.float64, torch.float32):
        colour, t, behind = inputs = [v.to(dtype, copy=True).requires_grad_() for v in values]
        layer = layers.upsample_layer(Splats(colour, t), factor, width, height)
        picture = over(layer, behind)
        (picture * pattern).sum().backward()
        found.append([picture.detach(), layer.transmittance.detach(), *(v.grad for v in inputs)])
    for exact, fast in zip(*found, strict=True):
        assert torch.allclose(fast.double(), exact, atol=1e-5)


def test_upsampling_needs_no_gradient_by_the_transmittance() -> None:
    colour, t = torch.rand(20, 30, 3, requires_grad=True), torch.rand(20, 30, requires_grad=True)
    layers.upsample_layer(Splats(colour, t), 2, 50, 33).colour.sum().backward()
    assert colour.grad is not None and colour.grad.sum() == pytest.approx(3 * 50 * 33, rel=1e-5)
    assert t.grad is None or not t.grad.any()


def test_no_gaussians_at_mixed_resolution_render_an_empty_picture() -> None:
    inputs = (torch.zeros(0, 2), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 3))
    laid = splat(*inputs, 5, 3, resolution="mixed")
    assert laid.colour.shape == (3, 5, 3) and not laid.colour.any() and (laid.transmittance == 1).all()
