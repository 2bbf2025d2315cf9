# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam steps fused into a scene's backward pass.

The projection's backward pass computes the gradients of some Gaussians at a time. Pending steps are made right there,
while the gradients are in the cache, so that these are neither written to memory nor read again. `..optimiser.Adam`
registers the steps (`offer_steps`); `scene` claims them (`claim_steps`). An operation whose backward pass runs before
that of `scene` adds its gradients to the steps (`add_gradients`).
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
    (`unpack_constants`); added: gradients that are added to the kernel's, empty for none."""

    first: tuple[Array, ...]
    second: tuple[Array, ...]
    rates: tuple[Array, ...]
    constants: Array
    added: tuple[Array, ...]


_EMPTY_ARRAYS = (EMPTY,) * 5  # means, quaternions, scales, opacities, harmonics
NO_STEPS = StepArrays(
    _EMPTY_ARRAYS, _EMPTY_ARRAYS, _EMPTY_ARRAYS, np.empty((len(_EMPTY_ARRAYS), NUM_CONSTANTS), np.float32),
    _EMPTY_ARRAYS,
)  # fmt: skip
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
        self._added: dict[str, Tensor] = {}
        self.claimed: set[str] = set()

    def add(self, parameters: Sequence[Tensor], gradients: Sequence[Tensor]) -> bool:
        """Add gradients to the steps of these parameters; False, without effect, unless all are pending."""
        pending = [self._steps.get(id(parameter)) for parameter in parameters]
        if any(named_step is None or named_step.name in self.claimed for named_step in pending):
            return False
        for named_step, gradient in zip(pending, gradients, strict=True):
            assert named_step is not None
            before = self._added.get(named_step.name)
            self._added[named_step.name] = gradient if before is None else before + gradient
        return True

    def return_added(self) -> None:
        """Accumulate the added gradients of steps that were not claimed in the parameters, as autograd does."""
        for name, step in self._steps.values():
            gradient = self._added.pop(name, None)
            if gradient is not None and name not in self.claimed:
                before = step.parameter.grad
                step.parameter.grad = gradient if before is None else before + gradient

    def claim(self, parameters: Sequence[Tensor]) -> StepArrays | None:
        """Return the steps of these parameters, which the caller then has to make, and note them in `claimed`; None
        unless all are pending."""
        pending = [self._steps.get(id(parameter)) for parameter in parameters]
        if any(named_step is None or named_step.name in self.claimed for named_step in pending):
            return None
        names = [named_step.name for named_step in pending if named_step is not None]
        steps = [named_step.step for named_step in pending if named_step is not None]
        self.claimed.update(names)
        return StepArrays(
            tuple(flat(step.first) for step in steps), tuple(flat(step.second) for step in steps),
            tuple(repeat_rates(step.rate) for step in steps),
            np.array([adam_constants(step.step, *self._options) for step in steps], np.float32),
            tuple(flat(self._added[name]) if name in self._added else EMPTY for name in names),
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
        offer.return_added()
    finally:
        _pending.remove(offer)


def claim_steps(parameters: Sequence[Tensor]) -> StepArrays | None:
    """Return the pending steps of a scene's parameters, which the caller has to make, or None."""
    for offer in _pending:
        if steps := offer.claim(parameters):
            return steps
    return None


def add_gradients(parameters: Sequence[Tensor], gradients: Sequence[Tensor]) -> bool:
    """Add gradients to pending steps of these parameters; return False, without effect, if there are none."""
    return any(offer.add(parameters, gradients) for offer in _pending)
