# SPDX-License-Identifier: GPL-3.0-or-later
"""Simulates JPEG compression of many pictures at once, on any device: the transform of ITU T.81, the tables of its
annex K scaled by quality as libjpeg does, and 4:2:0 chroma."""
from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 - its name everywhere
from torch import Tensor

BLOCK_SIZE = 8
"""Side of a DCT block, pixels."""
SIZE_MULTIPLE = 2 * BLOCK_SIZE
"""Height and width must be multiples of this."""
_LUMA = (16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56,
         14, 17, 22, 29, 51, 87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92,
         49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99)
_CHROMA = (17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99,
           47, 66, 99, 99, 99, 99, 99, 99, *[99] * 32)
_TO_YCC = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))
_FROM_YCC = ((1.0, 0.0, 1.402), (1.0, -0.344136, -0.714136), (1.0, 1.772, 0.0))


def simulate_jpeg(codes: Tensor, quality: Tensor) -> Tensor:
    """Compress pictures as JPEG and decode them.

    codes: (n, 3, h, w), whole numbers 0..255 as floats, h and w multiples of SIZE_MULTIPLE; so is the result.
    quality: (n,), 50..100.
    """
    scale = 200 - 2 * quality  # libjpeg's scale of the quantisation tables, per cent, for a quality of 50 or more
    ycc = torch.einsum("ij,njhw->nihw", _constant(_TO_YCC, codes), codes)
    luma = _quantise_blocks(ycc[:, :1] - 128, scale, _LUMA) + 128
    chroma = _quantise_blocks(F.avg_pool2d(ycc[:, 1:], 2), scale, _CHROMA)
    chroma = F.interpolate(chroma, scale_factor=2, mode="bilinear", align_corners=False)
    decoded = torch.einsum("ij,njhw->nihw", _constant(_FROM_YCC, codes), torch.cat([luma, chroma], 1))
    return decoded.round().clamp(0, 255)


def _quantise_blocks(planes: Tensor, scale: Tensor, table: tuple[int, ...]) -> Tensor:
    """Return planes (n, c, h, w) whose DCT coefficients are quantised, in blocks of BLOCK_SIZE.

    table: quantisation steps, row by row. scale: factor on these steps, per cent, (n,).
    """
    n, c, h, w = planes.shape
    dct = _dct_matrix(planes)
    steps = torch.floor((_constant(table, planes) * scale[:, None] + 50) / 100).clamp(1, 255)
    steps = steps.reshape(n, 1, 1, 1, BLOCK_SIZE, BLOCK_SIZE)
    blocks = planes.reshape(n, c, h // BLOCK_SIZE, BLOCK_SIZE, w // BLOCK_SIZE, BLOCK_SIZE).transpose(3, 4)
    coefficients = (dct @ blocks @ dct.T / steps).round() * steps
    return (dct.T @ coefficients @ dct).transpose(3, 4).reshape(n, c, h, w)


def _dct_matrix(like: Tensor) -> Tensor:
    """Return the orthonormal DCT matrix (BLOCK_SIZE, BLOCK_SIZE)."""
    index = torch.arange(BLOCK_SIZE, dtype=like.dtype, device=like.device)
    basis = torch.cos((2 * index[None] + 1) * index[:, None] * (torch.pi / (2 * BLOCK_SIZE))) * (2 / BLOCK_SIZE) ** 0.5
    return torch.cat([basis[:1] * 0.5**0.5, basis[1:]])


def _constant(values: object, like: Tensor) -> Tensor:
    return torch.tensor(values, dtype=like.dtype).to(like.device, non_blocking=True)
