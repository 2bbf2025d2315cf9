# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training sees on a card."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch

from ...model.network import MULTIPLE
from ...model.recipe import Recipe
from ...synthesis.prescription import Prescription
from .. import random_cameras
from ..backgrounds import Backgrounds
from ..batches import Batch
from ..flare_bank import OwnFlares
from .composition import composed, filming, laying
from .pools import Pools, filled, room, shapes_of


@contextmanager
def drawn_on_card(recipe: Recipe, first: int, backgrounds: Backgrounds, lenses: Sequence[Prescription],
                  own: OwnFlares | None, device: torch.device, processes: int) -> Iterator[Iterator[Batch]]:
    """Batches without end, from iteration `first` on; `processes` draw what they are composed of. Unlike those of a
    processor they are no function of the recipe: what is in the pools depends on how fast it was drawn. Raises
    RunError where nothing is drawn."""
    shapes = shapes_of(recipe, MULTIPLE)
    pools = Pools(shapes, recipe.canvas, device, *room(torch.cuda.mem_get_info(device)[0], shapes, recipe.canvas))
    with filled(pools, recipe, backgrounds, lenses, own, processes):
        yield batches(pools, recipe, np.random.default_rng((recipe.seed, first)))


def batches(pools: Pools, recipe: Recipe, random: np.random.Generator) -> Iterator[Batch]:
    """Each of frames of one of the shapes, under flares of the pools."""
    while True:
        number = int(random.choice(len(pools.shapes), p=[shape.share for shape in pools.shapes]))
        width, height, count, _ = pools.shapes[number]
        scenes, gammas = pools.scenes(random, number)
        device = scenes.device
        twice = max(round(random_cameras.SECOND * count), 1)
        over = [(pools.flares(random, some),
                 laying(random, some, recipe.canvas, width, height, second=second).on(device))
                for some, second in ((count, False), (twice, True))]
        yield Batch(*composed(scenes, gammas, filming(random, count, recipe).on(device), over), 1.0)
