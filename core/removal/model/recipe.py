# SPDX-License-Identifier: GPL-3.0-or-later
"""The recipe: every number that a training of the removal network depends on, besides its pictures.

`train-removal` reads it from its options, `training` follows it, and the headers of weights and checkpoints hold it.
"""
from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ...errors import SettingsError
from ...typed import parse_field
from .network import LEVELS, SIZE_MULTIPLE

RETIRED: dict[str, str | None] = {
    "repeats": None, "stages": "size_stages", "pixels": "pixels_per_iteration", "warm": "warmup_iterations",
    "decay": "weight_decay", "average": "ema_decay", "begun": "initial_weights_mix", "polish": "psnr_phase",
    "local": "patch_loss_share", "canvas": "canvas_size", "bank": "bank_size", "coloured": "coloured_share",
    "aspheric": "aspheric_share", "grey": "grey_share", "own_share": "user_flare_share", "clean": "clean_share",
    "against_light": "against_light_share", "shoulder": "shoulder_share", "faded": "lifted_black_share"}
"""Names of settings in recipes of format 0, and their present names; None where the setting no longer exists."""


@dataclass(frozen=True)
class Recipe:
    """How the network is trained.

    An iteration is one step on new frames of one size under flares from the bank. Frames have all sizes, small ones for
    most of a training: much of what a flare looks like is learned as well on those, and sooner. The learning rate rises
    linearly, then falls as a cosine to 0 at the last iteration. On a GPU, which has its own pools of flares,
    `bank_size` and `renew_every` have no effect, and frames have the size of the last stage.
    """

    seed: int = 1
    iterations: int = 15_000
    size_stages: tuple[tuple[float, int, int], ...] = ((0.5, 96, 256), (1.0, 208, 400))
    """End of the stage, a share of the iterations; least and greatest long side of a frame in it, pixels."""
    pixels_per_iteration: int = 300_000  # pixels of all frames of an iteration together
    learning_rate: float = 4e-4          # the greatest, reached after the warm-up
    warmup_iterations: int = 300
    weight_decay: float = 1e-4           # of AdamW and Muon, relative to the learning rate
    ema_decay: float = 0.9995            # of the exponential moving average of the weights, which is written
    initial_weights_mix: float = 0.0     # share of the weights at the start of a training in the written weights
    psnr_phase: float = 0.15             # share of the iterations, the last ones, that maximise each frame's PSNR
    patch_loss_share: float = 0.0        # share of that loss that is the PSNR of patches, not of the whole frame
    widths: tuple[int, ...] = (32, 48, 96, 128, 160)
    blocks: tuple[int, ...] = (0, 1, 4, 8, 6)
    attention: tuple[int, ...] = (3, 2)  # layers between the blocks of the two coarsest levels
    canvas_size: int = 384               # side of the canvas of a flare, pixels
    bank_size: int = 400                 # flares in the bank, 2.7 MB each; an iteration draws from a sixteenth of them
    renew_every: int = 6                 # iterations until one flare of the bank is replaced
    coloured_share: float = 0.15         # of the synthesised flares: of a light of one colour
    aspheric_share: float = 0.3          # of the synthesised flares: with the ghosts of moulded lenses
    grey_share: float = 0.2              # of the frames: one of their channels as a grey frame
    user_flare_share: float = 0.3        # of the flares: the user's, if there are any
    clean_share: float = 0.12            # of the frames: without flare
    against_light_share: float = 0.3     # of the frames: with the lights where the scene is bright
    shoulder_share: float = 0.3          # of the frames: of cameras whose tone curve has a shoulder
    lifted_black_share: float = 0.25     # of the frames: graded so that black is grey

    def __post_init__(self) -> None:
        """Raise SettingsError for a number that is out of its range."""
        if min(self.iterations, self.pixels_per_iteration, self.bank_size, self.renew_every,
               self.warmup_iterations) < 1:
            raise SettingsError("A recipe needs at least one iteration, pixel and flare.")
        for name in ("initial_weights_mix", "psnr_phase", "patch_loss_share", "coloured_share", "aspheric_share",
                     "grey_share", "user_flare_share", "clean_share", "against_light_share", "shoulder_share",
                     "lifted_black_share", "ema_decay"):
            if not 0 <= getattr(self, name) <= 1:
                raise SettingsError(f"A recipe's {name} lies between 0 and 1, not at {getattr(self, name)}.")
        if self.seed < 0 or self.weight_decay < 0 or not 32 <= self.canvas_size <= 8192:
            raise SettingsError("A recipe needs a seed and a weight_decay of 0 or more, and a canvas_size of 32 to "
                                "8192 pixels.")
        if not 0 < self.learning_rate < 1 or not len(self.widths) == len(self.blocks) == LEVELS:
            raise SettingsError(f"A recipe needs a learning_rate below 1, and widths and blocks of {LEVELS} levels.")
        if min(self.widths) < 1 or min(self.blocks) < 0:
            raise SettingsError("A recipe needs widths of one channel or more, and blocks of 0 or more.")
        coarse_blocks = self.blocks[-len(self.attention):]
        if len(self.attention) != 2 or any(not 0 <= 2 * layers <= blocks
                                           for layers, blocks in zip(self.attention, coarse_blocks, strict=True)):
            raise SettingsError("A recipe needs attention for two levels, at most one layer for every two of their "
                                "blocks.")
        if not self.size_stages or any(len(stage) != 3 or not 2 * SIZE_MULTIPLE <= stage[1] <= stage[2]
                                       for stage in self.size_stages):
            raise SettingsError("A recipe needs size_stages of (share of the iterations, least and greatest long side "
                                f"in pixels), of {2 * SIZE_MULTIPLE} pixels or more.")

    def learning_rate_at(self, iteration: int) -> float:
        """Return the learning rate of an iteration: a linear rise over the warm-up times a cosine that falls to 0."""
        fall = 0.5 + 0.5 * math.cos(math.pi * min(iteration / self.iterations, 1.0))
        return self.learning_rate * fall * min((iteration + 1) / self.warmup_iterations, 1.0)

    def size_range_at(self, iteration: int) -> tuple[int, int]:
        """Return the least and greatest long side of the frames of an iteration, pixels."""
        for end, shortest, longest in self.size_stages:
            if iteration < end * self.iterations:
                return shortest, longest
        return self.size_stages[-1][1:]

    def draw_batch_shape(self, random: np.random.Generator, iteration: int) -> tuple[int, int, int]:
        """Draw (count, width, height) of the frames of an iteration; sides are multiples of SIZE_MULTIPLE.

        The aspect is 1 to 1.9, one frame size in five is upright, and there are as many frames as the pixels of an
        iteration allow.
        """
        min_log_side, max_log_side = map(math.log, self.size_range_at(iteration))
        long_side = max(round(math.exp(random.uniform(min_log_side, max_log_side)) / SIZE_MULTIPLE), 2) * SIZE_MULTIPLE
        short_side = max(round(long_side / random.uniform(1.0, 1.9) / SIZE_MULTIPLE), 2) * SIZE_MULTIPLE
        width, height = long_side, short_side
        if random.random() < 0.2:
            width, height = height, width
        return max(round(self.pixels_per_iteration / (width * height)), 1), width, height


def as_dict(recipe: Recipe) -> dict[str, Any]:
    """Return the recipe as a JSON-able dictionary."""
    return asdict(recipe)


def from_dict(data: dict[str, Any]) -> Recipe:
    """Make a recipe from a dictionary; the inverse of `as_dict`.

    Raises SettingsError for unknown names and for values of another type. Retired names are read:
    if a retired and a present name of one setting occur, the later one in `data` counts.
    """
    present = {RETIRED.get(name, name): value for name, value in data.items()}
    unknown = set(present) - {field.name for field in fields(Recipe)} - {None}
    if unknown:
        raise SettingsError(f"A recipe has no {', '.join(sorted(map(str, unknown)))}.")
    values = {}
    for name, value in present.items():
        if name is None:
            continue
        try:
            values[name] = parse_field(Recipe, name, value)
        except ValueError as problem:
            raise SettingsError(f"A recipe's {name} cannot be {value!r} ({problem}).") from problem
    return Recipe(**values)
