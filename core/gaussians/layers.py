# SPDX-License-Identifier: GPL-3.0-or-later
"""Layers on their way to a picture: small ones enlarged, and one laid over what is behind.

In torch, the definition; float32 pictures on the CPU take the fused kernels of `cpu.layers`.
"""
from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .kernels import fused
from .rendering import Splats


def over(front: Splats, behind: Tensor) -> Tensor:
    """The picture (h, w, 3) of a layer before another picture (h, w, 3): colour + transmittance behind."""
    cpu = fused(behind)
    laid = None if cpu is None else cpu.over(front.colour, front.transmittance, behind)
    return front.colour + front.transmittance[..., None] * behind if laid is None else laid


def enlarged(layer: Splats, factor: int, width: int, height: int) -> Splats:
    """A layer that was drawn at 1 / factor size with a border of one pixel, at full size; see `enlarge`."""
    cpu = fused(layer.colour)
    found = None if cpu is None else cpu.enlarged(layer.colour, layer.transmittance, factor, width, height)
    if found is None:
        planes = torch.cat([layer.colour, layer.transmittance[..., None]], -1)
        planes = enlarge(planes, factor)[:height, :width]
        found = planes[..., :3], planes[..., 3]
    return Splats(*found)


def enlarge(picture: Tensor, factor: int) -> Tensor:
    """((h - 2) factor, (w - 2) factor, c) from (h, w, c), bilinear; the border pixels are neighbours only."""
    across = _EnlargeRows.apply(picture.transpose(0, 1), factor)
    return _EnlargeRows.apply(across.transpose(0, 1), factor)


class _EnlargeRows(torch.autograd.Function):
    """((h - 2) factor, w, c) from (h, w, c): each row becomes `factor` rows, mixed from it and its neighbours."""

    @staticmethod
    def forward(ctx: Any, picture: Tensor, factor: int) -> Tensor:
        picture = picture.contiguous()
        height, *row = picture.shape
        ctx.row, ctx.factor = row, factor
        size = row[0] * row[1]
        neighbours = picture.as_strided((height - 2, 3, size), (size, size, 1))  # overlapping, not copied
        return (_mixture(factor, picture) @ neighbours).view((height - 2) * factor, *row)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        size = ctx.row[0] * ctx.row[1]
        parts = gradient.contiguous().view(-1, ctx.factor, size)
        shares = _mixture(ctx.factor, gradient).T @ parts
        total = gradient.new_zeros(len(parts) + 2, size)
        for place, share in enumerate(shares.unbind(1)):
            total[place : place + len(parts)] += share
        return total.view(-1, *ctx.row), None


def _mixture(factor: int, like: Tensor) -> Tensor:
    """(factor, 3) shares of the row before, the row itself and the row after, in each new row."""
    place = (torch.arange(factor, dtype=like.dtype, device=like.device) + 0.5) / factor - 0.5
    return torch.stack([(-place).clamp(min=0), 1 - place.abs(), place.clamp(min=0)], 1)
