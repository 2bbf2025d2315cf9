# SPDX-License-Identifier: GPL-3.0-or-later
"""The public functions: `rasterization` of 3D Gaussians seen by a camera, and `splat` of 2D Gaussians on a picture.

Both check their arguments and pass them to a kernel set (`kernels.py`).
"""
from __future__ import annotations

from typing import Literal

from torch import Tensor

from ..choices import Blend, Kernels
from ..conventions.pixel_grid import DILATION
from ..errors import SettingsError
from .kernels import select_kernels
from .mixed import splat_mixed
from .rendering import NEAR, Rendering, Splats, normalise_arcs
from .spherical_harmonics import degree_of

Resolution = Literal["full", "mixed"]


def rasterization(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
    world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int,
    *, background: Tensor | None = None, sh_degree: int | None = None,
    kernels: Kernels = "auto", near: float = NEAR, dilation: float = DILATION, depth: bool = True,
    raw: bool = False,
) -> Rendering:  # fmt: skip
    """Render n 3D Gaussians (Kerbl et al. 2023), nearest first; `reference.py` has the definition.

    means            (n, 3) world coordinates
    quats            (n, 4) rotations w, x, y, z of any length
    scales           (n, 3) standard deviations along the axes, world units, > 0
    opacities        (n,)   0..1
    sh               (n, k, 3) spherical harmonics, k = 1, 4, 9 or 16
    world_to_camera  (4, 4) x right, y down, z forward
    intrinsics       (3, 3) focal lengths and principal point, px; no skew
    background       (3,)   shows where the Gaussians leave transmittance; black by default
    sh_degree        degree of the harmonics that are used, 0 to 3; all of sh by default
    kernels          "torch", "tiles", "cpu" or "cuda"; "auto" takes the fastest that is installed
    near             camera depth up to which Gaussians are culled, world units
    dilation         px², added to both diagonal elements of the projected covariances
    depth            False leaves depth and median_depth empty, (0, 0), which saves time
    raw              True: scales are given as logarithms and opacities as logits, as they are optimised, which
                     saves passes over them

    Differentiable by every tensor. Raises SettingsError for shapes and values that do not fit,
    EngineError for kernels that are not installed.
    """
    n = _check_rows(means, 3, "means")
    _check_shape(quats, (n, 4), "quats")
    _check_shape(scales, (n, 3), "scales")
    _check_shape(opacities, (n,), "opacities")
    _check_shape(sh, (n, sh.shape[1] if sh.ndim == 3 else 1, 3), "sh")
    _check_shape(world_to_camera, (4, 4), "world_to_camera")
    _check_shape(intrinsics, (3, 3), "intrinsics")
    if background is not None:
        _check_shape(background, (3,), "background")
    _check_size(width, height)
    degree = degree_of(sh.shape[1])
    if sh_degree is not None:
        if not 0 <= sh_degree <= degree:
            raise SettingsError(f"sh_degree is {sh_degree}, but sh holds degrees 0 to {degree}.")
        degree = sh_degree
    return select_kernels(kernels, means).rasterize_scene(
        means, quats, scales, opacities, sh, world_to_camera, intrinsics, width, height,
        background=background, sh_degree=degree, near=near, dilation=dilation, depth=depth, raw=raw,
    )  # fmt: skip


def splat(
    centres: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor, width: int, height: int,
    *, rings: Tensor | None = None, arcs: Tensor | None = None,
    blend: Blend = "over", resolution: Resolution = "full", kernels: Kernels = "auto",
) -> Splats:  # fmt: skip
    """Rasterize n 2D Gaussians, such as those of a flare; `reference.py` has the definition.

    centres      (n, 2) px, pixel centres at + 1/2
    covariances  (n, 3) xx, xy, yy, px²; taken as they are, without dilation; those that are not positive
                 definite cover nothing
    opacities    (n,)   0..1 ("add": any gain >= 0)
    colours      (n, 3)
    rings        (n, 2) r0 and w > 0, Mahalanobis distance: the profile is a ring, not a disc
    arcs         (n, 2) b, px^-1: the profile is times exp(b·d) and one at its peak, so that one side is brighter
    blend        "over": front to back in the order given; "add": a sum, for scene-linear light
    resolution   "mixed": Gaussians much larger than a pixel are drawn at 1/4 or 1/2 size and enlarged
                 (behind the small ones, if "over"); see `mixed.py` for the error
    kernels      "torch", "tiles", "cpu" or "cuda"; "auto" takes the fastest that is installed

    Differentiable by every tensor. Raises SettingsError for shapes and values that do not fit,
    EngineError for kernels that are not installed.
    """
    n = _check_rows(centres, 2, "centres")
    _check_shape(covariances, (n, 3), "covariances")
    _check_shape(opacities, (n,), "opacities")
    _check_shape(colours, (n, 3), "colours")
    if rings is not None:
        _check_shape(rings, (n, 2), "rings")
    if arcs is not None:
        _check_shape(arcs, (n, 2), "arcs")
    _check_size(width, height)
    if blend not in ("over", "add"):
        raise SettingsError(f"Flares are not laid on a picture by the blend {blend!r}; choose over or add.")
    if resolution not in ("full", "mixed"):
        raise SettingsError(f"Flares are not laid on a picture at the resolution {resolution!r}; choose full or mixed.")
    if arcs is not None:
        arcs = normalise_arcs(arcs, covariances, rings)
    chosen = select_kernels(kernels, centres)
    if resolution == "mixed":
        return splat_mixed(
            chosen, centres, covariances, opacities, colours, width, height,
            rings=rings, arcs=arcs, blend=blend,
        )  # fmt: skip
    return chosen.splat(
        centres, covariances, opacities, colours, width, height, rings=rings, arcs=arcs, blend=blend
    )


def _check_rows(tensor: Tensor, width: int, name: str) -> int:
    """Return n of a tensor that must be (n, width). Raises SettingsError for another shape."""
    if tensor.ndim != 2 or tensor.shape[1] != width:
        raise SettingsError(f"{name} has the shape {tuple(tensor.shape)}, but must be (n, {width}).")
    return tensor.shape[0]


def _check_shape(tensor: Tensor, shape: tuple[int, ...], name: str) -> None:
    if tensor.shape != shape:
        raise SettingsError(f"{name} has the shape {tuple(tensor.shape)}, but must be {shape}.")


def _check_size(width: int, height: int) -> None:
    if width < 1 or height < 1:
        raise SettingsError(f"A picture of {width} x {height} pixels cannot be rendered.")
