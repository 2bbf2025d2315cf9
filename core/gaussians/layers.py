# SPDX-License-Identifier: GPL-3.0-or-later
"""Bilinear upsampling of reduced layers, and compositing of a layer over a background.

The torch code is the definition; float32 pictures on the CPU use the fused kernels of `cpu.layers`.
"""
from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .kernels import fused_kernels
from .rendering import Splats


def over(front: Splats, behind: Tensor) -> Tensor:
    """Composite a layer over a picture (h, w, 3): colour + transmittance * behind."""
    cpu = fused_kernels(behind)
    composite = None if cpu is None else cpu.over(front.colour, front.transmittance, behind)
    return front.colour + front.transmittance[..., None] * behind if composite is None else composite


def upsample_layer(layer: Splats, factor: int, width: int, height: int) -> Splats:
    """Upsample a layer bilinearly to (height, width); it was drawn at 1 / factor size with a border of one pixel."""
    cpu = fused_kernels(layer.colour)
    upsampled = None if cpu is None else cpu.upsample(layer.colour, layer.transmittance, factor, width, height)
    if upsampled is None:
        planes = torch.cat([layer.colour, layer.transmittance[..., None]], -1)
        planes = upsample(planes, factor)[:height, :width]
        upsampled = planes[..., :3], planes[..., 3]
    return Splats(*upsampled)


def upsample(picture: Tensor, factor: int) -> Tensor:
    """Upsample (h, w, c) to ((h - 2) factor, (w - 2) factor, c), bilinear; border pixels serve as neighbours only."""
    across = _UpsampleRows.apply(picture.transpose(0, 1), factor)
    return _UpsampleRows.apply(across.transpose(0, 1), factor)


class _UpsampleRows(torch.autograd.Function):
    """Upsample rows, (h, w, c) to ((h - 2) factor, w, c): each row becomes `factor` rows, interpolated between it and
    its neighbours."""

    @staticmethod
    def forward(ctx: Any, picture: Tensor, factor: int) -> Tensor:
        picture = picture.contiguous()
        height, *row = picture.shape
        ctx.row, ctx.factor = row, factor
        size = row[0] * row[1]
        neighbours = picture.as_strided((height - 2, 3, size), (size, size, 1))  # overlapping, not copied
        return (_interpolation_weights(factor, picture) @ neighbours).view((height - 2) * factor, *row)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        size = ctx.row[0] * ctx.row[1]
        parts = gradient.contiguous().view(-1, ctx.factor, size)
        shares = _interpolation_weights(ctx.factor, gradient).T @ parts
        total = gradient.new_zeros(len(parts) + 2, size)
        for position, share in enumerate(shares.unbind(1)):  # for the row before, the row itself, the row after
            total[position : position + len(parts)] += share
        return total.view(-1, *ctx.row), None


def _interpolation_weights(factor: int, like: Tensor) -> Tensor:
    """Return (factor, 3) weights of the row before, the row itself and the row after, for each new row."""
    position = (torch.arange(factor, dtype=like.dtype, device=like.device) + 0.5) / factor - 0.5
    return torch.stack([(-position).clamp(min=0), 1 - position.abs(), position.clamp(min=0)], 1)
