# SPDX-License-Identifier: GPL-3.0-or-later
"""Hash grids at one point, and sparse Adam steps of their tables; the definitions are `core.flare.encoding` and
torch.optim.SparseAdam.

A view touches 8 rows of each level, so the time is that of the calls: one kernel instead of thirty operations.
"""
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .buffers import Array
from .compilation import kernel
from .tiles import flat

ONE = np.float32(1)


class GridLayout(NamedTuple):
    """Levels of a hash grid: resolutions, first rows in the table and numbers of rows, (levels,) each; factors of the
    hash (3,) and corners of a cell (8, 3). All int64."""

    resolutions: Array
    starts: Array
    rows: Array
    primes: Array
    corners: Array


@kernel
def interpolate_kernel(point, table, features, resolutions, starts, rows, primes, corners, indices, weights, result):
    """Write the interpolated features of each level, and the table's rows and trilinear weights of the 8 corners.

    point (3,): clamped to 0..1. table: flat, `features` numbers a row. The levels are those of a `GridLayout`.
    indices, weights: (levels, 8). result: flat.
    """
    for level in range(resolutions.size):
        resolution, count = resolutions[level], rows[level]
        side = resolution + 1
        is_dense = side * side * side <= count
        for feature in range(features):
            result[level * features + feature] = 0
        for corner in range(8):
            weight, dense, scrambled, stride = ONE, np.int64(0), np.int64(0), np.int64(1)
            for axis in range(3):
                inside = point[axis] if point[axis] > 0 else np.float32(0)  # also for NaN: an index must be a number
                scaled = min(inside, ONE) * np.float32(resolution)
                low = min(math.floor(scaled), np.float32(resolution) - ONE)  # 1 lies in the last cell
                fraction = scaled - np.float32(low)
                place = np.int64(low) + corners[corner, axis]
                weight *= fraction if corners[corner, axis] > 0 else ONE - fraction
                dense += place * stride
                scrambled ^= place * primes[axis]
                stride *= side
            row = starts[level] + (dense if is_dense else scrambled % count)
            indices[level, corner], weights[level, corner] = row, weight
            for feature in range(features):
                result[level * features + feature] += weight * table[row * features + feature]


@kernel
def sparse_adam_kernel(indices, gradients, features, parameter, first, second, weight1, weight2, step_size, epsilon):
    """Make a step of torch.optim.SparseAdam on the rows of a table; repeated rows have the sum of their gradients.

    indices: (m,). gradients: flat, `features` numbers a row. parameter, first, second: the table and its moments, flat.
    weight1, weight2: 1 - beta1 and 1 - beta2. step_size: learning rate with both corrections of the bias.
    """
    for i in range(indices.size):
        is_repeated = False
        for j in range(i):
            is_repeated = is_repeated or indices[j] == indices[i]
        if is_repeated:
            continue
        for feature in range(features):
            gradient = np.float32(0)
            for j in range(i, indices.size):
                if indices[j] == indices[i]:
                    gradient += gradients[j * features + feature]
            at = indices[i] * features + feature
            first[at] += (gradient - first[at]) * weight1
            second[at] += (gradient * gradient - second[at]) * weight2
            parameter[at] -= step_size * first[at] / (math.sqrt(second[at]) + epsilon)


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, point: Tensor, layout: GridLayout) -> Tensor:
        """Return the features (levels * features,); the gradient of the table is sparse."""
        levels, features = len(layout.resolutions), table.shape[1]
        indices, weights = np.empty((levels, 8), np.int64), np.empty((levels, 8), np.float32)
        result = np.empty(levels * features, np.float32)
        interpolate_kernel(flat(point), flat(table), features, *layout, indices, weights, result)
        ctx.arrays, ctx.shape = (indices, weights), table.shape
        return torch.from_numpy(result)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        indices, weights = ctx.arrays
        by_level = flat(gradient).reshape(len(weights), 1, -1)
        values = (weights[..., None] * by_level).reshape(weights.size, -1)
        return torch.sparse_coo_tensor(torch.from_numpy(indices.reshape(1, -1)), torch.from_numpy(values), ctx.shape,
                                       check_invariants=False), None, None


def interpolate_grid(table: Tensor, point: Tensor, layout: GridLayout) -> Tensor:
    """Return the features (levels * features,) of a hash grid at a point (3,), 0..1, which gets no gradient.

    table: (rows, features)."""
    features: Tensor = _Interpolate.apply(table, point.detach(), layout)
    return features


def sparse_adam_step(parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: int, rate: float,
                     beta1: float, beta2: float, epsilon: float) -> None:
    """Step a table (rows, features) and its moments in place by a sparse gradient; step: counts from 1."""
    step_size = rate * math.sqrt(1 - beta2**step) / (1 - beta1**step)
    indices, values = gradient._indices()[0].numpy(), gradient._values()
    sparse_adam_kernel(indices, flat(values), parameter.shape[1], flat(parameter), flat(first), flat(second),
                       *map(np.float32, (1 - beta1, 1 - beta2, step_size, epsilon)))
