# SPDX-License-Identifier: GPL-3.0-or-later
"""What JPEG leaves of many pictures at once, on any device: ITU T.81's transform and the tables of its annex K, scaled
by a quality as libjpeg scales them, with half the rows and columns of colour (4:2:0)."""
from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - its name everywhere
from torch import Tensor

SIDE = 8
"""Pixels of a block."""
MULTIPLE = 2 * SIDE
"""Height and width are multiples of this."""
_LUMA = (16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56,
         14, 17, 22, 29, 51, 87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92,
         49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99)
_CHROMA = (17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99,
           47, 66, 99, 99, 99, 99, 99, 99, *[99] * 32)
_TO_YCC = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))
_FROM_YCC = ((1.0, 0.0, 1.402), (1.0, -0.344136, -0.714136), (1.0, 1.772, 0.0))


def stored(codes: Tensor, quality: Tensor) -> Tensor:
    """8 bit codes (n, 3, h, w), whole numbers 0..255 as floats, as they come back; quality (n,), 50..100. h and w
    multiples of MULTIPLE."""
    scale = 200 - 2 * quality
    ycc = torch.einsum("ij,njhw->nihw", _constant(_TO_YCC, codes), codes)
    luma = _quantised(ycc[:, :1] - 128, scale, _LUMA) + 128
    chroma = _quantised(F.avg_pool2d(ycc[:, 1:], 2), scale, _CHROMA)
    chroma = F.interpolate(chroma, scale_factor=2, mode="bilinear", align_corners=False)
    back = torch.einsum("ij,njhw->nihw", _constant(_FROM_YCC, codes), torch.cat([luma, chroma], 1))
    return back.round().clamp(0, 255)


def _quantised(planes: Tensor, scale: Tensor, table: tuple[int, ...]) -> Tensor:
    """(n, c, h, w) through blocks of cosines whose weights are rounded."""
    n, c, h, w = planes.shape
    cosines = _cosines(planes)
    steps = torch.floor((_constant(table, planes) * scale[:, None] + 50) / 100).clamp(1, 255)
    steps = steps.reshape(n, 1, 1, 1, SIDE, SIDE)
    blocks = planes.reshape(n, c, h // SIDE, SIDE, w // SIDE, SIDE).transpose(3, 4)
    weights = (cosines @ blocks @ cosines.T / steps).round() * steps
    return (cosines.T @ weights @ cosines).transpose(3, 4).reshape(n, c, h, w)


def _cosines(like: Tensor) -> Tensor:
    """(SIDE, SIDE), orthonormal."""
    at = torch.arange(SIDE, dtype=like.dtype, device=like.device)
    waves = torch.cos((2 * at[None] + 1) * at[:, None] * (torch.pi / (2 * SIDE))) * (2 / SIDE) ** 0.5
    return torch.cat([waves[:1] * 0.5**0.5, waves[1:]])


def _constant(values: object, like: Tensor) -> Tensor:
    return torch.tensor(values, dtype=like.dtype).to(like.device, non_blocking=True)
