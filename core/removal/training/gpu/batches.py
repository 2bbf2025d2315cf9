# SPDX-License-Identifier: GPL-3.0-or-later
"""The batches of a training on a GPU: random scenes and flares of the pools, composed on the GPU."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch

from ....optics.prescription import Prescription
from ...model.network import SIZE_MULTIPLE
from ...model.recipe import Recipe
from .. import random_cameras
from ..backgrounds import Backgrounds
from ..batches import Batch
from ..flare_bank import UserFlares
from .composition import compose, draw_flare_placements, draw_frame_parameters
from .pools import Pools, frame_shapes, keep_pools_filled, pool_sizes


@contextmanager
def open_gpu_batches(recipe: Recipe, start_iteration: int, backgrounds: Backgrounds, lenses: Sequence[Prescription],
                     user_flares: UserFlares | None, device: torch.device,
                     process_count: int) -> Iterator[Iterator[Batch]]:
    """Yield endless batches from `start_iteration` on; `process_count` processes draw the scenes and flares.

    Unlike the batches on a CPU they are not determined by the recipe: what the pools hold depends on how fast the
    processes draw. Raises RunError where nothing is drawn.
    """
    shapes = frame_shapes(recipe, SIZE_MULTIPLE)
    sizes = pool_sizes(torch.cuda.mem_get_info(device)[0], shapes, recipe.canvas_size)
    pools = Pools(shapes, recipe.canvas_size, device, *sizes)
    with keep_pools_filled(pools, recipe, backgrounds, lenses, user_flares, process_count):
        yield compose_batches(pools, recipe, np.random.default_rng((recipe.seed, start_iteration)))


def compose_batches(pools: Pools, recipe: Recipe, random: np.random.Generator) -> Iterator[Batch]:
    """Yield batches without end, each of scenes of one frame shape under flares, all sampled from the pools. The first
    frames of a batch, SECOND_FLARE_SHARE of them, get a second flare."""
    while True:
        shape_index = int(random.choice(len(pools.shapes), p=[shape.share for shape in pools.shapes]))
        width, height, count, _ = pools.shapes[shape_index]
        scenes, gammas = pools.sample_scenes(random, shape_index)
        device = scenes.device
        second_count = max(round(random_cameras.SECOND_FLARE_SHARE * count), 1)
        flares = [(pools.sample_flares(random, flare_count),
                   draw_flare_placements(random, flare_count, recipe.canvas_size, width, height,
                                         is_second=is_second).to(device))
                  for flare_count, is_second in ((count, False), (second_count, True))]
        frames = draw_frame_parameters(random, count, recipe).to(device)
        yield Batch(*compose(scenes, gammas, frames, flares), 1.0)  # share: all of the iteration's frames
