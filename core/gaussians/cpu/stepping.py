# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam steps fused into a scene's backward pass.

The projection's backward pass computes the gradients of some Gaussians at a time. Pending steps are made right there,
while the gradients are in the cache, so that these are neither written to memory nor read again. `..optimiser.Adam`
registers the steps (`offer_steps`); `scene` claims them (`claim_steps`).
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from torch import Tensor

from .buffers import Array
from .optimiser import NUM_CONSTANTS, AdamStep, adam_constants, repeat_rates
from .tiles import EMPTY, flat


class StepArrays(NamedTuple):
    """Steps of several parameters as arguments of a kernel: flat arrays, and a row of constants for each
    (`unpack_constants`)."""

    first: tuple[Array, ...]
    second: tuple[Array, ...]
    rates: tuple[Array, ...]
    constants: Array


_EMPTY_ARRAYS = (EMPTY,) * 5  # means, quaternions, scales, opacities, harmonics
NO_STEPS = StepArrays(
    _EMPTY_ARRAYS, _EMPTY_ARRAYS, _EMPTY_ARRAYS, np.empty((len(_EMPTY_ARRAYS), NUM_CONSTANTS), np.float32)
)
"""Arguments of a backward pass that writes the gradients and makes no steps."""


class _NamedStep(NamedTuple):
    name: str
    step: AdamStep


class StepsInBackward:
    """Steps that a backward pass may make instead of writing the gradients; claimed: names of the parameters whose
    steps were made."""

    def __init__(self, steps: Mapping[str, AdamStep], beta1: float, beta2: float, epsilon: float) -> None:
        self._steps = {id(step.parameter): _NamedStep(name, step) for name, step in steps.items()}
        self._options = (beta1, beta2, epsilon)
        self.claimed: set[str] = set()

    def claim(self, parameters: Sequence[Tensor]) -> StepArrays | None:
        """Return the steps of these parameters, which the caller then has to make, and note them in `claimed`; None
        unless all are pending."""
        pending = [self._steps.get(id(parameter)) for parameter in parameters]
        if any(named_step is None or named_step.name in self.claimed for named_step in pending):
            return None
        self.claimed.update(named_step.name for named_step in pending if named_step is not None)
        steps = [named_step.step for named_step in pending if named_step is not None]
        return StepArrays(
            tuple(flat(step.first) for step in steps), tuple(flat(step.second) for step in steps),
            tuple(repeat_rates(step.rate) for step in steps),
            np.array([adam_constants(step.step, *self._options) for step in steps], np.float32),
        )  # fmt: skip


_pending: list[StepsInBackward] = []


@contextmanager
def offer_steps(
    steps: Mapping[str, AdamStep], *, beta1: float, beta2: float, epsilon: float
) -> Iterator[StepsInBackward]:
    """Offer steps: within the context, a backward pass that computes all gradients of a scene may make them.

    steps: by name of the parameter. Yields the offer, whose `claimed` names the steps that were made."""
    offer = StepsInBackward(steps, beta1, beta2, epsilon)
    _pending.append(offer)
    try:
        yield offer
    finally:
        _pending.remove(offer)


def claim_steps(parameters: Sequence[Tensor]) -> StepArrays | None:
    """Return the pending steps of a scene's parameters, which the caller has to make, or None."""
    for offer in _pending:
        if steps := offer.claim(parameters):
            return steps
    return None
