# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam steps in one pass over parameters, gradients and moments; the definition is `..optimiser`.

Memory bandwidth bounds the time; `stepping` saves a part of the traffic.
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
from .vector import LANES, atomic_increment, fma, load, load_scalar, sqrt, store

MIN_TASK_SIZE = 1 << 13
"""Smallest number of values that a thread steps at a time."""
NUM_CONSTANTS = 7
"""Number of constants of a step; see `unpack_constants`."""


@inlined
def unpack_constants(constants):
    """Return beta1, 1 - beta1, beta2, 1 - beta2, 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t), epsilon as a tuple."""
    c = constants
    return (
        load_scalar(c, 0), load_scalar(c, 1), load_scalar(c, 2), load_scalar(c, 3), load_scalar(c, 4),
        load_scalar(c, 5), load_scalar(c, 6),
    )  # fmt: skip


@inlined
def step_lanes(parameter, first, second, at, gradient, rate, constants):
    """Step 16 numbers at a flat index."""
    beta1, new1, beta2, new2, scale, root, epsilon = constants
    m = fma(load(first, at), beta1, gradient * new1)
    v = fma(load(second, at), beta2, gradient * gradient * new2)
    store(first, at, m)
    store(second, at, v)
    store(parameter, at, load(parameter, at) - rate * scale * m / fma(sqrt(v), root, epsilon))


@inlined
def step_array(parameter, gradient, first, second, rates, constants):
    """Step all numbers of a parameter, with their `first` and `second` moments.

    rates: the learning rates of a multiple of 16 numbers, repeated along the parameter. constants: the tuple of
    `unpack_constants`.
    """
    n, period = parameter.size, rates.size
    place, vector_end = 0, n - n % LANES
    for i in range(0, vector_end, LANES):
        step_lanes(parameter, first, second, i, load(gradient, i), load(rates, place), constants)
        place += LANES
        if place == period:
            place = 0
    beta1, new1, beta2, new2, scale, root, epsilon = constants
    for i in range(vector_end, n):
        g = gradient[i]
        first[i] = first[i] * beta1 + g * new1
        second[i] = second[i] * beta2 + g * g * new2
        parameter[i] -= rates[i % period] * scale * first[i] / (math.sqrt(second[i]) * root + epsilon)


@kernel
def adam_kernel(counter, parameter, gradient, first, second, rates, task_size, constants):
    """Step a parameter on all threads; arrays are flat. rates: see `step_array`; task_size: a multiple of their
    size."""
    while True:
        start = atomic_increment(counter) * task_size
        end = min(start + task_size, parameter.size)
        if start >= end:
            break
        step_array(
            parameter[start:end], gradient[start:end], first[start:end], second[start:end], rates,
            unpack_constants(constants),
        )  # fmt: skip


class AdamStep(NamedTuple):
    """One parameter's step; see `..optimiser`. Parameter and moments are contiguous float32 and are changed in place.
    gradient: None if the backward pass makes the step (`stepping`)."""

    parameter: Tensor
    gradient: Tensor | None
    first: Tensor
    second: Tensor
    step: int
    rate: float | Tensor


def adam_steps(steps: Sequence[AdamStep], *, beta1: float, beta2: float, epsilon: float) -> None:
    """Make all steps in one parallel call: a thread that finds no more work on one parameter takes the next."""
    calls = [_kernel_arguments(step, beta1, beta2, epsilon) for step in steps]
    tasks = sum(-(-call[1].size // call[6]) for call in calls)  # parameter and task_size of `adam_kernel`
    parallel(_step_all, calls, limit=tasks if adam_kernel.overloads else 1)  # compiled by one thread


def _step_all(counter: Array, calls: Sequence[tuple[Any, ...]]) -> None:
    """Step all parameters on this thread together with the others. The first call counts by the counter of `parallel`,
    for which idle threads watch; each other call has its own."""
    for number, call in enumerate(calls):
        adam_kernel(call[0] if number else counter, *call[1:])


def repeat_rates(rate: float | Tensor) -> Array:
    """Return a multiple of 16 numbers, to be repeated along the parameter."""
    if not isinstance(rate, Tensor):
        return _constant_rates(rate)
    row = flat(rate)
    return np.tile(row, math.lcm(row.size, LANES) // row.size) if row.size % LANES else row


@lru_cache(256)
def _constant_rates(rate: float) -> Array:
    return np.full(LANES, rate, np.float32)


@lru_cache(256)
def adam_constants(step: int, beta1: float, beta2: float, epsilon: float) -> tuple[float, ...]:
    """Return the constants of `unpack_constants`; step: counts from 1."""
    unbiased = 1 / (1 - beta1**step), 1 / math.sqrt(1 - beta2**step)
    return beta1, 1 - beta1, beta2, 1 - beta2, *unbiased, epsilon


def _kernel_arguments(step: AdamStep, beta1: float, beta2: float, epsilon: float) -> tuple[Any, ...]:
    """Return the arguments of `adam_kernel`, with a new counter."""
    assert step.gradient is not None
    rates = repeat_rates(step.rate)
    task_size = -(-MIN_TASK_SIZE // rates.size) * rates.size
    arrays = (flat(t) for t in (step.parameter, step.gradient, step.first, step.second))
    constants = np.array(adam_constants(step.step, beta1, beta2, epsilon), np.float32)
    return np.zeros(1, np.int64), *arrays, rates, task_size, constants
