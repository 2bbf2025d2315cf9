# SPDX-License-Identifier: GPL-3.0-or-later
"""Flares at mixed resolution: what is soft against the pixel is drawn small and enlarged.

A 2D Gaussian whose narrowest feature is s px wide (its smaller standard deviation; times w for a ring)
changes by at most peak / s² a px², so bilinear interpolation on a grid of f px is off by at most
f²/8 * 2 * peak / s² = peak (f / (2 s))². A Gaussian is drawn at 1/f size where f / (2 s) <= 1/8: by 1/4 from
s = 16 px, by 1/2 from 8 px, in full below. So each one is off by at most 1/64 of its peak, plus the step at
which it is cut off (1/255 or 1/4096); flares are made of many faint ones, and their errors fall with 1/s².

"over" then also changes the order: full size in front, then 1/2, then 1/4.
"""
from __future__ import annotations

import torch
from torch import Tensor

from .kernels import KernelSet
from .rendering import Splats

FEATURE_PER_STEP = 4.0
"""Narrowest feature, in steps of the small grid, from which that grid is used."""
REDUCTIONS = (1, 2, 4)


def narrowest(covariances: Tensor, rings: Tensor | None, arcs: Tensor | None) -> Tensor:
    """(n,) px: the standard deviation of each Gaussian across its narrowest feature."""
    xx, xy, yy = covariances.unbind(-1)
    largest = (xx + yy) / 2 + (((xx - yy) / 2) ** 2 + xy * xy).sqrt()
    width = ((xx * yy - xy * xy) / largest.clamp(min=1e-12)).clamp(min=0).sqrt()  # no cancellation
    if rings is not None:
        width = width * rings[:, 1].clamp(0, 1)
    if arcs is not None:
        # An arc's window meets all angles at the centre, where nothing is wide: the window's edge takes
        # 2 / k of angle, and what matters of it lies at the radius of the ring.
        radius = rings[:, 0].clamp(min=0) if rings is not None else torch.zeros_like(width)
        width = torch.minimum(width, width * radius * 2 / arcs[:, 2].abs().clamp(min=1e-6))
    return width


def reductions(covariances: Tensor, rings: Tensor | None, arcs: Tensor | None) -> Tensor:
    """(n,) 1, 2 or 4: at which share of the size each Gaussian is drawn; not differentiable."""
    with torch.no_grad():
        width = narrowest(covariances, rings, arcs)
        return 1 + (width >= 2 * FEATURE_PER_STEP).int() + 2 * (width >= 4 * FEATURE_PER_STEP).int()


def enlarge(picture: Tensor, factor: int, width: int, height: int) -> Tensor:
    """(h, w, c) from a picture `factor` times smaller with a border of one pixel, bilinear."""
    planes = picture.permute(2, 0, 1)[None]
    planes = torch.nn.functional.interpolate(planes, scale_factor=factor, mode="bilinear")
    return planes[0, :, factor : factor + height, factor : factor + width].permute(1, 2, 0)


def splat_mixed(
    kernels: KernelSet, centres: Tensor, covariances: Tensor, opacities: Tensor, colours: Tensor,
    width: int, height: int, *, rings: Tensor | None, arcs: Tensor | None, blend: str,
) -> Splats:  # fmt: skip
    """`splat` with resolution "mixed"."""
    factors = reductions(covariances, rings, arcs)
    colour = centres.new_zeros(height, width, 3)
    transmittance = centres.new_ones(height, width)
    for factor in REDUCTIONS:  # front to back
        index = torch.nonzero(factors == factor)[:, 0]
        if len(index) == 0:
            continue
        border = 0 if factor == 1 else 1  # so that interpolation has neighbours on all sides
        layer = kernels.splat(
            centres[index] / factor + border, covariances[index] / factor**2,
            opacities[index], colours[index],
            -(-width // factor) + 2 * border, -(-height // factor) + 2 * border,
            rings=None if rings is None else rings[index], arcs=None if arcs is None else arcs[index],
            blend=blend,
        )  # fmt: skip
        if factor > 1:
            planes = torch.cat([layer.colour, layer.transmittance[..., None]], -1)
            planes = enlarge(planes, factor, width, height)
            layer = Splats(planes[..., :3], planes[..., 3])
        if blend == "add":
            colour = colour + layer.colour
        else:
            colour = colour + transmittance[..., None] * layer.colour
            transmittance = transmittance * layer.transmittance
    return Splats(colour, transmittance)
