# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a kernel on all threads at once.

As many threads as torch uses (`torch.set_num_threads`). Kernels share the work out themselves: each takes the next
piece from a counter (`vector.take_number`), and what a piece computes does not depend on who takes it.

An iteration makes a call every few tenths of a millisecond. To wake a thread that sleeps takes 50 microseconds, since
it then has to wait for the interpreter too. So a worker that is done spins for a moment before it goes to sleep
(`spin`), until the next call's counter moves: then the caller's kernel is running, and the interpreter is free. In the
same way the caller spins until the workers say that they are done.
"""
from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from . import buffers
from .buffers import Array
from .spin import finish_and_spin, spin_until

SPINS = 1 << 14
"""Looks at a number before a thread sleeps: some tenths of a millisecond."""
NAP = 1e-4
"""Seconds that a caller sleeps between two looks at workers that take longer."""


class _Scratch(threading.local):
    """Memory of a thread for its kernels, at the start of a cache line: vectors across two take twice the time."""

    def __init__(self) -> None:
        self._array = buffers.empty(1 << 12)

    def __call__(self, size: int) -> Array:
        if self._array.size < size:
            self._array = buffers.empty(size)
        return self._array


_scratch = _Scratch()
_Call = tuple[Callable[..., Any], int, tuple[Any, ...]]


class _Worker:
    """A thread that waits for a call, makes it, and waits for the next."""

    def __init__(self, counters: Array) -> None:
        self._counters = counters
        self._call: _Call | None = None
        self._number = 0
        self._done = np.zeros(1, np.int64)
        self._error: BaseException | None = None
        self._asleep = False
        self._state = threading.Lock()  # of _call and _asleep
        self._alarm = threading.Semaphore(0)
        threading.Thread(target=self._run, name="kernels", daemon=True).start()

    def start(self, number: int, call: _Call) -> None:
        """Hands call `number` over."""
        self._number = number
        with self._state:
            self._call = call
            asleep, self._asleep = self._asleep, False
        if asleep:
            self._alarm.release()

    def wait(self) -> BaseException | None:
        """Until the call is done; the error that it ended with."""
        while not spin_until(self._done, self._number, SPINS):
            time.sleep(NAP)
        error, self._error = self._error, None
        return error

    def _run(self) -> None:
        torch.set_flush_denormal(True)  # a register of the thread
        while True:
            number = self._number
            finish_and_spin(self._done, number, self._counters[(number + 1) % 2], SPINS)
            with self._state:
                asleep = self._asleep = self._call is None
            if asleep:
                self._alarm.acquire()
            assert self._call is not None
            call, self._call = self._call, None
            try:
                _call(*call)
            except BaseException as error:
                self._error = error
            del call


class _Team:
    """The workers of a caller. Calls have numbers; odd and even ones have a counter each."""

    def __init__(self) -> None:
        self._workers: list[_Worker] = []
        self._number = 0
        self._counters = np.zeros((2, buffers.LINE // 8), np.int64)

    def call(self, function: Callable[..., Any], scratch: int, arguments: tuple[Any, ...], count: int) -> None:
        """On the caller's thread and count - 1 workers."""
        while len(self._workers) < count - 1:
            self._workers.append(_Worker(self._counters))
        self._number += 1
        self._counters[(self._number + 1) % 2] = 0  # workers look at it once they are done with this one
        call = (function, scratch, (self._counters[self._number % 2], *arguments))
        workers = self._workers[: count - 1]
        for worker in workers:
            worker.start(self._number, call)
        try:
            _call(*call)
        finally:
            errors = [worker.wait() for worker in workers]
        for error in errors:
            if error is not None:
                raise error


_idle: list[_Team] = []


def _call(function: Callable[..., Any], scratch: int, arguments: tuple[Any, ...]) -> None:
    counter, *others = arguments
    function(counter, *([_scratch(scratch)] if scratch else []), *others)


def parallel(function: Callable[..., Any], *arguments: Any, scratch: int = 0, limit: int | None = None) -> None:
    """Calls function(counter, *arguments) on every thread, on at most `limit` of them, and waits for all.

    counter: an int64 array whose first element is 0 at first, the same for all threads. scratch: how many float32 of
    memory of its own a thread needs; passed after the counter, unless 0.
    """
    count = torch.get_num_threads() if limit is None else max(1, min(limit, torch.get_num_threads()))
    if not getattr(function, "overloads", True):  # compile here, not on all threads at once
        count = 1
    try:
        team = _idle.pop()
    except IndexError:
        team = _Team()
    try:
        team.call(function, scratch, arguments, count)
    finally:
        _idle.append(team)
