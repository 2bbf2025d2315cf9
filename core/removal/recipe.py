# SPDX-License-Identifier: GPL-3.0-or-later
"""The recipe: every number that a training depends on, besides its pictures."""
from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ..errors import SettingsError


@dataclass(frozen=True)
class Recipe:
    """How the network is trained; the defaults made the weights in the box.

    The learning rate rises over `warmup` iterations, stays, and falls to nothing over the last `cooldown` of
    them (a share of `iterations`), so that a training can be made longer while it runs.
    """

    seed: int = 1
    iterations: int = 8000
    pixels: int = 200_000          # of a batch; frames of one size a batch
    learning_rate: float = 5e-4
    warmup: int = 200
    cooldown: float = 0.3
    floor: float = 1e-3            # squared error below which a picture counts as right
    weight_decay: float = 1e-4
    average: float = 0.996         # of the weights that are kept, over iterations
    widths: tuple[int, ...] = (64, 96, 128, 192)
    depths: tuple[int, ...] = (1, 2, 2, 4)
    small_until: int = 1500        # iterations with small frames, which are cheaper
    canvas: int = 448              # pixels a side of the flares' canvas
    bank: int = 250                # flares at hand at a time
    renew_every: int = 6           # iterations for each new flare
    own_share: float = 0.3         # of the user's own flares, where there are any
    clean: float = 0.08            # of the frames have no flare
    half: bool = True              # bfloat16 in the convolutions

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.pixels < 1 or not 0 < self.learning_rate < 1:
            raise SettingsError("A recipe needs at least one iteration, one pixel and a learning rate below 1.")
        if len(self.widths) != len(self.depths) or len(self.widths) < 2:
            raise SettingsError("A recipe's widths and depths must be as many, two at least.")

    def rate(self, iteration: int) -> float:
        """Learning rate of an iteration."""
        rise = min((iteration + 1) / max(self.warmup, 1), 1.0)
        left = (self.iterations - iteration) / max(self.cooldown * self.iterations, 1)
        return self.learning_rate * rise * min(left, 1.0)

    def frame_size(self, random: np.random.Generator, iteration: int) -> tuple[int, int]:
        """(width, height), multiples of 32: small at first, then up to the size that plates are worked at."""
        longest = int(random.integers(4, 8) if iteration < self.small_until else random.integers(7, 15)) * 32
        width, height = longest, max(round(longest / random.uniform(1.0, 1.9) / 32) * 32, 96)
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
