# SPDX-License-Identifier: GPL-3.0-or-later
"""Input encodings of the deformation network (paper, appendix "Flare representation").

Light and camera are the same for all Gaussians of a view, so each hash grid is evaluated at one point per view: 8
corners on each level. Gradients therefore touch 8 rows per level (of the paper's 16 levels 128, of millions); the
tables give sparse gradients, for an optimiser that updates those rows only.
"""
from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from ..gaussians.kernels import FusedKernels, fused_kernels
from ..look.network import CORNERS, PRIMES

TABLE = "table.weight"
"""Suffix of the name of a grid's table among a model's parameters."""


class HashGrid(nn.Module):
    """Multiresolution hash grid over the unit cube (Müller et al. 2022, section 3).

    Level k has resolution floor(base * growth**k) and at most 2**table_bits rows of `features` values; levels whose
    corners fit in so many rows are stored densely, the others hashed. Input (3,) in 0..1 (clamped), output (levels *
    features,).
    """

    _resolutions: Tensor
    _starts: Tensor
    _rows: Tensor
    _primes: Tensor
    _corners: Tensor

    def __init__(self, table_bits: int, growth: float, levels: int = 16, features: int = 2, base: int = 16) -> None:
        """Make a table of zeros. table_bits: log2 of the most rows of a level; growth: ratio of successive levels'
        resolutions; base: the coarsest resolution; features: numbers of a row."""
        super().__init__()
        self.levels, self.features = levels, features
        self._layout: Any = None  # of the CPU kernels, once it is used
        size = 1 << table_bits
        resolutions = [math.floor(base * growth**level) for level in range(levels)]
        rows = [min((resolution + 1) ** 3, size) for resolution in resolutions]
        starts = [sum(rows[:level]) for level in range(levels)]
        self.table = nn.Embedding(sum(rows), features, sparse=True)
        # Zero, not noise: gradients reach the table through the network, and a file need hold touched rows only.
        nn.init.zeros_(self.table.weight)

        def register_constant(name: str, values: list[int]) -> None:
            self.register_buffer(name, torch.tensor(values, dtype=torch.int64), persistent=False)

        register_constant("_resolutions", resolutions)
        register_constant("_starts", starts)
        register_constant("_rows", rows)
        register_constant("_primes", PRIMES.tolist())
        self.register_buffer("_corners", torch.from_numpy(CORNERS.copy()), persistent=False)

    def forward(self, point: Tensor) -> Tensor:
        """Interpolate the grid at a point (3,) in 0..1."""
        fused = fused_kernels(self.table.weight)
        return self.interpolate(point) if fused is None else self._interpolate_fused(fused, point)

    def _interpolate_fused(self, kernels: FusedKernels, point: Tensor) -> Tensor:
        """Return `interpolate` of a point, by the CPU kernels."""
        if self._layout is None:
            parts = self._resolutions, self._starts, self._rows, self._primes, self._corners
            self._layout = kernels.GridLayout(*(part.numpy() for part in parts))
        return kernels.interpolate_grid(self.table.weight, point, self._layout)

    def interpolate(self, point: Tensor) -> Tensor:
        """Interpolate the grid at a point (3,) in 0..1, by torch: the definition."""
        indices, weights = self._corner_rows(point.detach())
        rows = self.table(indices)  # (levels, 8, features)
        return (rows * weights[..., None]).sum(1).reshape(-1)

    def _corner_rows(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Return, for each level, the table's rows of the 8 corners of the cell around a point (3,), and their
        trilinear weights, (levels, 8) each.

        A level whose corners all fit in its rows is indexed densely, any other by a spatial hash.
        """
        resolutions, rows, primes, corners = self._resolutions, self._rows, self._primes, self._corners
        scaled = point.clamp(0, 1)[None] * resolutions[:, None]
        low = torch.minimum(scaled.floor(), resolutions[:, None] - 1.0)  # 1 lies in the last cell
        fraction = (scaled - low)[:, None]  # (levels, 1, 3)
        corner = low.long()[:, None] + corners  # (levels, 8, 3)
        weights = torch.where(corners.bool(), fraction, 1 - fraction).prod(-1)
        side = resolutions[:, None] + 1
        dense = corner[..., 0] + side * (corner[..., 1] + side * corner[..., 2])
        scrambled = corner * primes  # spatial hash, eq. 4 of Müller et al. 2022
        hashed = (scrambled[..., 0] ^ scrambled[..., 1] ^ scrambled[..., 2]) % rows[:, None]
        is_dense = (side**3 <= rows[:, None])
        return torch.where(is_dense, dense, hashed) + self._starts[:, None], weights.to(point.dtype)


def frequency_encoding(values: Tensor, bands: int) -> Tensor:
    """Return sin and cos of 2^k pi x for k < bands (Mildenhall et al. 2020, eq. 4): (n, d) to (n, 2 * bands * d)."""
    octaves = math.pi * 2.0 ** torch.arange(bands, dtype=values.dtype, device=values.device)
    angles = (values[..., None] * octaves).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], -1)
