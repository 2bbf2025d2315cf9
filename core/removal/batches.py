# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training sees: the pictures of each iteration, a function of recipe and iteration; for a learner its share,
beside a graphics card drawn ahead."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from .backgrounds import Backgrounds
from .bank import Mixed, OwnFlares, SynthesisBank
from .learners import ALONE, Learner, begin_process
from .pairs import Bank, Pair, of_one_channel, pair
from .recipe import Recipe
from .synthesis.prescription import Prescription

AHEAD = 16
"""Iterations that each process draws ahead, so that one that draws new flares holds nobody up."""
TURNS = 16
"""Iterations after one another draw from as many parts of the bank of flares, in turn. Processes that draw ahead take
turns too: where they are a part of as many, each makes no flares but those that it draws from."""


class Batch(NamedTuple):
    """Frames, scenes and gentle pictures (n, height, width, 3), display values 0..1, float32, and float16 where they
    were drawn ahead; which share they are of all that an iteration has."""

    frame: NDArray[Any]
    scene: NDArray[Any]
    gentle: NDArray[Any]
    share: float


class Batches(Dataset[Batch]):
    """The batch of every iteration, under the flares that are at hand then; of several learners that of `learner`.

    Each frame is a function of the recipe, the iteration and its number in it: together the learners have the same
    frames, however many they are.
    """

    def __init__(self, recipe: Recipe, backgrounds: Backgrounds, lenses: Sequence[Prescription],
                 own: OwnFlares | None = None, learner: Learner = ALONE) -> None:
        self._recipe, self._backgrounds, self._learner = recipe, backgrounds, learner
        self._made = SynthesisBank(recipe.seed, recipe.bank, recipe.canvas, lenses, recipe.coloured,
                                    recipe.aspheric, TURNS)
        self._bank: Bank = Mixed(self._made, own, recipe.own_share) if own else self._made

    def __getitem__(self, iteration: int) -> Batch:
        count, width, height = self._recipe.frames(np.random.default_rng((self._recipe.seed, iteration)), iteration)
        mine = [self.pair(iteration, number, width, height)
                for number in range(self._learner.rank, count, self._learner.count)]
        none = np.zeros((0, height, width, 3), np.float32)
        frame, scene, gentle = (np.stack([getattr(one, part) for one in mine]) if mine else none
                                for part in ("frame", "scene", "gentle"))
        return Batch(frame, scene, gentle, len(mine) / count)

    def pair(self, iteration: int, number: int, width: int, height: int) -> Pair:
        """A frame of an iteration, of that size."""
        self._made.renew_to(self._recipe.bank + iteration // self._recipe.renew_every, iteration)
        random = np.random.default_rng((self._recipe.seed, iteration, number + 1))  # to numpy, (1, 2) is (1, 2, 0)
        one = pair(random, self._bank, self._backgrounds, width, height, clean=self._recipe.clean,
                   against_light=self._recipe.against_light, shoulder=self._recipe.shoulder, lamps=self._recipe.lamps)
        return of_one_channel(one, int(random.integers(3))) if random.random() < self._recipe.grey else one


def drawn_ahead(batches: Batches, first: int, end: int, processes: int) -> Iterator[Batch]:
    """The batches of iterations first..end-1 in order, drawn by other processes while the network learns; by this
    one where there are none. They are the same in any case, but for the precision in which others send them."""
    loader = DataLoader(batches, batch_size=None, sampler=range(first, end), num_workers=processes,
                        prefetch_factor=AHEAD if processes else None,
                        # of single samples, with batch_size=None
                        collate_fn=_to_send if processes else _as_they_are,  # type: ignore[arg-type]
                        pin_memory=processes > 0 and torch.cuda.is_available(),  # by a thread, which also receives
                        worker_init_fn=begin_process,
                        multiprocessing_context="spawn" if processes else None)  # OpenCV's threads survive no fork
    return iter(loader)


def _as_they_are(batch: Batch) -> Batch:
    """Not as tensors, which would be sent through shared memory: containers often have little of it."""
    return batch


def _to_send(batch: Batch) -> Batch:
    """Half as much, by torch, which takes a tenth of numpy's time; its steps of 0.0005 are not seen."""
    frame, scene, gentle = (torch.from_numpy(part).half().numpy() for part in batch[:3])
    return Batch(frame, scene, gentle, batch.share)
