# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam steps in one pass over parameters, gradients and moments; the definition is `..optimiser`.

Memory bandwidth bounds the time; `stepping` saves a part of the traffic.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from torch import Tensor

from .buffers import Array
from .compilation import inlined, kernel
from .threads import parallel
from .tiles import flat
from .vector import LANES, atomic_increment, float_array, fma, load, load_scalar, sqrt, store

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
def step_lanes(parameter, first, second, index, gradient, rate, constants):
    """Make an Adam step on the 16 numbers of a parameter from flat index `index` on, and on their moments.

    gradient, rate: a vector each; constants: the tuple of `unpack_constants`."""
    beta1, one_minus_beta1, beta2, one_minus_beta2, correction1, correction2, epsilon = constants
    new_first = fma(load(first, index), beta1, gradient * one_minus_beta1)
    new_second = fma(load(second, index), beta2, gradient * gradient * one_minus_beta2)
    store(first, index, new_first)
    store(second, index, new_second)
    denominator = fma(sqrt(new_second), correction2, epsilon)
    store(parameter, index, load(parameter, index) - rate * correction1 * new_first / denominator)


@inlined
def step_array(parameter, gradient, first, second, rates, constants):
    """Make an Adam step on all numbers of a parameter, and on their `first` and `second` moments.

    rates: the learning rates of a multiple of 16 numbers, repeated along the parameter. constants: the tuple of
    `unpack_constants`.
    """
    n, period = parameter.size, rates.size
    rate_index, vector_end = 0, n - n % LANES
    for i in range(0, vector_end, LANES):
        step_lanes(parameter, first, second, i, load(gradient, i), load(rates, rate_index), constants)
        rate_index += LANES
        if rate_index == period:
            rate_index = 0
    beta1, one_minus_beta1, beta2, one_minus_beta2, correction1, correction2, epsilon = constants
    for i in range(vector_end, n):
        g = gradient[i]
        first[i] = first[i] * beta1 + g * one_minus_beta1
        second[i] = second[i] * beta2 + g * g * one_minus_beta2
        parameter[i] -= rates[i % period] * correction1 * first[i] / (math.sqrt(second[i]) * correction2 + epsilon)


# Columns of the table of `adam_kernel`: addresses of a parameter, its gradient, moments and learning rates; numbers of
# its values, of its rates and of the values of a task; its first task.
PARAMETER, GRADIENT, FIRST, SECOND, RATES, SIZE, PERIOD, TASK_SIZE, FIRST_TASK = range(9)
NUM_COLUMNS = 9


@kernel
def adam_kernel(counter, table, constants, tasks):
    """Make an Adam step on each of k parameters, on all threads.

    counter: index of the next task, of `tasks`. table: (k, NUM_COLUMNS), the columns PARAMETER ... FIRST_TASK; the
    rates are repeated along the parameter, and TASK_SIZE is a multiple of their number. constants: (k, NUM_CONSTANTS),
    rows that `unpack_constants` reads.
    """
    row, last_row = 0, table.shape[0] - 1
    while True:
        task = atomic_increment(counter)
        if task >= tasks:
            break
        while row < last_row and task >= table[row + 1, FIRST_TASK]:
            row += 1
        start = (task - table[row, FIRST_TASK]) * table[row, TASK_SIZE]
        size = min(table[row, TASK_SIZE], table[row, SIZE] - start)
        offset = 4 * start
        step_array(
            float_array(table[row, PARAMETER] + offset, size), float_array(table[row, GRADIENT] + offset, size),
            float_array(table[row, FIRST] + offset, size), float_array(table[row, SECOND] + offset, size),
            float_array(table[row, RATES], table[row, PERIOD]), unpack_constants(constants[row]),
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
    """Make all steps in one parallel call: a thread that finds no more work on one parameter takes the next.

    Gradients are contiguous float32, too."""
    table, arrays, tasks = np.empty((len(steps), NUM_COLUMNS), np.int64), [], 0
    for row, step in enumerate(steps):
        assert step.gradient is not None
        rates = repeat_rates(step.rate)
        arrays.append(rates)  # the table has its address alone
        size, task_size = step.parameter.numel(), -(-MIN_TASK_SIZE // rates.size) * rates.size
        addresses = (tensor.data_ptr() for tensor in (step.parameter, step.gradient, step.first, step.second))
        table[row] = *addresses, rates.ctypes.data, size, rates.size, task_size, tasks
        tasks += -(-size // task_size)
    constants = np.array([adam_constants(step.step, beta1, beta2, epsilon) for step in steps], np.float32)
    parallel(adam_kernel, table, constants, tasks, limit=tasks)


def repeat_rates(rate: float | Tensor) -> Array:
    """Return a learning rate or a row of rates as a flat array of a multiple of 16 numbers, to be repeated along the
    parameter."""
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
