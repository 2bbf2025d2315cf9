# SPDX-License-Identifier: GPL-3.0-or-later
"""The recipe: every number that a training depends on, besides its pictures."""
from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ..errors import SettingsError
from .network import LEVELS, MULTIPLE


@dataclass(frozen=True)
class Recipe:
    """How the network is trained; the weights in the box began with the defaults (their card has the rest).

    An iteration is a step on new pictures of one size under flares from the bank; they are small at first, since
    most of what a flare looks like is learned as well, and sooner, on those. The learning rate rises over the first
    `warm` iterations and falls as a cosine to nothing at the last.
    """

    seed: int = 1
    iterations: int = 15_000
    stages: tuple[tuple[float, int, int], ...] = ((0.6, 96, 8), (0.88, 160, 6), (1.0, 240, 4))
    """Up to which share of the iterations; pixels of a frame's long side, about; frames of an iteration."""
    learning_rate: float = 3e-4
    warm: int = 200
    decay: float = 1e-4            # of the weights, AdamW
    average: float = 0.999         # of the weights that are kept, over iterations
    polish: float = 0.15           # of the iterations, the last of them, go for each picture's PSNR
    widths: tuple[int, ...] = (32, 48, 96, 128, 160)
    canvas: int = 256              # pixels a side of the flares' canvas
    bank: int = 800                # flares at hand at a time
    renew_every: int = 6           # iterations for each new flare
    own_share: float = 0.3         # of the user's own flares, where there are any
    clean: float = 0.12            # of the frames have no flare

    def __post_init__(self) -> None:
        if min(self.iterations, self.bank, self.renew_every, self.warm) < 1:
            raise SettingsError("A recipe needs at least one iteration, frame and flare.")
        if not 0 < self.learning_rate < 1 or len(self.widths) != LEVELS:
            raise SettingsError(f"A recipe needs a learning rate below 1, and the widths of {LEVELS} levels.")
        if not self.stages or any(len(stage) != 3 or stage[1] < 2 * MULTIPLE or stage[2] < 1 for stage in self.stages):
            raise SettingsError("A recipe needs stages of (share of the iterations, pixels, frames), of "
                                f"{2 * MULTIPLE} pixels or more.")

    def rate(self, iteration: int) -> float:
        """Learning rate of an iteration."""
        fall = 0.5 + 0.5 * math.cos(math.pi * min(iteration / self.iterations, 1.0))
        return self.learning_rate * fall * min((iteration + 1) / self.warm, 1.0)

    def stage(self, iteration: int) -> tuple[int, int]:
        """(pixels of a frame's long side, frames) of an iteration."""
        for until, longest, frames in self.stages:
            if iteration < until * self.iterations:
                return longest, frames
        return self.stages[-1][1:]

    def frame_size(self, random: np.random.Generator, iteration: int) -> tuple[int, int]:
        """(width, height), multiples of MULTIPLE, about as long as the stage asks."""
        longest = max(round(self.stage(iteration)[0] * random.uniform(0.8, 1.25) / MULTIPLE), 2) * MULTIPLE
        width, height = longest, max(round(longest / random.uniform(1.0, 1.9) / MULTIPLE), 2) * MULTIPLE
        return (width, height) if random.random() < 0.8 else (height, width)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list | tuple) else value


def as_dict(recipe: Recipe) -> dict[str, Any]:
    """JSON-able."""
    return asdict(recipe)


def from_dict(data: dict[str, Any]) -> Recipe:
    """The inverse of `as_dict`; SettingsError for names that a recipe has not."""
    known = {field.name for field in fields(Recipe)}
    unknown = set(data) - known
    if unknown:
        raise SettingsError(f"A recipe has no {', '.join(sorted(unknown))}.")
    return Recipe(**{key: _tuples(value) for key, value in data.items()})
