# SPDX-License-Identifier: GPL-3.0-or-later
"""A training shared among processes: each learns from its share of an iteration's frames, and all take the same step,
by the sum of their gradients. On a processor this is a good deal faster than threads within one process."""
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

PATIENCE_S = 600.0
"""How long one waits for the others: they may have flares to make."""
PARTING_S = 2.0
"""How long one that is through stays for the first to wake from their last meeting."""

ENDED = ("A process of the training ended before it was through; where memory is short, go on with --resume and fewer "
         "--processes.")


class Table:
    """Where the learners of a machine lay down what they have, for all to see: files that each of them maps.

    Sockets would take more than twice the time of memory that is shared.
    """

    def __init__(self, folder: str, barrier: Barrier) -> None:
        self._folder, self._barrier = folder, barrier
        self._mapped: dict[tuple[int, int], Tensor] = {}

    def rows(self, count: int, length: int) -> Tensor:
        """(count, length) float32, the same memory for all who ask for as many."""
        if (count, length) not in self._mapped:
            path = Path(self._folder) / f"{count}x{length}"
            path.touch()
            with open(path, "r+b") as file:
                # By each of them: what is there stays, and what another has mapped is not made shorter, which Windows
                # refuses.
                if os.fstat(file.fileno()).st_size < 4 * count * length:
                    file.truncate(4 * count * length)
            memory = np.memmap(path, np.float32, "r+", shape=(count, length))
            self._mapped[count, length] = torch.from_numpy(memory)
        return self._mapped[count, length]

    def clear(self) -> None:
        """Let go of the files, which Windows does not delete before."""
        self._mapped.clear()

    def meet(self) -> None:
        """Go on when all are here. Raises RunError when one of them will not come."""
        try:
            self._barrier.wait(PATIENCE_S)
        except threading.BrokenBarrierError as problem:
            raise RunError(ENDED) from problem


@dataclass(frozen=True)
class Learner:
    """One of `count` processes that share a training; the first saves and tells."""

    rank: int
    count: int
    table: Table | None = None

    def add_up(self, tensors: Sequence[Tensor]) -> None:
        """Each becomes the sum of what the learners have, the same to the last bit for all of them. Raises
        RunError."""
        if self.table is None:
            return
        rows = self.table.rows(self.count, sum(tensor.numel() for tensor in tensors))
        for tensor, mine in _parts(tensors, rows[self.rank]):
            mine.copy_(tensor)
        self.table.meet()
        for tensor, part in _parts(tensors, rows[0]):
            tensor.copy_(part)
        for row in rows[1:]:
            for tensor, part in _parts(tensors, row):
                tensor.add_(part)
        self.table.meet()  # before anyone lays down anew

    def makes(self, number: int) -> bool:
        """Whether a piece of work that is to be shared is this one's."""
        return number % self.count == self.rank

    def hand_round(self, tensors: Sequence[Tensor]) -> None:
        """Everyone gets those that another `makes`. Raises RunError."""
        if self.table is None:
            return
        row = self.table.rows(1, sum(tensor.numel() for tensor in tensors))[0]
        for number, (tensor, part) in enumerate(_parts(tensors, row)):
            if self.makes(number):
                part.copy_(tensor)
        self.table.meet()
        for number, (tensor, part) in enumerate(_parts(tensors, row)):
            if not self.makes(number):
                tensor.copy_(part)
        self.table.meet()


ALONE = Learner(0, 1)


def _parts(tensors: Sequence[Tensor], row: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Each tensor, as it lies in memory, and its part of a row."""
    first = 0
    for tensor in tensors:
        lying = tensor.permute(sorted(range(tensor.ndim), key=tensor.stride, reverse=True))
        yield lying, row[first:first + tensor.numel()].view(lying.shape)
        first += tensor.numel()


@contextmanager
def shared(count: int, learn: Callable[..., None], *words: Any) -> Iterator[Learner]:
    """This process as the first of `count`; the others call `learn(learner, *words)` until this one is through.

    What learners do together raises RunError where one of them ends before.
    """
    if count == 1:
        yield ALONE
        return
    spawning = multiprocessing.get_context("spawn")
    threads = torch.get_num_threads()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        barrier = spawning.Barrier(count)
        table = Table(folder, barrier)
        others = [spawning.Process(target=_other, args=(rank, count, folder, barrier, threads, learn, words),
                                   daemon=True)
                  for rank in range(1, count)]
        try:
            for process in others:
                process.start()
            _watch([process.sentinel for process in others], barrier)
            _take_share(threads, count)
            yield Learner(0, count, table)
        finally:
            table.clear()
            end(others)
            torch.set_num_threads(threads)


def end(processes: Iterable[BaseProcess]) -> None:
    """Those that were started."""
    for process in processes:
        if process.pid is not None:
            process.kill()
            process.join()


def begin_process() -> None:
    """Of any process beside the first, that learns or draws: a stop is for the first alone, which ends the others."""
    import cv2

    cv2.setNumThreads(1)
    for number in stop_signals():
        signal.signal(number, signal.SIG_IGN)


def _other(rank: int, count: int, folder: str, barrier: Barrier, threads: int, learn: Callable[..., None],
           words: tuple[Any, ...]) -> None:
    begin_process()
    first = multiprocessing.parent_process()
    if first is not None:
        _watch([first.sentinel], barrier)
    _take_share(threads, count)
    learn(Learner(rank, count, Table(folder, barrier)), *words)
    if first is not None:  # which may not have woken from their last meeting: an end here would break that up
        wait([first.sentinel], PARTING_S)


def _take_share(threads: int, count: int) -> None:
    """Of the processor's threads."""
    torch.set_num_threads(max(threads // count, 1))


def _watch(sentinels: Sequence[int], barrier: Barrier) -> None:
    """Let nobody wait for a process that has ended."""
    def watch() -> None:
        wait(sentinels)
        barrier.abort()

    threading.Thread(target=watch, daemon=True).start()
