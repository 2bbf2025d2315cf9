# SPDX-License-Identifier: GPL-3.0-or-later
"""Splatting at mixed resolution: Gaussians that are large relative to the pixel are drawn reduced and upsampled.

Bilinear interpolation on a grid of f px has an error of at most f²/8 times the sum of the picture's second
derivatives along the axes, and at a cusp of slope m an error of at most m f / sqrt(2). With s the smaller standard
deviation, px, and relative to the peak:

    Gaussian    |d²G| <= 1/s² along each axis
    ring        1/(w s)² likewise; at its centre a cusp of slope r0 / (w² s) exp(-r0² / (2 w²))
    arc         as for the ring, with exp(-(r0 + w² beta)² / (2 w²)) for the height of the cusp. For G = exp f, b·d adds
                nothing to f's second derivatives. Whitened, -f = w² |grad f|² / 2 + beta r0 (1 - c) is no less than
                for the ring and bounds the gradient's contribution to the second derivatives of G

A Gaussian is drawn at the largest reduction f of 4, 2, 1 whose error is at most TOLERANCE of the peak: a plain one at
1/4 size from s = 11.3 px, at 1/2 from 5.7 px. The step at which a profile is cut off (1/255 or 1/4096) adds to the
error. Flares consist of many faint Gaussians, few of which are close to the limit.

With "over" the order changes as well: full size in front, then 1/2, then 1/4.
"""
from __future__ import annotations

import torch
from torch import Tensor

from ..choices import Blend
from .kernels import KernelSet
from .layers import over, upsample_layer
from .rendering import Splats, arc_strengths

TOLERANCE = 1 / 32
"""Largest error of a Gaussian that is drawn at reduced size, relative to its peak."""
REDUCTIONS = (1, 2, 4)


@torch.no_grad()
def error_bounds(covariances: Tensor, rings: Tensor | None, arcs: Tensor | None) -> Tensor:
    """Return (3, n), for each of REDUCTIONS, bounds of the error by bilinear upsampling of each Gaussian, relative to
    its peak.

    A bound is f²/8 times the curvature plus f / sqrt(2) times the slope at a ring's cusp; see the module head. rings:
    (n, 2), arcs: (n, 3), or None."""
    xx, xy, yy = covariances.unbind(-1)
    major = (xx + yy) / 2 + (((xx - yy) / 2) ** 2 + xy * xy).sqrt()
    minor = ((xx * yy - xy * xy) / major).clamp(min=1e-12)  # as determinant / major, which does not cancel
    curvature = 2 / minor
    slope = torch.zeros_like(minor)
    if rings is not None:
        r0, w = rings.unbind(-1)
        curvature = curvature / (w * w).clamp(max=1)  # for a wide ring, w > 1, not below that of a plain Gaussian
        peak_radius = r0 if arcs is None else r0 + w * w * arc_strengths(covariances, arcs).to(r0.dtype)
        slope = r0.abs() / (w * w) * torch.exp(-((peak_radius / w) ** 2) / 2) * minor.rsqrt()
    return torch.stack([factor**2 / 8 * curvature + factor / 2**0.5 * slope for factor in REDUCTIONS])


@torch.no_grad()
def choose_reductions(covariances: Tensor, rings: Tensor | None, arcs: Tensor | None) -> Tensor:
    """Return (n,) the factor by which each Gaussian's picture is reduced: 1, 2 or 4."""
    bounds = error_bounds(covariances, rings, arcs)
    chosen = torch.ones(len(covariances), dtype=torch.int64, device=covariances.device)
    for bound, factor in zip(bounds[1:], REDUCTIONS[1:], strict=True):
        chosen.masked_fill_(bound <= TOLERANCE, factor)
    return chosen


def splat_mixed(
    kernels: KernelSet, centres: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor,
    width: int, height: int, *, rings: Tensor | None, arcs: Tensor | None, blend: Blend,
) -> Splats:  # fmt: skip
    """Rasterize as `splat` of the package does with resolution "mixed"; arguments and result are explained there.

    Gaussians of each reduction are drawn by `kernels` as one layer, upsampled, and merged, full size in front."""
    factors = choose_reductions(covariances, rings, arcs)
    picture = None
    for factor in REDUCTIONS:  # front to back
        index = torch.nonzero(factors == factor)[:, 0]
        if len(index) == 0:
            continue
        border = 0 if factor == 1 else 1  # so that interpolation has neighbours on all sides
        # In reduced pixels lengths are divided by the factor, so b, px^-1, is multiplied by it; m has no unit.
        layer = kernels.splat(
            _select_rows(centres, index) / factor + border, _select_rows(covariances, index) / factor**2,
            _select_rows(opacities, index), _select_rows(colours, index),
            -(-width // factor) + 2 * border, -(-height // factor) + 2 * border,
            rings=None if rings is None else _select_rows(rings, index),
            arcs=None if arcs is None else _select_rows(arcs, index) * arcs.new_tensor([factor, factor, 1]),
            blend=blend,
        )  # fmt: skip
        if factor > 1:
            layer = upsample_layer(layer, factor, width, height)
        picture = layer if picture is None else _merge_layers(picture, layer, blend)
    if picture is None:  # there are no Gaussians
        return kernels.splat(
            centres, covariances, opacities, colours, width, height, rings=rings, arcs=arcs, blend=blend
        )
    return picture


def _select_rows(tensor: Tensor, index: Tensor) -> Tensor:
    """Return tensor[index] for ascending indices; the tensor itself if they are all of its rows."""
    return tensor if len(index) == len(tensor) else tensor[index]


def _merge_layers(front: Splats, back: Splats, blend: Blend) -> Splats:
    """Merge two layers into one: their sum with "add", the front one over the back one with "over"."""
    if blend == "add":
        return Splats(front.colour + back.colour, front.transmittance)
    return Splats(over(front, back.colour), front.transmittance * back.transmittance)
