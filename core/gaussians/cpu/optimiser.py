# SPDX-License-Identifier: GPL-3.0-or-later
"""Steps of Adam, in one pass over parameters, gradients and moments (the definition is `..optimiser`)."""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from .buffers import Array
from .compilation import kernel
from .threads import parallel
from .tiles import flat
from .vector import LANES, fma, load, sqrt, store, take_number

PIECE = 1 << 13
"""Least number of values to a piece of work."""


@kernel
def advance(counter, parameter, gradient, first, second, rates, piece, beta1, new1, beta2, new2, root, epsilon):
    """All flat. rates: repeats along the parameter, a multiple of 16 long, bias correction included; piece: a
    multiple of its length. new: 1 - beta; root: 1 / sqrt(1 - beta2^t)."""
    n, period = parameter.size, rates.size
    while True:
        start = take_number(counter) * piece
        if start >= n:
            break
        end = min(start + piece, n)
        whole = end - (end - start) % LANES
        place = 0
        for i in range(start, whole, LANES):
            g = load(gradient, i)
            m = fma(load(first, i), beta1, g * new1)
            v = fma(load(second, i), beta2, g * g * new2)
            store(first, i, m)
            store(second, i, v)
            store(parameter, i, load(parameter, i) - load(rates, place) * m / fma(sqrt(v), root, epsilon))
            place += LANES
            if place == period:
                place = 0
        for i in range(whole, end):
            g = gradient[i]
            first[i] = first[i] * beta1 + g * new1
            second[i] = second[i] * beta2 + g * g * new2
            parameter[i] -= rates[(i - start) % period] * first[i] / (math.sqrt(second[i]) * root + epsilon)


class Step(NamedTuple):
    """What a step of a parameter is made of; see `..optimiser`. Parameter and moments are contiguous float32, and are
    changed in place."""

    parameter: Tensor
    gradient: Tensor
    first: Tensor
    second: Tensor
    step: int
    rate: float | Tensor


def adam_steps(steps: Sequence[Step], *, beta1: float, beta2: float, epsilon: float) -> None:
    """A step of each of some parameters. They do not wait for each other: a thread that finds no more of one goes on
    with the next."""
    calls = [_arguments(*step, beta1, beta2, epsilon) for step in steps]
    pieces = sum(-(-call[1].size // call[6]) for call in calls)
    parallel(_advance_all, calls, limit=pieces if advance.overloads else 1)  # compiled by one thread


def _advance_all(_: Array, calls: Sequence[tuple[Any, ...]]) -> None:
    for call in calls:
        advance(*call)


def _arguments(
    parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, step: int, rate: float | Tensor,
    beta1: float, beta2: float, epsilon: float,
) -> tuple[Any, ...]:  # fmt: skip
    """Of `advance`, with a counter of its own."""
    row = flat(rate) if isinstance(rate, Tensor) else np.full(LANES, rate, np.float32)
    if row.size % LANES:
        row = np.tile(row, math.lcm(row.size, LANES) // row.size)
    rates = row / np.float32(1 - beta1**step)
    piece = -(-PIECE // rates.size) * rates.size
    root = 1 / math.sqrt(1 - beta2**step)
    return (
        np.zeros(1, np.int64), flat(parameter), flat(gradient), flat(first), flat(second), rates, piece,
        np.float32(beta1), np.float32(1 - beta1), np.float32(beta2), np.float32(1 - beta2), np.float32(root),
        np.float32(epsilon),
    )  # fmt: skip
