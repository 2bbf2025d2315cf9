# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training sees: the pictures of each iteration, a function of recipe and iteration, drawn ahead."""
from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from .backgrounds import Backgrounds
from .bank import Mixed, OwnFlares, SynthesisBank
from .pairs import Bank, Pair, pair
from .recipe import Recipe
from .synthesis.prescription import Prescription

AHEAD = 16
"""Iterations that each process draws ahead, so that one that draws new flares holds nobody up."""
MOST_PROCESSES = 8


class Batch(NamedTuple):
    """Frames, scenes and gentle pictures (n, height, width, 3), float32, display values 0..1."""

    frame: NDArray[np.float32]
    scene: NDArray[np.float32]
    gentle: NDArray[np.float32]


class Batches(Dataset[Batch]):
    """The batch of every iteration, under the flares that are at hand then."""

    def __init__(self, recipe: Recipe, backgrounds: Backgrounds, lenses: Sequence[Prescription],
                 own: OwnFlares | None = None) -> None:
        self._recipe, self._backgrounds = recipe, backgrounds
        self._made = SynthesisBank(recipe.seed, recipe.bank, recipe.canvas, lenses)
        self._bank: Bank = Mixed(self._made, own, recipe.own_share) if own else self._made

    def __getitem__(self, iteration: int) -> Batch:
        random = np.random.default_rng((self._recipe.seed, iteration))
        pairs = self.pairs(random, iteration, *self._recipe.frames(random, iteration))
        return Batch(*(np.stack(part) for part in zip(*((one.frame, one.scene, one.gentle) for one in pairs),
                                                      strict=True)))

    def pairs(self, random: np.random.Generator, iteration: int, count: int, width: int, height: int) -> list[Pair]:
        """So many of that size."""
        self._made.renew_to(self._recipe.bank + iteration // self._recipe.renew_every)
        return [pair(random, self._bank, self._backgrounds, width, height, clean=self._recipe.clean)
                for _ in range(count)]


def drawn_ahead(batches: Batches, first: int, end: int, processes: int) -> Iterator[Batch]:
    """The batches of iterations first..end-1 in order, drawn by other processes while the network learns; by this
    one where there are none. They are the same in any case."""
    loader = DataLoader(batches, batch_size=None, sampler=range(first, end), num_workers=processes,
                        prefetch_factor=AHEAD if processes else None,
                        collate_fn=_as_they_are,  # type: ignore[arg-type]  # of single samples, with batch_size=None
                        worker_init_fn=_begin_process,
                        multiprocessing_context="spawn" if processes else None)  # OpenCV's threads survive no fork
    return iter(loader)


def processes_here() -> int:
    """One keeps the network of a processor busy; a graphics card learns faster than one draws."""
    others = (os.cpu_count() or 1) - 1
    return min(others, MOST_PROCESSES if torch.cuda.is_available() else 1)


def _as_they_are(batch: Batch) -> Batch:
    """Not as tensors, which would be sent through shared memory: containers often have little of it."""
    return batch


def _begin_process(_process: int) -> None:
    """A stop is for the training, which ends its processes; pictures are drawn on one thread each."""
    import cv2

    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
