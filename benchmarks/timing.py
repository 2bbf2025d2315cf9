# SPDX-License-Identifier: GPL-3.0-or-later
"""Side-by-side timing: the cases take turns, so that other load affects all of them alike."""
from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import torch

MAX_CASE_SECONDS = 0.25
"""Seconds that the repetitions of a short case take in each turn, at most."""


def time_once(work: Callable[[], object]) -> float:
    """Return the seconds of one call, including its work on a GPU."""
    start = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start


def median_times(cases: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Return the median seconds of each case over rounds in which the cases take turns, after a warm-up call.

    A short case is repeated in each turn: up to 30 times, for about MAX_CASE_SECONDS.
    """
    samples: dict[str, list[float]] = {name: [] for name in cases}
    repeats = {}
    for name, work in cases.items():
        time_once(work)
        repeats[name] = max(1, min(30, int(MAX_CASE_SECONDS / time_once(work))))
    for _ in range(rounds):
        for name, work in cases.items():
            samples[name] += [time_once(work) for _ in range(repeats[name])]
    return {name: statistics.median(values) for name, values in samples.items()}


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Run the body with this number of threads of torch, which the kernels use too."""
    previous = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(previous)


def on_threads(count: int, work: Callable[[], object]) -> Callable[[], object]:
    """Return a function that does the work with this number of threads of torch."""

    def run() -> None:
        with torch_threads(count):
            work()

    return run
