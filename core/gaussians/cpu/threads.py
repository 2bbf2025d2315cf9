# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a kernel on all threads at once.

The number of threads is torch's (`torch.set_num_threads`). Kernels distribute the work themselves: each thread takes
the next task from a counter (`vector.atomic_increment`), and the result of a task does not depend on the thread.

An iteration makes a call every few tenths of a millisecond. Waking a sleeping thread takes 50 microseconds, since it
has to wait for the interpreter's lock too. So a finished worker spins for a moment before it sleeps (`spin`), until the
next call's counter changes: then the caller's kernel is running, and the interpreter's lock is free. In the same way
the caller spins until the workers are done.
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

MAX_SPINS = 1 << 14
"""Reads of a counter before a thread sleeps: some tenths of a millisecond."""
POLL_SECONDS = 1e-4
"""Seconds that a caller sleeps between checks of workers that take longer."""


class _Scratch(threading.local):
    """A thread's workspace for kernels, aligned to a cache line: vectors across two lines take twice the time."""

    def __init__(self) -> None:
        self._array = buffers.empty(1 << 12)

    def __call__(self, size: int) -> Array:
        if self._array.size < size:
            self._array = buffers.empty(size)
        return self._array


_scratch = _Scratch()
_Call = tuple[Callable[..., Any], int, tuple[Any, ...]]
"""Function, size of its workspace (0 for none), and arguments: those of `_run_call`."""


class _Worker:
    """A thread that waits for calls and makes them."""

    def __init__(self, counters: Array) -> None:
        """Start a thread that waits for calls. counters (2, ...): the pool's two task counters, the first number of
        each row."""
        self._counters = counters
        self._call: _Call | None = None
        self._call_number = 0  # of the latest call
        self._done = np.zeros(1, np.int64)  # number of the latest call that is done; the caller spins on it
        self._error: BaseException | None = None
        self._is_asleep = False
        self._lock = threading.Lock()  # guards _call and _is_asleep
        self._wakeup = threading.Semaphore(0)
        threading.Thread(target=self._run, name="kernels", daemon=True).start()

    def start(self, number: int, call: _Call) -> None:
        """Pass call `number` to the thread."""
        self._call_number = number
        with self._lock:
            self._call = call
            was_asleep, self._is_asleep = self._is_asleep, False
        if was_asleep:
            self._wakeup.release()

    def wait(self) -> BaseException | None:
        """Wait until the call is done; return the error it raised, or None."""
        while not spin_until(self._done, self._call_number, MAX_SPINS):
            time.sleep(POLL_SECONDS)
        error, self._error = self._error, None
        return error

    def _run(self) -> None:
        """Make one call after the other, for ever; between them spin for a moment, then sleep."""
        torch.set_flush_denormal(True)  # the setting lies in a register of each thread
        while True:
            number = self._call_number
            finish_and_spin(self._done, number, self._counters[(number + 1) % 2], MAX_SPINS)
            with self._lock:
                is_asleep = self._is_asleep = self._call is None
            if is_asleep:
                self._wakeup.acquire()
            assert self._call is not None
            call, self._call = self._call, None
            try:
                _run_call(*call)
            except BaseException as error:
                self._error = error
            del call  # frees its arrays before the thread waits


class _ThreadPool:
    """The workers of one caller. Calls are numbered; odd and even ones alternate between two counters."""

    def __init__(self) -> None:
        self._workers: list[_Worker] = []
        self._call_number = 0
        self._counters = np.zeros((2, buffers.CACHE_LINE // 8), np.int64)

    def call(
        self, function: Callable[..., Any], scratch_size: int, arguments: tuple[Any, ...], thread_count: int
    ) -> None:
        """Call function(counter, [workspace,] *arguments) on the caller's thread and on thread_count - 1 workers, and
        wait; raise the first error.

        scratch_size: numbers of a thread's workspace, 0 for none."""
        while len(self._workers) < thread_count - 1:
            self._workers.append(_Worker(self._counters))
        self._call_number += 1
        self._counters[(self._call_number + 1) % 2] = 0  # workers read it once they have finished this call
        call = (function, scratch_size, (self._counters[self._call_number % 2], *arguments))
        workers = self._workers[: thread_count - 1]
        for worker in workers:
            worker.start(self._call_number, call)
        try:
            _run_call(*call)
        finally:
            errors = [worker.wait() for worker in workers]
        for error in errors:
            if error is not None:
                raise error


_idle_pools: list[_ThreadPool] = []
"""Pools that no call uses at the moment; each of several callers at a time takes one."""


def _run_call(function: Callable[..., Any], scratch_size: int, arguments: tuple[Any, ...]) -> None:
    counter, *kernel_arguments = arguments
    function(counter, *([_scratch(scratch_size)] if scratch_size else []), *kernel_arguments)


def parallel(function: Callable[..., Any], *arguments: Any, scratch: int = 0, limit: int | None = None) -> None:
    """Call function(counter, [workspace,] *arguments) on every thread, at most `limit` of them, and wait for all.

    counter: an int64 array shared by all threads, whose first element starts at 0. scratch: number of float32 values of
    workspace for each thread, passed after the counter unless 0. Raises the first error of any thread.
    """
    thread_count = torch.get_num_threads() if limit is None else max(1, min(limit, torch.get_num_threads()))
    if not getattr(function, "overloads", True):  # not compiled yet: one thread compiles and runs it
        thread_count = 1
    try:
        pool = _idle_pools.pop()
    except IndexError:
        pool = _ThreadPool()
    try:
        pool.call(function, scratch, arguments, thread_count)
    finally:
        _idle_pools.append(pool)
