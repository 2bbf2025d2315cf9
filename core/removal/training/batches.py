# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training sees on a processor: the pictures of each iteration, a function of recipe and iteration; for a
learner its share."""
from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..model.recipe import Recipe
from ..synthesis.prescription import Prescription
from .backgrounds import Backgrounds
from .flare_bank import Mixed, OwnFlares, SynthesisBank
from .pairs import Bank, Pair, of_one_channel, pair
from .workers import ALONE, Learner

TURNS = 16
"""Iterations after one another are made from as many parts of the bank of flares, in turn."""


class Batch(NamedTuple):
    """Frames, scenes and gentle pictures (n, 3, height, width), display values 0..1, float32; which share they are of
    all that an iteration has."""

    frame: Tensor
    scene: Tensor
    gentle: Tensor
    share: float


class Batches:
    """What is drawn for each iteration under the flares that are at hand then; of several learners that of `learner`.

    Each frame is a function of the recipe, the iteration and its number in it: together the learners have the same
    frames, however many they are.
    """

    def __init__(self, recipe: Recipe, backgrounds: Backgrounds, lenses: Sequence[Prescription],
                 own: OwnFlares | None = None, learner: Learner = ALONE) -> None:
        self.recipe, self._backgrounds, self._learner = recipe, backgrounds, learner
        self._made = SynthesisBank(recipe.seed, recipe.bank, recipe.canvas, lenses, recipe.coloured,
                                   recipe.aspheric, TURNS)
        self._bank: Bank = Mixed(self._made, own, recipe.own_share) if own else self._made

    def __getitem__(self, iteration: int) -> Batch:
        count, width, height = self.recipe.frames(np.random.default_rng((self.recipe.seed, iteration)), iteration)
        mine = [self.pair(iteration, number, width, height)
                for number in range(self._learner.rank, count, self._learner.count)]
        none = np.zeros((0, height, width, 3), np.float32)
        frame, scene, gentle = (
            torch.from_numpy(np.stack([getattr(one, part) for one in mine]) if mine else none).permute(0, 3, 1, 2)
            for part in ("frame", "scene", "gentle"))
        return Batch(frame, scene, gentle, len(mine) / count)

    def pair(self, iteration: int, number: int, width: int, height: int) -> Pair:
        """A frame of an iteration, of that size."""
        self._made.renew_to(self.recipe.bank + iteration // self.recipe.renew_every, iteration)
        random = np.random.default_rng((self.recipe.seed, iteration, number + 1))  # to numpy, (1, 2) is (1, 2, 0)
        one = pair(random, self._bank, self._backgrounds, width, height, clean=self.recipe.clean,
                   against_light=self.recipe.against_light, shoulder=self.recipe.shoulder, faded=self.recipe.faded)
        return of_one_channel(one, int(random.integers(3))) if random.random() < self.recipe.grey else one
