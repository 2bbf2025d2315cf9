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


@kernel
def adam_kernel(counter, parameter, gradient, first, second, rates, task_size, constants):
    """Make an Adam step on a parameter, on all threads; arrays are flat.

    counter: index of the next task; rates: learning rates, repeated along the parameter; task_size: numbers of a task,
    a multiple of the size of rates; constants: the array that `unpack_constants` reads."""
    while True:
        start = atomic_increment(counter) * task_size
        end = min(start + task_size, parameter.size)
        if start >= end:
            break
        step_array(
            parameter[start:end], gradient[start:end], first[start:end], second[start:end], rates,
            unpack_constants(constants),
        )  # fmt: skip


class _KernelArguments(NamedTuple):
    """Arguments of `adam_kernel`, in its order."""

    counter: Array
    parameter: Array
    gradient: Array
    first: Array
    second: Array
    rates: Array
    task_size: int
    constants: Array


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
    tasks = sum(-(-call.parameter.size // call.task_size) for call in calls)
    parallel(_step_all, calls, limit=tasks if adam_kernel.overloads else 1)  # compiled by one thread


def _step_all(counter: Array, calls: Sequence[_KernelArguments]) -> None:
    """Step all parameters on this thread together with the others. The first call counts by the counter of `parallel`,
    for which idle threads watch; each other call has its own."""
    for number, call in enumerate(calls):
        adam_kernel(*(call if number else call._replace(counter=counter)))


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


def _kernel_arguments(step: AdamStep, beta1: float, beta2: float, epsilon: float) -> _KernelArguments:
    """Return the arguments of `adam_kernel` for a step, with a new counter."""
    assert step.gradient is not None
    rates = repeat_rates(step.rate)
    task_size = -(-MIN_TASK_SIZE // rates.size) * rates.size
    parameter, gradient, first, second = (flat(t) for t in (step.parameter, step.gradient, step.first, step.second))
    constants = np.array(adam_constants(step.step, beta1, beta2, epsilon), np.float32)
    counter = np.zeros(1, np.int64)
    return _KernelArguments(counter, parameter, gradient, first, second, rates, task_size, constants)
