# SPDX-License-Identifier: GPL-3.0-or-later
"""A training shared among processes: each learns from its share of an iteration's frames, and all take the same step,
by the sum of their gradients. On a processor this is a good deal faster than threads within one process."""
from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from ..errors import RunError
from ..progress import stop_signals

LOOPBACK = {"linux": "lo", "darwin": "lo0"}
"""Name of the interface that reaches this machine alone."""
PATIENCE = timedelta(minutes=10)
"""How long one waits for the others: they may have flares to make."""

ENDED = ("A process of the training ended before it was through; where memory is short, go on with --resume and fewer "
         "--processes.")


@dataclass(frozen=True)
class Learner:
    """One of `count` processes that share a training; the first saves and tells."""

    rank: int
    count: int


ALONE = Learner(0, 1)


@contextmanager
def shared(count: int, learn: Callable[..., None], *words: Any) -> Iterator[Learner]:
    """This process as the first of `count`; the others call `learn(learner, *words)` until this one is through.

    Raises RunError where one of them ends before.
    """
    if count == 1:
        yield ALONE
        return
    spawning = multiprocessing.get_context("spawn")
    first, threads = Learner(0, count), torch.get_num_threads()
    with tempfile.TemporaryDirectory() as folder:
        store = str(Path(folder) / "store")
        begun = [spawning.Event() for _ in range(1, count)]
        others = [spawning.Process(target=_other, args=(Learner(rank, count), store, event, threads, learn, words),
                                   daemon=True)
                  for rank, event in enumerate(begun, 1)]
        try:
            for process in others:
                process.start()
            for process, event in zip(others, begun, strict=True):
                while not event.wait(0.2):
                    if not process.is_alive():
                        raise RunError(ENDED)
            _join(first, store, threads)
            yield first
        except RuntimeError as problem:  # the connection is lost, if it is that
            for process in others:
                process.join(1)
            if all(process.is_alive() for process in others):
                raise
            raise RunError(ENDED) from problem
        finally:
            for process in others:
                if process.pid is not None:  # it was started
                    process.kill()
                    process.join()
            if dist.is_initialized():
                dist.destroy_process_group()
            torch.set_num_threads(threads)


def add_up(tensors: Sequence[Tensor]) -> None:
    """Each becomes the sum of what the learners have, the same to the last bit for all of them."""
    flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
    dist.all_reduce(flat)
    for tensor, part in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
        tensor.copy_(part.view(tensor.shape))


def begin_process(_number: int = 0) -> None:
    """Of any process beside the first, that learns or draws: a stop is for the first alone, which ends the others."""
    import cv2

    cv2.setNumThreads(1)
    for number in stop_signals():
        signal.signal(number, signal.SIG_IGN)


def _other(learner: Learner, store: str, begun: Event, threads: int, learn: Callable[..., None],
           words: tuple[Any, ...]) -> None:
    begin_process()
    begun.set()
    _join(learner, store, threads)
    learn(learner, *words)


def _join(learner: Learner, store: str, threads: int) -> None:
    torch.set_num_threads(max(threads // learner.count, 1))
    if sys.platform in LOOPBACK:
        os.environ.setdefault("GLOO_SOCKET_IFNAME", LOOPBACK[sys.platform])
    dist.init_process_group("gloo", store=dist.FileStore(store, learner.count),  # type: ignore[attr-defined]
                            rank=learner.rank, world_size=learner.count, timeout=PATIENCE)
