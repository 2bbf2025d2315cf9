# SPDX-License-Identifier: GPL-3.0-or-later
"""Flares at mixed resolution: what is soft against the pixel is drawn small and enlarged.

Bilinear interpolation on a grid of f px misses a picture by at most f²/8 times the sum of its second
derivatives along the axes, and a cusp of slope m by at most m f / sqrt(2). With s the smaller standard
deviation, px, and in shares of the peak:

    Gaussian    |d²G| <= 1/s² along each axis
    ring        1/(w s)² likewise; at its centre a cusp of slope r0 / (w² s) exp(-r0² / (2 w²))
    arc         those of the ring, with exp(-(r0 + w² beta)² / (2 w²)) for the height of the cusp: G = exp f, b·d adds
                nothing to f's second derivatives, and whitened, -f = w² |grad f|² / 2 + beta r0 (1 - c), no less than
                for the ring, holds down what the gradient adds to G's

The largest f of 4, 2, 1 at which that comes to no more than TOLERANCE of the peak is taken: a plain Gaussian
is drawn at 1/4 size from s = 11.3 px, at 1/2 from 5.7 px. To the error comes the step at which a profile is
cut off (1/255 or 1/4096). Flares are made of many faint Gaussians, of which few are close to the limit.

"over" then also changes the order: full size in front, then 1/2, then 1/4.
"""
from __future__ import annotations

import torch
from torch import Tensor

from ..choices import Blend
from .kernels import KernelSet
from .layers import enlarged, over
from .rendering import Splats, arc_strengths

TOLERANCE = 1 / 32
"""Largest error of a Gaussian drawn small, as a share of its peak."""
REDUCTIONS = (1, 2, 4)


@torch.no_grad()
def error_bounds(covariances: Tensor, rings: Tensor | None, arcs: Tensor | None) -> Tensor:
    """(3, n) largest error of each Gaussian at each of REDUCTIONS, as a share of its peak; see above."""
    xx, xy, yy = covariances.unbind(-1)
    larger = (xx + yy) / 2 + (((xx - yy) / 2) ** 2 + xy * xy).sqrt()
    smaller = ((xx * yy - xy * xy) / larger).clamp(min=1e-12)  # without cancellation
    curvature = 2 / smaller
    slope = torch.zeros_like(smaller)
    if rings is not None:
        r0, w = rings.unbind(-1)
        curvature = curvature / (w * w).clamp(max=1)
        brightest = r0 if arcs is None else r0 + w * w * arc_strengths(covariances, arcs).to(r0.dtype)
        slope = r0.abs() / (w * w) * torch.exp(-((brightest / w) ** 2) / 2) * smaller.rsqrt()
    return torch.stack([factor**2 / 8 * curvature + factor / 2**0.5 * slope for factor in REDUCTIONS])


@torch.no_grad()
def reductions(covariances: Tensor, rings: Tensor | None, arcs: Tensor | None) -> Tensor:
    """(n,) 1, 2 or 4: at which share of the size each Gaussian is drawn."""
    bounds = error_bounds(covariances, rings, arcs)
    chosen = torch.ones(len(covariances), dtype=torch.int64, device=covariances.device)
    for place, factor in enumerate(REDUCTIONS[1:], 1):
        chosen.masked_fill_(bounds[place] <= TOLERANCE, factor)
    return chosen


def splat_mixed(
    kernels: KernelSet, centres: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor,
    width: int, height: int, *, rings: Tensor | None, arcs: Tensor | None, blend: Blend,
) -> Splats:  # fmt: skip
    """`splat` with resolution "mixed"."""
    factors = reductions(covariances, rings, arcs)
    picture = None
    for factor in REDUCTIONS:  # front to back
        index = torch.nonzero(factors == factor)[:, 0]
        if len(index) == 0:
            continue
        border = 0 if factor == 1 else 1  # so that interpolation has neighbours on all sides
        layer = kernels.splat(
            _rows(centres, index) / factor + border, _rows(covariances, index) / factor**2,
            _rows(opacities, index), _rows(colours, index),
            -(-width // factor) + 2 * border, -(-height // factor) + 2 * border,
            rings=None if rings is None else _rows(rings, index),
            arcs=None if arcs is None else _rows(arcs, index) * arcs.new_tensor([factor, factor, 1]), blend=blend,
        )  # fmt: skip
        if factor > 1:
            layer = enlarged(layer, factor, width, height)
        picture = layer if picture is None else _behind(picture, layer, blend)
    if picture is None:
        return kernels.splat(
            centres, covariances, opacities, colours, width, height, rings=rings, arcs=arcs, blend=blend
        )
    return picture


def _rows(tensor: Tensor, index: Tensor) -> Tensor:
    """tensor[index], which is ascending: the tensor itself if that is all of it."""
    return tensor if len(index) == len(tensor) else tensor[index]


def _behind(front: Splats, back: Splats, blend: Blend) -> Splats:
    """Two layers as one."""
    if blend == "add":
        return Splats(front.colour + back.colour, front.transmittance)
    return Splats(over(front, back.colour), front.transmittance * back.transmittance)
