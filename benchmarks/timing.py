# SPDX-License-Identifier: GPL-3.0-or-later
"""Side-by-side timing: what is compared takes turns, so that all of it meets the same weather."""
from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import torch

PATIENCE = 0.25
"""Seconds that a case may take at each turn, if it is short enough to be repeated."""


def once(work: Callable[[], object]) -> float:
    """Seconds of one call, with what it started on a GPU."""
    start = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start


def medians(cases: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each case over rounds in which each has its turn; a first call goes before."""
    samples: dict[str, list[float]] = {name: [] for name in cases}
    repeats = {}
    for name, work in cases.items():
        once(work)
        repeats[name] = max(1, min(30, int(PATIENCE / once(work))))
    for _ in range(rounds):
        for name, work in cases.items():
            samples[name] += [once(work) for _ in range(repeats[name])]
    return {name: statistics.median(values) for name, values in samples.items()}


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Runs the body on this many threads of torch, and of the kernels that follow it."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def on_threads(count: int, work: Callable[[], object]) -> Callable[[], object]:
    """The same work on this many threads."""

    def run() -> None:
        with threads(count):
            work()

    return run
