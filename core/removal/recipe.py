# SPDX-License-Identifier: GPL-3.0-or-later
"""The recipe: every number that a training depends on, besides its pictures."""
from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ..errors import SettingsError
from .network import MULTIPLE


@dataclass(frozen=True)
class Recipe:
    """How the network is trained; the defaults made the weights in the box.

    An iteration lays flares over `frames` new pictures, puts `cells` of each into a store that holds those of
    the last `store` iterations, and takes `steps` steps on random cells of all of them. The learning rate
    falls to nothing over the last `cooldown` of the iterations (a share), so that a training can be made
    longer while it runs.
    """

    seed: int = 1
    iterations: int = 1500
    frames: int = 8
    cells: int = 250
    store: int = 400
    steps: int = 4
    batch: int = 8192              # cells of a step
    learning_rate: float = 2e-3
    cooldown: float = 0.5
    average: float = 0.998         # of the weights that are kept, over steps
    widths: tuple[int, ...] = (192, 128, 64)
    longest: int = 192             # pixels of a frame, about; plates are worked at this size
    canvas: int = 224              # pixels a side of the flares' canvas
    bank: int = 400                # flares at hand at a time
    renew_every: int = 4           # iterations for each new flare
    own_share: float = 0.3         # of the user's own flares, where there are any
    clean: float = 0.1             # of the frames have no flare

    def __post_init__(self) -> None:
        if min(self.iterations, self.frames, self.cells, self.store, self.steps, self.batch, self.bank) < 1:
            raise SettingsError("A recipe needs at least one iteration, frame, cell, step and flare.")
        if not 0 < self.learning_rate < 1 or not self.widths or self.longest < 2 * MULTIPLE:
            raise SettingsError("A recipe needs a learning rate below 1, a hidden layer, and frames of "
                                f"{2 * MULTIPLE} pixels.")

    def rate(self, iteration: int) -> float:
        """Learning rate of an iteration."""
        left = (self.iterations - iteration) / max(self.cooldown * self.iterations, 1)
        return self.learning_rate * min(left, 1.0)

    def frame_size(self, random: np.random.Generator) -> tuple[int, int]:
        """(width, height), multiples of MULTIPLE, about `longest` on the long side."""
        longest = max(round(self.longest * random.uniform(0.8, 1.25) / MULTIPLE), 2) * MULTIPLE
        width, height = longest, max(round(longest / random.uniform(1.0, 1.9) / MULTIPLE), 2) * MULTIPLE
        return (width, height) if random.random() < 0.8 else (height, width)


def as_dict(recipe: Recipe) -> dict[str, Any]:
    """JSON-able."""
    return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(recipe).items()}


def from_dict(data: dict[str, Any]) -> Recipe:
    """The inverse of `as_dict`; SettingsError for names that a recipe has not."""
    known = {field.name for field in fields(Recipe)}
    unknown = set(data) - known
    if unknown:
        raise SettingsError(f"A recipe has no {', '.join(sorted(unknown))}.")
    values: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in data.items()}
    return Recipe(**values)
