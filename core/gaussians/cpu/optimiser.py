# SPDX-License-Identifier: GPL-3.0-or-later
"""Steps of Adam, in one pass over parameters, gradients and moments (the definition is `..optimiser`).

It takes as long as memory takes to read and write them; `stepping` saves a part of that.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from .buffers import Array
from .compilation import inlined, kernel
from .threads import parallel
from .tiles import flat
from .vector import LANES, fma, get, load, sqrt, store, take_number

PIECE = 1 << 13
"""Least number of values to a piece of work."""
CONSTANTS = 7
"""How many `constants_of` gives."""


@inlined
def constants_of(constants):
    """What `move` needs: beta1, 1 - beta1, beta2, 1 - beta2, 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t), epsilon."""
    c = constants
    return get(c, 0), get(c, 1), get(c, 2), get(c, 3), get(c, 4), get(c, 5), get(c, 6)


@inlined
def move(parameter, first, second, at, gradient, rate, constants):
    """A step of 16 numbers at a flat index."""
    beta1, new1, beta2, new2, scale, root, epsilon = constants
    m = fma(load(first, at), beta1, gradient * new1)
    v = fma(load(second, at), beta2, gradient * gradient * new2)
    store(first, at, m)
    store(second, at, v)
    store(parameter, at, load(parameter, at) - rate * scale * m / fma(sqrt(v), root, epsilon))


@inlined
def move_all(parameter, gradient, first, second, rates, constants):
    """A step of all numbers of a parameter; rates: repeats along it, a multiple of 16 long."""
    n, period = parameter.size, rates.size
    place, whole = 0, n - n % LANES
    for i in range(0, whole, LANES):
        move(parameter, first, second, i, load(gradient, i), load(rates, place), constants)
        place += LANES
        if place == period:
            place = 0
    beta1, new1, beta2, new2, scale, root, epsilon = constants
    for i in range(whole, n):
        g = gradient[i]
        first[i] = first[i] * beta1 + g * new1
        second[i] = second[i] * beta2 + g * g * new2
        parameter[i] -= rates[i % period] * scale * first[i] / (math.sqrt(second[i]) * root + epsilon)


@kernel
def advance(counter, parameter, gradient, first, second, rates, piece, constants):
    """All flat. rates: as for `move_all`; piece: a multiple of its length."""
    while True:
        start = take_number(counter) * piece
        end = min(start + piece, parameter.size)
        if start >= end:
            break
        move_all(
            parameter[start:end], gradient[start:end], first[start:end], second[start:end], rates,
            constants_of(constants),
        )  # fmt: skip


class Step(NamedTuple):
    """What a step of a parameter is made of; see `..optimiser`. Parameter and moments are contiguous float32, and are
    changed in place. gradient: None if the backward pass takes the step (`stepping`)."""

    parameter: Tensor
    gradient: Tensor | None
    first: Tensor
    second: Tensor
    step: int
    rate: float | Tensor


def adam_steps(steps: Sequence[Step], *, beta1: float, beta2: float, epsilon: float) -> None:
    """A step of each of some parameters. They do not wait for each other: a thread that finds no more of one goes on
    with the next."""
    calls = [_arguments(step, beta1, beta2, epsilon) for step in steps]
    pieces = sum(-(-call[1].size // call[6]) for call in calls)
    parallel(_advance_all, calls, limit=pieces if advance.overloads else 1)  # compiled by one thread


def _advance_all(counter: Array, calls: Sequence[tuple[Any, ...]]) -> None:
    for number, call in enumerate(calls):
        advance(call[0] if number else counter, *call[1:])


def rates_of(rate: float | Tensor) -> Array:
    """A multiple of 16 numbers that repeat along the parameter."""
    if not isinstance(rate, Tensor):
        return _constant_rates(rate)
    row = flat(rate)
    return np.tile(row, math.lcm(row.size, LANES) // row.size) if row.size % LANES else row


@lru_cache(256)
def _constant_rates(rate: float) -> Array:
    return np.full(LANES, rate, np.float32)


@lru_cache(256)
def constants_for(step: int, beta1: float, beta2: float, epsilon: float) -> tuple[float, ...]:
    """See `constants_of`; step: from 1."""
    unbiased = 1 / (1 - beta1**step), 1 / math.sqrt(1 - beta2**step)
    return beta1, 1 - beta1, beta2, 1 - beta2, *unbiased, epsilon


def _arguments(step: Step, beta1: float, beta2: float, epsilon: float) -> tuple[Any, ...]:
    """Of `advance`, with a counter of its own."""
    assert step.gradient is not None
    rates = rates_of(step.rate)
    piece = -(-PIECE // rates.size) * rates.size
    arrays = (flat(t) for t in (step.parameter, step.gradient, step.first, step.second))
    constants = np.array(constants_for(step.step, beta1, beta2, epsilon), np.float32)
    return np.zeros(1, np.int64), *arrays, rates, piece, constants
