# SPDX-License-Identifier: GPL-3.0-or-later
"""The recipe: every number that a training depends on, besides its pictures."""
from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ...errors import SettingsError
from ...typed import field_of
from .network import LEVELS, MULTIPLE

RETIRED = frozenset({"repeats"})
"""What recipes of before had besides, and trainings know no more."""


@dataclass(frozen=True)
class Recipe:
    """How the network is trained.

    An iteration is a step on new pictures of one size under flares from the bank. They are of all sizes, small ones
    for most of a training: much of what a flare looks like is learned as well, and sooner, on those. The learning
    rate rises over the first `warm` iterations and falls as a cosine to nothing at the last. On a graphics card, which
    has its own pools of flares, `bank` and `renew_every` do not count, and frames are of the last stage's size.
    """

    seed: int = 1
    iterations: int = 15_000
    stages: tuple[tuple[float, int, int], ...] = ((0.5, 96, 256), (1.0, 208, 400))
    """Up to which share of the iterations; least and most pixels of a frame's long side."""
    pixels: int = 300_000          # of an iteration, all its frames together
    learning_rate: float = 4e-4
    warm: int = 300
    decay: float = 1e-4            # of the weights, AdamW
    average: float = 0.9995        # of the weights that are kept, over iterations
    begun: float = 0.0             # share, in the weights that are kept, of those that a training began with
    polish: float = 0.15           # of the iterations, the last of them, go for each picture's PSNR
    local: float = 0.0             # of that goal is the PSNR of each patch of a picture rather than of all of it
    widths: tuple[int, ...] = (32, 48, 96, 128, 160)
    blocks: tuple[int, ...] = (0, 1, 4, 8, 6)
    attention: tuple[int, ...] = (3, 2)  # layers of it between the blocks of the two coarsest levels
    canvas: int = 384              # pixels a side of the flares' canvas
    bank: int = 400                # flares kept at a time, 2.7 MB each; a sixteenth are at hand in an iteration
    renew_every: int = 6           # iterations for each new flare
    coloured: float = 0.15         # of the synthesised flares are of lights of one colour
    aspheric: float = 0.3          # of them have the ghosts of moulded lenses too
    grey: float = 0.2              # of the frames are of one of their channels alone
    own_share: float = 0.3         # of the user's own flares, where there are any
    clean: float = 0.12            # of the frames have no flare
    against_light: float = 0.3     # of the frames have their lights where the scene is bright
    shoulder: float = 0.3          # of them are of cameras whose curves bend towards white
    faded: float = 0.25            # of them are graded so that black is grey

    def __post_init__(self) -> None:
        if min(self.iterations, self.pixels, self.bank, self.renew_every, self.warm) < 1:
            raise SettingsError("A recipe needs at least one iteration, pixel and flare.")
        for name in ("begun", "polish", "local", "coloured", "aspheric", "grey", "own_share", "clean", "against_light",
                     "shoulder", "faded", "average"):
            if not 0 <= getattr(self, name) <= 1:
                raise SettingsError(f"A recipe's {name} is a share from 0 to 1, not {getattr(self, name)}.")
        if self.seed < 0 or self.decay < 0 or not 32 <= self.canvas <= 8192:
            raise SettingsError("A recipe needs a seed and a decay of 0 or more, and a canvas of 32 to 8192 pixels.")
        if not 0 < self.learning_rate < 1 or not len(self.widths) == len(self.blocks) == LEVELS:
            raise SettingsError(f"A recipe needs a learning rate below 1, and widths and blocks of {LEVELS} levels.")
        if min(self.widths) < 1 or min(self.blocks) < 0:
            raise SettingsError("A recipe needs widths of one plane or more, and blocks of 0 or more.")
        coarse = self.blocks[-len(self.attention):]
        if len(self.attention) != 2 or any(not 0 <= 2 * layers <= blocks
                                           for layers, blocks in zip(self.attention, coarse, strict=True)):
            raise SettingsError("A recipe needs attention for two levels, a layer for every two of their blocks at "
                                "most.")
        if not self.stages or any(len(stage) != 3 or not 2 * MULTIPLE <= stage[1] <= stage[2] for stage in self.stages):
            raise SettingsError("A recipe needs stages of (share of the iterations, least and most pixels of a long "
                                f"side), of {2 * MULTIPLE} pixels or more.")

    def rate(self, iteration: int) -> float:
        """Learning rate of an iteration."""
        fall = 0.5 + 0.5 * math.cos(math.pi * min(iteration / self.iterations, 1.0))
        return self.learning_rate * fall * min((iteration + 1) / self.warm, 1.0)

    def stage(self, iteration: int) -> tuple[int, int]:
        """Least and most pixels of a frame's long side, of an iteration."""
        for until, least, most in self.stages:
            if iteration < until * self.iterations:
                return least, most
        return self.stages[-1][1:]

    def frames(self, random: np.random.Generator, iteration: int) -> tuple[int, int, int]:
        """(how many, width, height) of an iteration, sides being multiples of MULTIPLE."""
        least, most = map(math.log, self.stage(iteration))
        longest = max(round(math.exp(random.uniform(least, most)) / MULTIPLE), 2) * MULTIPLE
        width, height = longest, max(round(longest / random.uniform(1.0, 1.9) / MULTIPLE), 2) * MULTIPLE
        if random.random() < 0.2:
            width, height = height, width
        return max(round(self.pixels / (width * height)), 1), width, height


def as_dict(recipe: Recipe) -> dict[str, Any]:
    """JSON-able."""
    return asdict(recipe)


def from_dict(data: dict[str, Any]) -> Recipe:
    """The inverse of `as_dict`; SettingsError for names that a recipe has not, and values of another kind."""
    data = {name: value for name, value in data.items() if name not in RETIRED}
    unknown = set(data) - {field.name for field in fields(Recipe)}
    if unknown:
        raise SettingsError(f"A recipe has no {', '.join(sorted(unknown))}.")
    values = {}
    for name, value in data.items():
        try:
            values[name] = field_of(Recipe, name, value)
        except ValueError as problem:
            raise SettingsError(f"A recipe's {name} cannot be {value!r} ({problem}).") from problem
    return Recipe(**values)
