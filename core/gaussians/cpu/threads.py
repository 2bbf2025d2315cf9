# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a kernel on all threads at once.

As many threads as torch uses (`torch.set_num_threads`). They wait on locks between calls and cost nothing
meanwhile; a call takes about 15 microseconds to reach them, less than numba's own pools, which moreover
allow one caller at a time. Kernels share the work out themselves: each takes the next piece from a counter
(`vector.take_number`), and what a piece computes does not depend on who takes it.
"""
from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np
import torch

from . import buffers
from .buffers import Array


class _Scratch(threading.local):
    """Memory of a thread for its kernels, at the start of a cache line: vectors across two take twice the time."""

    def __init__(self) -> None:
        self._array = buffers.empty(1 << 12)

    def __call__(self, size: int) -> Array:
        if self._array.size < size:
            self._array = buffers.empty(size)
        return self._array


_scratch = _Scratch()


class _Worker:
    """A thread that waits for a call, makes it, and waits for the next."""

    def __init__(self, number: int) -> None:
        self._calls: SimpleQueue[tuple[Callable[..., Any], int, tuple[Any, ...]]] = SimpleQueue()
        self._results: SimpleQueue[BaseException | None] = SimpleQueue()
        threading.Thread(target=self._run, name=f"kernels-{number}", daemon=True).start()

    def start(self, function: Callable[..., Any], scratch: int, arguments: tuple[Any, ...]) -> None:
        self._calls.put((function, scratch, arguments))

    def wait(self) -> BaseException | None:
        return self._results.get()

    def _run(self) -> None:
        torch.set_flush_denormal(True)  # a register of the thread
        while True:
            function, scratch, arguments = self._calls.get()
            try:
                _call(function, scratch, arguments)
            except BaseException as error:
                self._results.put(error)
            else:
                self._results.put(None)
            del function, arguments


_idle: list[_Worker] = []


def _call(function: Callable[..., Any], scratch: int, arguments: tuple[Any, ...]) -> None:
    counter, *others = arguments
    function(counter, *([_scratch(scratch)] if scratch else []), *others)


def parallel(function: Callable[..., Any], *arguments: Any, scratch: int = 0, limit: int | None = None) -> None:
    """Calls function(counter, *arguments) on every thread, on at most `limit` of them, and waits for all.

    counter: an int64 array of one element, 0, the same for all threads. scratch: how many float32 of memory
    of its own a thread needs; passed after the counter, unless 0.
    """
    count = torch.get_num_threads() if limit is None else max(1, min(limit, torch.get_num_threads()))
    if not getattr(function, "overloads", True):  # compile here, not on all threads at once
        count = 1
    workers = []
    for number in range(1, count):
        try:
            workers.append(_idle.pop())
        except IndexError:
            workers.append(_Worker(number))
    call = (np.zeros(1, np.int64), *arguments)
    for worker in workers:
        worker.start(function, scratch, call)
    try:
        _call(function, scratch, call)
    finally:
        errors = [worker.wait() for worker in workers]
        _idle.extend(workers)
    for error in errors:
        if error is not None:
            raise error
