# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the pairs of each iteration on the CPU: a function of recipe and iteration, of which each worker makes its
share."""
from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...optics.prescription import Prescription
from ..model.recipe import Recipe
from .backgrounds import Backgrounds
from .flare_bank import MixedBank, SynthesisBank, UserFlares
from .pairs import FlareSource, Pair, make_pair, to_grey
from .workers import SINGLE_WORKER, Worker

BANK_PARTS = 16
"""Parts of the flare bank; consecutive iterations draw from one after the other."""


class Batch(NamedTuple):
    """Frames, scenes and scenes with their glow, (n, 3, height, width), display values 0..1, float32. share: fraction
    of the iteration's frames that these are."""

    frame: Tensor
    scene: Tensor
    scene_with_glow: Tensor
    share: float


class Batches:
    """The batches of a training by iteration, or one worker's share of them.

    Each frame is a function of the recipe, the iteration and its number in it, so the workers together have the same
    frames, however many they are.
    """

    def __init__(self, recipe: Recipe, backgrounds: Backgrounds, lenses: Sequence[Prescription],
                 user_flares: UserFlares | None = None, worker: Worker = SINGLE_WORKER) -> None:
        self.recipe, self._backgrounds, self._worker = recipe, backgrounds, worker
        self._synthesis_bank = SynthesisBank(recipe.seed, recipe.bank_size, recipe.canvas_size, lenses,
                                             recipe.coloured_share, recipe.aspheric_share, BANK_PARTS)
        self._bank: FlareSource = self._synthesis_bank
        if user_flares:
            self._bank = MixedBank(self._synthesis_bank, user_flares, recipe.user_flare_share)

    def __getitem__(self, iteration: int) -> Batch:
        """Return the batch of an iteration: the frames that this worker is responsible for, drawn now."""
        random = np.random.default_rng((self.recipe.seed, iteration))
        count, width, height = self.recipe.draw_batch_shape(random, iteration)
        pairs = [self.draw_pair(iteration, number, width, height)
                 for number in range(self._worker.rank, count, self._worker.count)]
        empty = np.zeros((0, height, width, 3), np.float32)
        frame, scene, scene_with_glow = (
            torch.from_numpy(np.stack([getattr(pair, part) for pair in pairs]) if pairs else empty).permute(0, 3, 1, 2)
            for part in ("frame", "scene", "scene_with_glow"))
        return Batch(frame, scene, scene_with_glow, len(pairs) / count)

    def draw_pair(self, iteration: int, number: int, width: int, height: int) -> Pair:
        """Return frame `number` of an iteration, of this size in pixels, with and without its flare. First renews the
        flare bank as far as the iteration requires."""
        self._synthesis_bank.renew(self.recipe.bank_size + iteration // self.recipe.renew_every, iteration)
        # number + 1, since seeds (1, 2) and (1, 2, 0) are equal
        random = np.random.default_rng((self.recipe.seed, iteration, number + 1))
        recipe = self.recipe
        pair = make_pair(random, self._bank, self._backgrounds, width, height, clean_share=recipe.clean_share,
                         against_light_share=recipe.against_light_share, shoulder_share=recipe.shoulder_share,
                         lifted_black_share=recipe.lifted_black_share)
        return to_grey(pair, int(random.integers(3))) if random.random() < recipe.grey_share else pair
