# SPDX-License-Identifier: GPL-3.0-or-later
"""The definition of the picture, in plain torch: evaluates every Gaussian at every pixel, differentiated by autograd.

Any device, float32 or float64; slow. Tests compare all other kernel sets with this one.

At a pixel centre (x + 1/2, y + 1/2), with d its offset from a Gaussian's centre:

    q = d^T covariance^-1 d                                       squared Mahalanobis distance
    G = exp(-q / 2)                                               the plain profile, or
    G = exp(-(sqrt(q) - r0)² / (2 w²))                            a ring (ours: r0 = 0, w = 1 is plain)
    G = G * exp(b·d - m)                                          an arc of either: brighter towards b, px^-1, where
    m = beta r0 + beta² w² / 2,  beta² = b^T covariance b         sets its peak to 1 (see `rendering.normalise_arcs`)

    over:  alpha_i = min(opacity_i, 0.99) G_i, or 0 if that is below 1/255
           T_i = prod_{j before i} (1 - alpha_j)
           picture = sum_i colour_i alpha_i T_i  over all i with T_i >= 1e-4, front to back
    add:   picture = sum_i colour_i opacity_i G_i  over all i with G_i >= 1/4096
"""
from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ..choices import Blend
from .projection import camera_position, determinants, project, visible_radii
from .rendering import (
    ALPHA_MIN,
    OPACITY_MAX,
    PROFILE_MIN,
    TRANSMITTANCE_MIN,
    Rendering,
    Splats,
    activate,
    cutoff_radii,
    record_gradient,
)
from .spherical_harmonics import colours as colours_of

RADIUS_MIN = 1e-6
"""Smallest Mahalanobis distance of rings; below it the gradient has no direction."""
CHUNK = 1 << 18
"""Pairs of Gaussian and pixel that are evaluated at a time; bounds the memory, and fits the cache."""


def pixel_centres(width: int, height: int, like: Tensor) -> Tensor:
    """Return (height * width, 2) coordinates x, y of the pixel centres, row by row."""
    x, y = (torch.arange(size, dtype=like.dtype, device=like.device) + 0.5 for size in (width, height))
    return torch.cartesian_prod(y, x).flip(-1)


def profiles(
    pixels: Tensor, centres: Tensor, covariances: Tensor, rings: Tensor | None, arcs: Tensor | None
) -> Tensor:
    """Return the profiles G of n Gaussians at p pixels: (n, p), 0..1; the head of this module has the equations.

    pixels: (p, 2) x, y. centres: (n, 2), px. covariances: (n, 3) xx, xy, yy, px². rings: (n, 2) r0 and w, or None.
    arcs: (n, 3) b and m, or None.
    """
    dx, dy = (pixels[None] - centres[:, None]).unbind(-1)
    xx, xy, yy = covariances[:, :, None].unbind(1)
    q = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / determinants(covariances)[:, None]
    if rings is None:
        log_g = -q / 2
    else:
        r0, w = rings[:, :, None].unbind(1)
        log_g = -((q.clamp(min=RADIUS_MIN**2).sqrt() - r0) ** 2) / (2 * w * w)
    if arcs is not None:
        b_x, b_y, m = arcs[:, :, None].unbind(1)
        log_g = log_g + (b_x * dx + b_y * dy - m)
    return log_g.exp()


def alphas_over(g: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Return alphas and the transmittances in front of them, both (n, p), from profiles g (n, p), front to back."""
    alpha = opacities.clamp(max=OPACITY_MAX)[:, None] * g
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
    return alpha, torch.cat([torch.ones_like(alpha[:1]), torch.cumprod(1 - alpha, 0)[:-1]])


def weights_over(g: Tensor, opacities: Tensor) -> Tensor:
    """Return weights (n, p) of n Gaussians in the colours of p pixels, for the blend "over"; g: profiles (n, p)."""
    alpha, transmittance = alphas_over(g, opacities)
    return torch.where(transmittance >= TRANSMITTANCE_MIN, alpha * transmittance, 0)


def weights_add(g: Tensor, opacities: Tensor) -> Tensor:
    """Return weights (n, p) of n Gaussians in the colours of p pixels, for the blend "add"; g: profiles (n, p)."""
    return opacities[:, None] * torch.where(g >= PROFILE_MIN, g, 0)


def _map_chunks(pixels: Tensor, count: int, shade: Callable[[Tensor], Tensor]) -> Tensor:
    """Return shade(pixels), computed in chunks of pixels to bound the memory.

    In the backward pass the intermediates of a chunk are computed again (checkpointing). count: number of Gaussians;
    the more there are, the smaller the chunks."""
    parts = pixels.split(max(1, CHUNK // max(count, 1)))
    if len(parts) == 1 or not torch.is_grad_enabled():
        return torch.cat([shade(part) for part in parts])
    return torch.cat([checkpoint(shade, part, use_reentrant=False) for part in parts])


def rasterize_scene(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
    world_to_camera: Tensor, intrinsics: Tensor, width: int, height: int,
    *, background: Tensor | None, sh_degree: int, near: float, dilation: float, depth: bool, raw: bool,
) -> Rendering:  # fmt: skip
    """Render as `rasterization` of the package does, which explains arguments and results."""
    scales, opacities = activate(scales, opacities, raw)
    projected = project(means, quats, scales, world_to_camera, intrinsics, width, height, near, dilation)
    order = torch.argsort(projected.depths, stable=True)
    index, centres, covariances, depths = (part[order] for part in projected)
    colours = colours_of((means - camera_position(world_to_camera))[index], sh[index], sh_degree)
    values = torch.cat([colours, depths[:, None]], -1)
    opacities = opacities[index]

    gradients = record_gradient(centres, index, len(means))

    def shade(pixels: Tensor) -> Tensor:
        """Return red, green, blue, depth and alpha (p, 5) at p pixels."""
        weights = weights_over(profiles(pixels, centres, covariances, None, None), opacities)
        return torch.cat([weights.T @ values, weights.sum(0)[:, None]], -1)

    def median(pixels: Tensor) -> Tensor:
        """Return (p,) median depths at p pixels."""
        alpha, transmittance = alphas_over(profiles(pixels, centres, covariances, None, None), opacities)
        # Number of Gaussians behind which at least half the light is left; the next one is the median, or the appended
        # 0.
        num_in_front = (transmittance * (1 - alpha) >= 0.5).sum(0)
        return torch.cat([depths, depths.new_zeros(1)])[num_in_front]

    pixels = pixel_centres(width, height, means)
    with torch.no_grad():
        median_depth = (
            _map_chunks(pixels, len(index), median).reshape(height, width) if depth else means.new_empty(0, 0)
        )
        all_centres = torch.zeros_like(means[:, :2]).index_copy_(0, index, centres)
        reach = cutoff_radii(opacities.clamp(max=OPACITY_MAX))
        radii = torch.zeros_like(means[:, 0]).index_copy_(
            0, index, visible_radii(centres, covariances, reach, width, height)
        )
    picture = _map_chunks(pixels, len(index), shade).reshape(height, width, 5)
    alpha = picture[..., 4]
    colour = picture[..., :3]
    if background is not None:
        colour = colour + (1 - alpha)[..., None] * background
    mean_depth = picture[..., 3] / alpha.clamp(min=ALPHA_MIN / 2) if depth else median_depth
    return Rendering(colour, alpha, mean_depth, median_depth, all_centres, radii, gradients)


def splat(
    centres: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor, width: int, height: int,
    *, rings: Tensor | None, arcs: Tensor | None, blend: Blend,
) -> Splats:  # fmt: skip
    """Rasterize as `splat` of the package does at full resolution; it explains arguments and result."""
    index = torch.nonzero(determinants(covariances) > 0)[:, 0]  # a degenerate ellipse covers nothing
    centres, covariances, opacities, colours = (
        part[index] for part in (centres, covariances, opacities, colours)
    )
    rings, arcs = (None if part is None else part[index] for part in (rings, arcs))
    weigh = weights_over if blend == "over" else weights_add

    def shade(pixels: Tensor) -> Tensor:
        """Return red, green, blue and alpha (p, 4) at p pixels."""
        weights = weigh(profiles(pixels, centres, covariances, rings, arcs), opacities)
        return torch.cat([weights.T @ colours, weights.sum(0)[:, None]], -1)

    picture = _map_chunks(pixel_centres(width, height, centres), len(index), shade).reshape(height, width, 4)
    colour, alpha = picture[..., :3], picture[..., 3]
    return Splats(colour, 1 - alpha if blend == "over" else torch.ones_like(alpha))
