# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training sees: the pictures of each iteration, a function of recipe and iteration; for a learner its share,
beside a graphics card drawn ahead.

A drawing is what `Batches` make at a time: the frames of an iteration, or of several, which see them in different
looks.
"""
from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from itertools import permutations
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
"""Drawings that each process has ready, so that one that draws new flares holds nobody up."""
LAG = 8
"""Drawings that lie between uses of the same one."""
TURNS = 16
"""Drawings after one another are made from as many parts of the bank of flares, in turn. Processes that draw ahead take
turns too: where they are a part of as many, each makes no flares but those that it draws from."""


class Batch(NamedTuple):
    """Frames, scenes and gentle pictures (n, height, width, 3), display values 0..1, float32, and float16 where they
    were drawn ahead; which share they are of all that an iteration has; as which of LOOKS they are to be shown."""

    frame: NDArray[Any]
    scene: NDArray[Any]
    gentle: NDArray[Any]
    share: float
    look: int = 0


class Look(NamedTuple):
    """Another picture of the same: left and right exchanged, or the channels."""

    mirrored: bool
    channels: tuple[int, ...]


LOOKS = tuple(Look(mirrored, channels) for channels in permutations(range(3)) for mirrored in (False, True))
"""The picture itself, then the same mirrored, then both in other colours."""


class Batches(Dataset[Batch]):
    """What is drawn for each iteration, or for as many as the recipe `repeats`, under the flares that are at hand then;
    of several learners that of `learner`.

    Each frame is a function of the recipe, the drawing and its number in it: together the learners have the same
    frames, however many they are.
    """

    def __init__(self, recipe: Recipe, backgrounds: Backgrounds, lenses: Sequence[Prescription],
                 own: OwnFlares | None = None, learner: Learner = ALONE) -> None:
        self.recipe, self._backgrounds, self._learner = recipe, backgrounds, learner
        self._made = SynthesisBank(recipe.seed, recipe.bank, recipe.canvas, lenses, recipe.coloured,
                                    recipe.aspheric, TURNS)
        self._bank: Bank = Mixed(self._made, own, recipe.own_share) if own else self._made

    def __getitem__(self, drawing: int) -> Batch:
        count, width, height = self.recipe.frames(np.random.default_rng((self.recipe.seed, drawing)),
                                                  drawing * self.recipe.repeats)
        mine = [self.pair(drawing, number, width, height)
                for number in range(self._learner.rank, count, self._learner.count)]
        none = np.zeros((0, height, width, 3), np.float32)
        frame, scene, gentle = (np.stack([getattr(one, part) for one in mine]) if mine else none
                                for part in ("frame", "scene", "gentle"))
        return Batch(frame, scene, gentle, len(mine) / count)

    def pair(self, drawing: int, number: int, width: int, height: int) -> Pair:
        """A frame of a drawing, of that size."""
        self._made.renew_to(self.recipe.bank + drawing // self.recipe.renew_every, drawing)
        random = np.random.default_rng((self.recipe.seed, drawing, number + 1))  # to numpy, (1, 2) is (1, 2, 0)
        one = pair(random, self._bank, self._backgrounds, width, height, clean=self.recipe.clean,
                   against_light=self.recipe.against_light, shoulder=self.recipe.shoulder)
        return of_one_channel(one, int(random.integers(3))) if random.random() < self.recipe.grey else one


def drawn_ahead(batches: Batches, first: int, end: int, processes: int) -> Iterator[Batch]:
    """The batches of iterations first..end-1 in order, drawn by other processes while the network learns; by this
    one where there are none. They are the same in any case, but for the precision in which others send them.

    Of a recipe that repeats, each drawing comes as it is, LAG drawings later mirrored, and then every LAG drawings in
    any look."""
    repeats = batches.recipe.repeats
    earliest = max(first // repeats - (repeats - 1) * LAG, 0)
    loader = DataLoader(batches, batch_size=None, sampler=range(earliest, (end - 1) // repeats + 1),
                        num_workers=processes,
                        prefetch_factor=AHEAD if processes else None,
                        # of single samples, with batch_size=None
                        collate_fn=_to_send if processes else _as_they_are,  # type: ignore[arg-type]
                        pin_memory=processes > 0 and torch.cuda.is_available(),  # by a thread, which also receives
                        worker_init_fn=_begin_drawing,
                        multiprocessing_context="spawn" if processes else None)  # OpenCV's threads survive no fork
    drawn = enumerate(loader, earliest)  # the processes begin here, not when the first batch is asked for
    return _repeated(drawn, first, end, batches.recipe)


def _begin_drawing(_number: int) -> None:
    """A process that draws gives way to the one that keeps a graphics card busy."""
    begin_process()
    if hasattr(os, "nice"):
        os.nice(10)


def _repeated(drawn: Iterator[tuple[int, Batch]], first: int, end: int, recipe: Recipe) -> Iterator[Batch]:
    """The batches of iterations first..end-1, of numbered drawings in order that begin early enough."""
    kept: dict[int, Batch] = {}
    for iteration in range(first, end):
        newest, again = divmod(iteration, recipe.repeats)
        while newest not in kept:
            number, batch = next(drawn)
            kept[number] = batch
            kept.pop(number - (recipe.repeats - 1) * LAG - 1, None)
        look = again if again < 2 else int(np.random.default_rng((recipe.seed, iteration)).integers(len(LOOKS)))
        yield kept[newest - again * LAG if newest >= again * LAG else newest]._replace(look=look)


def _as_they_are(batch: Batch) -> Batch:
    return batch


def _to_send(batch: Batch) -> Batch:
    """Half as much, by torch, which takes a tenth of numpy's time; steps of 0.0005 are not seen. Not as tensors, which
    would be sent through shared memory: containers often have little of it."""
    frame, scene, gentle = (torch.from_numpy(part).half().numpy() for part in batch[:3])
    return Batch(frame, scene, gentle, batch.share)
