# SPDX-License-Identifier: GPL-3.0-or-later
"""Steps of Adam that a scene's backward pass takes.

Its gradients come from the projection's backward pass, some Gaussians at a time. Steps that are on offer are taken
there and then, while the gradients are in the cache, so that those are neither written to memory nor read again.
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from torch import Tensor

from .buffers import Array
from .optimiser import CONSTANTS, Step, constants_for, rates_of
from .tiles import EMPTY, flat


class Moves(NamedTuple):
    """Steps of some parameters, as kernels take them: flat arrays, and the numbers of `constants_of` by rows."""

    first: tuple[Array, ...]
    second: tuple[Array, ...]
    rates: tuple[Array, ...]
    constants: Array


_NOTHING = (EMPTY,) * 5  # means, quaternions, scales, opacities, harmonics
NO_MOVES = Moves(_NOTHING, _NOTHING, _NOTHING, np.empty((len(_NOTHING), CONSTANTS), np.float32))
"""For a backward pass that writes a scene's gradients."""


class Offers:
    """Steps that a backward pass may take in place of writing the gradients."""

    def __init__(self, steps: Mapping[str, Step], beta1: float, beta2: float, epsilon: float) -> None:
        self._steps = {id(step.parameter): (name, step) for name, step in steps.items()}
        self._options = (beta1, beta2, epsilon)
        self.taken: set[str] = set()

    def take(self, parameters: Sequence[Tensor]) -> Moves | None:
        """The steps of these parameters, now the caller's to take; None unless all are on offer."""
        found = [self._steps.get(id(parameter)) for parameter in parameters]
        if any(entry is None or entry[0] in self.taken for entry in found):
            return None
        self.taken.update(entry[0] for entry in found if entry is not None)
        steps = [entry[1] for entry in found if entry is not None]
        return Moves(
            tuple(flat(step.first) for step in steps), tuple(flat(step.second) for step in steps),
            tuple(rates_of(step.rate) for step in steps),
            np.array([constants_for(step.step, *self._options) for step in steps], np.float32),
        )  # fmt: skip


_offers: list[Offers] = []


@contextmanager
def offered(steps: Mapping[str, Step], *, beta1: float, beta2: float, epsilon: float) -> Iterator[Offers]:
    """Within it, a backward pass that finds all gradients of a scene may take the steps."""
    offers = Offers(steps, beta1, beta2, epsilon)
    _offers.append(offers)
    try:
        yield offers
    finally:
        _offers.remove(offers)


def take_offers(parameters: Sequence[Tensor]) -> Moves | None:
    """The steps of a scene's parameters if they are on offer, to be taken by the caller."""
    for offers in _offers:
        if moves := offers.take(parameters):
            return moves
    return None
