# SPDX-License-Identifier: GPL-3.0-or-later
"""Random Gaussians for comparing kernel sets with the definition, and the comparison.

The definition has discontinuities (steps): a contribution counts from alpha = 1/255 on, a pixel is finished at a
transmittance of 1e-4, nearer Gaussians hide farther ones. Two correct implementations may fall on different sides of a
step if a value is within rounding of it. So cases are sampled such that in float64 no value is within STEP_MARGIN
(relative) of a step: Gaussians with such values get another opacity or position.
"""
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from core.conventions.pixel_grid import DILATION
from core.gaussians import rasterization, splat
from core.gaussians import reference as r
from core.gaussians.projection import camera_position, frustum_limits, project
from core.gaussians.rendering import ALPHA_MIN, NEAR, PROFILE_MIN, TRANSMITTANCE_MIN, normalise_arcs
from core.gaussians.spherical_harmonics import basis

STEP_MARGIN = 1e-4
FORWARD_TOLERANCE = 1e-5
GRADIENT_TOLERANCE = 1e-3


@dataclass
class Case:
    """A test case: inputs by name (float32), and further arguments."""

    name: str
    inputs: dict[str, Tensor]
    options: dict[str, object] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        return self.options["width"], self.options["height"]  # type: ignore[return-value]


SCENES = (
    "plain", "needles", "huge", "tiny", "behind", "off-frame", "transparent", "opaque", "degenerate",
    "one pixel", "odd", "layers", "turned",
)  # fmt: skip


def scene_case(seed: int) -> Case:
    """Return a random scene of the kind that is the seed's turn in SCENES.

    No Gaussian is close to a step, where float32 and float64 may decide differently.
    """
    rng = np.random.default_rng(seed)
    kind = SCENES[seed % len(SCENES)]
    n = int(rng.integers(150, 300)) if kind == "layers" else int(rng.integers(1, 40))
    width, height = (int(v) for v in rng.integers(8, 34, 2))
    if kind == "one pixel":
        width = height = 1
    if kind == "odd":
        width, height = (int(v) for v in rng.choice([1, 3, 7, 15, 17, 31, 33], 2))
    focal = width * rng.uniform(0.6, 1.6, 2)
    principal = np.array([width, height]) * rng.uniform(0.3, 0.7, 2)

    z = rng.uniform(0.5, 6, n)
    spread = {"off-frame": 3.0, "one pixel": 0.3}.get(kind, 1.1)
    xy = rng.uniform(-spread, spread, (n, 2)) * z[:, None] * [width, height] / (2 * focal)
    if kind == "behind":
        z = rng.uniform(-3, 3, n)
    pixel = np.abs(z) / focal[0]  # world units of a pixel there
    log_scales = np.log(pixel * 3)[:, None] + rng.normal(0, 0.6, (n, 1)) + rng.normal(0, 0.5, (n, 3))
    opacities = rng.uniform(0.02, 0.98, n)
    quats = rng.normal(size=(n, 4))
    if kind == "needles":
        log_scales = np.log(pixel)[:, None] + rng.permuted(np.tile([-3.0, -2.0, 2.5], (n, 1)), axis=1)
    elif kind == "huge":
        log_scales += 3.0
    elif kind == "tiny":
        log_scales -= 5.0
    elif kind == "transparent":
        opacities = rng.choice([0.0, 1e-6, 0.003, 0.005, 0.01], n)
    elif kind == "opaque":
        opacities = rng.choice([0.985, 0.995, 1.0], n)
        log_scales += 1.0
    elif kind == "degenerate":
        quats *= rng.choice([0.0, 1e-20, 1e-6, 1.0, 1e6], (n, 1))
        quats[0] = 0
        log_scales[rng.random((n, 3)) < 0.3] = -30.0
    elif kind == "layers":
        xy, z = xy * 0.5, np.sort(z)[::-1]
        opacities *= rng.choice([0.1, 1.0])
    means = np.concatenate([xy, z[:, None]], 1)

    world_to_camera = np.eye(4)
    if kind in ("turned", "behind"):
        axis = rng.normal(size=3)
        world_to_camera[:3, :3] = _rotation(axis / np.linalg.norm(axis), rng.uniform(0, 3))
        world_to_camera[:3, 3] = rng.normal(size=3)
        means = (means - world_to_camera[:3, 3]) @ world_to_camera[:3, :3]
    degree = int(rng.integers(0, 4))
    sh = rng.normal(0, 0.25, (n, 16, 3))
    intrinsics = np.array([[focal[0], 0, principal[0]], [0, focal[1], principal[1]], [0, 0, 1]])
    inputs = {
        "means": means, "quats": quats, "scales": np.exp(log_scales), "opacities": opacities, "sh": sh,
        "world_to_camera": world_to_camera, "intrinsics": intrinsics, "background": rng.uniform(0, 1, 3),
    }  # fmt: skip
    case = Case(f"{kind}, seed {seed}", _float32(inputs), {"width": width, "height": height, "sh_degree": degree})
    return _move_off_steps(case, scene_steps, rng)


def splat_case(seed: int) -> Case:
    """Return random 2D Gaussians of the kind that is the seed's turn: plain, rings, arcs, both, faint and large.

    The blend is "over" or "add" in turn. No Gaussian is close to a step, where float32 and float64 may decide
    differently.
    """
    rng = np.random.default_rng(10_000 + seed)
    kind = ("plain", "rings", "arcs", "rings and arcs", "faint and large")[seed % 5]
    blend = ("over", "add")[seed // 5 % 2]
    n = int(rng.integers(1, 40))
    width, height = (int(v) for v in rng.integers(1, 40, 2))
    sigma = np.exp(rng.normal(1.2, 0.7, (n, 2)).clip(-0.5, 3.5)) * (8 if kind == "faint and large" else 1)
    theta = rng.uniform(0, math.pi, n)
    c, s = np.cos(theta), np.sin(theta)
    xx, yy = c * c * sigma[:, 0] ** 2 + s * s * sigma[:, 1] ** 2, s * s * sigma[:, 0] ** 2 + c * c * sigma[:, 1] ** 2
    xy = c * s * (sigma[:, 0] ** 2 - sigma[:, 1] ** 2)
    inputs = {
        "centres": rng.uniform(-0.3, 1.3, (n, 2)) * [width, height],
        "covariances": np.stack([xx, xy, yy], 1),
        "opacities": rng.uniform(0.006, 0.05, n) if kind == "faint and large" else rng.uniform(0, 1, n),
        "colours": rng.uniform(0, 1, (n, 3)),
    }
    if "rings" in kind:
        inputs["rings"] = np.stack([rng.uniform(0, 2, n), rng.uniform(0.15, 1, n)], 1)
    if "arcs" in kind:
        along = rng.normal(0, 1.5, (n, 2)) * rng.choice([0.0, 0.1, 1.0], (n, 1), p=[0.1, 0.2, 0.7]) / sigma
        inputs["arcs"] = np.stack([c * along[:, 0] - s * along[:, 1], s * along[:, 0] + c * along[:, 1]], 1)
    case = Case(
        f"{kind}, {blend}, seed {seed}", _float32(inputs), {"width": width, "height": height, "blend": blend}
    )
    return _move_off_steps(case, splat_steps, rng)


def _float32(inputs: dict[str, np.ndarray]) -> dict[str, Tensor]:
    return {name: torch.tensor(value, dtype=torch.float32) for name, value in inputs.items()}


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _near(value: Tensor, step: float) -> Tensor:
    return (value / step - 1).abs() < STEP_MARGIN


def _in_front(close: Tensor, alpha: Tensor) -> Tensor:
    """Return the pairs (n, p) that contribute to a transmittance close to a step, at the pair or behind it."""
    return (close.flip(0).cumsum(0).flip(0) > 0) & (alpha > 0)


def scene_steps(case: Case) -> tuple[Tensor, Tensor]:
    """Return two masks (n,): Gaussians that contribute close to a step of blending, and Gaussians whose position is
    close to a step of projection, depth order or colour.

    At a step (a threshold, a clip, a tie) results jump, so float32 cannot be compared with float64.
    """
    width, height = case.size
    i = {name: value.double() for name, value in case.inputs.items()}
    n = len(i["means"])
    by_opacity, by_position = torch.zeros(n, dtype=torch.bool), torch.zeros(n, dtype=torch.bool)
    projected = project(
        i["means"], i["quats"], i["scales"], i["world_to_camera"], i["intrinsics"], width, height, NEAR, DILATION
    )
    order = torch.argsort(projected.depths, stable=True)
    index, centres, covariances, depths = (part[order] for part in projected)
    if len(index) == 0:
        return by_opacity, by_position
    g = r.profiles(r.pixel_centres(width, height, i["means"]), centres, covariances, None, None)
    alpha, before = r.alphas_over(g, i["opacities"][index])
    after = before * (1 - alpha)
    close = _near(i["opacities"][index].clamp(max=0.99)[:, None] * g, ALPHA_MIN)
    by_opacity[index] = (close | _in_front(_near(before, TRANSMITTANCE_MIN) | _near(after, 0.5), alpha)).any(1)

    z = (i["means"] @ i["world_to_camera"][:3, :3].T + i["world_to_camera"][:3, 3])[:, 2]
    by_position |= _near(z, NEAR)
    slopes = (centres - i["intrinsics"][:2, 2]) / i["intrinsics"].diagonal()[:2]
    limits = torch.stack(frustum_limits(i["intrinsics"], width, height))
    tied = torch.zeros_like(index, dtype=torch.bool)
    tied[1:] = depths.diff() < STEP_MARGIN * depths[1:] * 0.1
    directions = torch.nn.functional.normalize(i["means"] - camera_position(i["world_to_camera"]), dim=-1)
    colours = (basis(directions, 3)[:, :, None] * i["sh"])[:, : (int(case.options["sh_degree"]) + 1) ** 2].sum(1)
    by_position |= ((colours + 0.5).abs() < STEP_MARGIN).any(1)
    by_position[index] |= tied | ((slopes - limits[:, None]).abs() < STEP_MARGIN).any(-1).any(0)
    return by_opacity, by_position


def splat_steps(case: Case) -> tuple[Tensor, Tensor]:
    """Return two masks (n,) of 2D Gaussians close to a step: of blending over, and of the profile when light is
    added."""
    width, height = case.size
    i = {name: value.double() for name, value in case.inputs.items()}
    pixels = r.pixel_centres(width, height, i["centres"])
    arcs = normalise_arcs(i["arcs"], i["covariances"], i.get("rings")) if "arcs" in i else None
    g = r.profiles(pixels, i["centres"], i["covariances"], i.get("rings"), arcs)
    if case.options["blend"] == "add":
        return torch.zeros(len(g), dtype=torch.bool), _near(g, PROFILE_MIN).any(1)
    alpha, before = r.alphas_over(g, i["opacities"])
    close = _near(i["opacities"].clamp(max=0.99)[:, None] * g, ALPHA_MIN)
    close |= _in_front(_near(before, TRANSMITTANCE_MIN), alpha)
    return close.any(1), torch.zeros(len(g), dtype=torch.bool)


def _move_off_steps(
    case: Case, steps: Callable[[Case], tuple[Tensor, Tensor]], rng: np.random.Generator
) -> Case:
    """Return the case with its Gaussians moved at random until `steps` finds none close to a step.

    Opacities are lowered where blending is close, places shifted where a position is.
    """
    place = "means" if "means" in case.inputs else "centres"
    for _ in range(100):
        by_opacity, by_position = steps(case)
        if not (by_opacity.any() or by_position.any()):
            return case
        inputs = dict(case.inputs)
        moved = by_opacity & torch.tensor(rng.random(len(by_opacity)) < 0.5)
        factor = torch.tensor(rng.uniform(0.97, 1, len(by_opacity)), dtype=torch.float32)
        inputs["opacities"] = torch.where(moved, inputs["opacities"].clamp(max=0.99) * factor, inputs["opacities"])
        shift = torch.tensor(rng.normal(0, 0.01, inputs[place].shape), dtype=torch.float32)
        inputs[place] = torch.where(by_position[:, None], inputs[place] + shift, inputs[place])
        case = replace(case, inputs=inputs)
    raise AssertionError(f"{case.name}: no place off the steps was found")


def render(
    case: Case, kernels: str, dtype: torch.dtype, device: str = "cpu"
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Render a case on a device; return its pictures by name, and the gradients of its inputs by name, on the CPU.

    The gradients are of a sum of all pixels with fixed random weights.
    """
    inputs = {name: value.to(device, dtype, copy=True).requires_grad_() for name, value in case.inputs.items()}
    options = {name: value.to(device) if isinstance(value, Tensor) else value for name, value in case.options.items()}
    arguments = {**inputs, **options, "kernels": kernels}
    if "means" in inputs:
        full = rasterization(**arguments)  # type: ignore[arg-type]
        pictures = {name: getattr(full, name) for name in ("colour", "alpha", "depth")}
        more = {name: getattr(full, name) for name in ("median_depth", "centres", "radii")}
    else:
        laid = splat(**arguments)  # type: ignore[arg-type]
        pictures = {"colour": laid.colour, "transmittance": laid.transmittance}
        more = {}
    generator = torch.Generator().manual_seed(0)
    loss = sum(
        (picture.cpu() * torch.randn(picture.shape, generator=generator, dtype=torch.float64)).sum()
        for picture in pictures.values()
    )
    gradients = {}
    if isinstance(loss, Tensor) and loss.requires_grad:
        loss.backward()
        gradients = {
            name: torch.zeros_like(value) if value.grad is None else value.grad for name, value in inputs.items()
        }
        if more:
            gradients["centre_gradients"] = full.centre_gradients
    results = {name: p.detach().cpu() for name, p in {**pictures, **more}.items()}
    return results, {name: gradient.cpu() for name, gradient in gradients.items()}


def differences(case: Case, kernels: str, device: str = "cpu") -> list[str]:
    """Compare a kernel set in float32 on a device with the definition in float64; return a line for each difference."""
    pictures, gradients = render(case, "torch", torch.float64)
    tried, tried_gradients = render(case, kernels, torch.float32, device)
    wrong = []
    for name, picture in pictures.items():
        error = (tried[name] - picture).abs().max().item() if picture.numel() else 0.0
        scale = max(1.0, picture.abs().max().item() if picture.numel() else 0.0)
        if not error <= FORWARD_TOLERANCE * scale:
            wrong.append(f"{case.name}: {name} is off by {error:.2e} of {scale:.3g}")
    for name, gradient in gradients.items():
        error = torch.linalg.vector_norm(tried_gradients[name] - gradient).item()
        norm = torch.linalg.vector_norm(gradient).item()
        if not error <= GRADIENT_TOLERANCE * norm + FORWARD_TOLERANCE:
            wrong.append(f"{case.name}: the gradient of {name} is off by {error / (norm + 1e-30):.2e} of {norm:.3g}")
    return wrong
