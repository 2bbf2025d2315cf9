# SPDX-License-Identifier: GPL-3.0-or-later
"""Work on a card that is recorded once for each shape of its input, and then given to it whole: the thousands of small
pieces that a network's gradients are made of keep a processor longer than they do a card. And what comes of it, without
waiting for it."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

REHEARSALS = 3
"""Of a piece of work before it is recorded, in which libraries choose how to do it and lay out what they need."""


class _Recording(NamedTuple):
    graph: torch.cuda.CUDAGraph
    given: list[Tensor]
    results: list[Tensor]


class Recorded:
    """Work on tensors of a card, as it was when first done on inputs of their shapes: what it reads and writes besides
    stays where it lay then. On a processor it is merely done."""

    def __init__(self, work: Callable[..., Sequence[Tensor]]) -> None:
        self._work = work
        self._recordings: dict[tuple[torch.Size, ...], _Recording] = {}

    def __call__(self, *given: Tensor) -> list[Tensor]:
        """What the work gives, until the next call."""
        if not given[0].is_cuda:
            return list(self._work(*given))
        shapes = tuple(one.shape for one in given)
        if shapes not in self._recordings:
            self._recordings[shapes] = self._record([one.clone() for one in given])
        graph, places, results = self._recordings[shapes]
        for place, one in zip(places, given, strict=True):
            place.copy_(one)
        graph.replay()
        return results

    def _record(self, given: list[Tensor]) -> _Recording:
        beside = torch.cuda.Stream(given[0].device)
        beside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(beside):
            for _ in range(REHEARSALS):
                self._work(*given)
        torch.cuda.current_stream().wait_stream(beside)
        graph = torch.cuda.CUDAGraph()
        pool = next(iter(self._recordings.values())).graph.pool() if self._recordings else None
        # Other threads go on with copies of their own.
        with torch.cuda.graph(graph, pool=pool, capture_error_mode="thread_local"):
            results = list(self._work(*given))
        return _Recording(graph, given, results)


class OnItsWay:
    """Numbers that a card sends without being waited for."""

    def __init__(self, numbers: Tensor) -> None:
        self._there, self._here = torch.cuda.Event(), torch.empty(numbers.shape, pin_memory=True)
        self._here.copy_(numbers, non_blocking=True)
        self._there.record()

    def arrived(self) -> list[float]:
        """When they have."""
        self._there.synchronize()
        return [float(number) for number in self._here]
