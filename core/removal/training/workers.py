# SPDX-License-Identifier: GPL-3.0-or-later
"""Workers: processes that share a training on one machine. Each computes the gradients of its share of an iteration's
frames, and all take the same step with their sum.

On a CPU this is a good deal faster than threads within one process. `run.train` starts them.
"""
from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...errors import RunError
from ...system.progress import stop_signals

BARRIER_TIMEOUT_S = 600.0
"""How long a worker waits for the others, which may have flares to synthesise."""
EXIT_GRACE_S = 2.0
"""How long a finished worker stays, so that the first can leave their last barrier."""

WORKER_ENDED = ("A process of the training ended too early; if memory is short, run it again with --resume and fewer "
                "--processes.")


class SharedBuffers:
    """Buffers in files that every worker maps. Sockets would take more than twice the time."""

    def __init__(self, folder: str, barrier: Barrier) -> None:
        self._folder, self._barrier = folder, barrier
        self._mapped: dict[tuple[int, int], Tensor] = {}

    def shared_rows(self, count: int, length: int) -> Tensor:
        """Return a (count, length) float32 tensor in memory that all workers share. Later calls with the same arguments
        return the same tensor with its content."""
        if (count, length) not in self._mapped:
            path = Path(self._folder) / f"{count}x{length}"
            path.touch()
            with open(path, "r+b") as file:
                # Every worker runs this. Only lengthen the file: Windows refuses to truncate one that is mapped.
                if os.fstat(file.fileno()).st_size < 4 * count * length:
                    file.truncate(4 * count * length)
            memory = np.memmap(path, np.float32, "r+", shape=(count, length))
            self._mapped[count, length] = torch.from_numpy(memory)
        return self._mapped[count, length]

    def clear(self) -> None:
        """Release the mappings; Windows does not delete a mapped file."""
        self._mapped.clear()

    def wait(self) -> None:
        """Wait until all workers are here. Raises RunError if one of them has ended."""
        try:
            self._barrier.wait(BARRIER_TIMEOUT_S)
        except threading.BrokenBarrierError as problem:
            raise RunError(WORKER_ENDED) from problem


@dataclass(frozen=True)
class Worker:
    """One of `count` processes that share a training; the first, of rank 0, saves and reports. buffers: None for a
    worker that is alone."""

    rank: int
    count: int
    buffers: SharedBuffers | None = None

    def all_reduce(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by the sum over all workers, identical to the last bit in each. Raises RunError."""
        if self.buffers is None:
            return
        rows = self.buffers.shared_rows(self.count, sum(tensor.numel() for tensor in tensors))
        for tensor, buffer in _buffer_slices(tensors, rows[self.rank]):
            buffer.copy_(tensor)
        self.buffers.wait()
        # All add the rows in the same order, so that rounding is the same too.
        for tensor, part in _buffer_slices(tensors, rows[0]):
            tensor.copy_(part)
        for row in rows[1:]:
            for tensor, part in _buffer_slices(tensors, row):
                tensor.add_(part)
        self.buffers.wait()  # all have read the rows, so the next call may write them

    def is_responsible_for(self, number: int) -> bool:
        """Return whether this worker does piece `number` of shared work."""
        return number % self.count == self.rank

    def all_gather(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by the values of the worker that is responsible for its index in `tensors`
        (`is_responsible_for`). Raises RunError."""
        if self.buffers is None:
            return
        row = self.buffers.shared_rows(1, sum(tensor.numel() for tensor in tensors))[0]
        for number, (tensor, part) in enumerate(_buffer_slices(tensors, row)):
            if self.is_responsible_for(number):
                part.copy_(tensor)
        self.buffers.wait()
        for number, (tensor, part) in enumerate(_buffer_slices(tensors, row)):
            if not self.is_responsible_for(number):
                tensor.copy_(part)
        self.buffers.wait()


SINGLE_WORKER = Worker(0, 1)


def _buffer_slices(tensors: Sequence[Tensor], row: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield (tensor, its slice of the buffer `row`) for each tensor, with dimensions in memory order, so that copies
    are contiguous."""
    first = 0
    for tensor in tensors:
        in_memory_order = tensor.permute(sorted(range(tensor.ndim), key=tensor.stride, reverse=True))
        yield in_memory_order, row[first:first + tensor.numel()].view(in_memory_order.shape)
        first += tensor.numel()


@contextmanager
def worker_group(count: int, run_worker: Callable[..., None], *args: Any) -> Iterator[Worker]:
    """Yield this process's worker, the first of `count`. The others, in new processes, call `run_worker(worker, *args)`
    and are killed when the context ends. Collective operations raise RunError where a worker has ended."""
    if count == 1:
        yield SINGLE_WORKER
        return
    spawning = multiprocessing.get_context("spawn")
    threads = torch.get_num_threads()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        barrier = spawning.Barrier(count)
        buffers = SharedBuffers(folder, barrier)
        others = [spawning.Process(target=_worker_main, args=(rank, count, folder, barrier, threads, run_worker, args),
                                   daemon=True)
                  for rank in range(1, count)]
        try:
            for process in others:
                process.start()
            _abort_when_any_ends([process.sentinel for process in others], barrier)
            _limit_threads(threads, count)
            yield Worker(0, count, buffers)
        finally:
            buffers.clear()
            kill_processes(others)
            torch.set_num_threads(threads)


def kill_processes(processes: Iterable[BaseProcess]) -> None:
    """Kill those processes that were started."""
    for process in processes:
        if process.pid is not None:
            process.kill()
            process.join()


def initialise_process() -> None:
    """Prepare a child process that trains or draws: one OpenCV thread, and signals to stop are ignored, since the first
    process ends the others."""
    import cv2

    cv2.setNumThreads(1)
    for number in stop_signals():
        signal.signal(number, signal.SIG_IGN)


def _worker_main(rank: int, count: int, folder: str, barrier: Barrier, threads: int, run_worker: Callable[..., None],
                 args: tuple[Any, ...]) -> None:
    """Run a worker in a process of its own, until it or the first worker ends; the target of `worker_group`."""
    initialise_process()
    first = multiprocessing.parent_process()
    if first is not None:
        _abort_when_any_ends([first.sentinel], barrier)
    _limit_threads(threads, count)
    run_worker(Worker(rank, count, SharedBuffers(folder, barrier)), *args)
    if first is not None:  # the first worker may still be in the last barrier, which an exit here would break
        wait([first.sentinel], EXIT_GRACE_S)


def _limit_threads(threads: int, count: int) -> None:
    """Give this worker its share of the CPU's threads. threads: of all `count` workers together."""
    torch.set_num_threads(max(threads // count, 1))


def _abort_when_any_ends(sentinels: Sequence[int], barrier: Barrier) -> None:
    """Break the barrier as soon as a process has ended, so that nobody waits for it."""
    def watch() -> None:
        wait(sentinels)
        barrier.abort()

    threading.Thread(target=watch, daemon=True).start()
