# SPDX-License-Identifier: GPL-3.0-or-later
"""Clones and prunes flare Gaussians (paper, appendix "Flare representation"); the trainer calls it."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from ..gaussians.optimiser import Adam
from .model import LightFlare


@dataclass(frozen=True)
class DensitySettings:
    """When and how flare Gaussians are cloned and pruned; the defaults are the paper's.

    Iterations `start` to `stop`, every `every`. Gaussians with opacity above `clone_above` are cloned with probability
    `clone_ratio` and moved by Gaussian noise of `noise` in mu; those below `prune_below` are pruned. `max_gaussians`
    bounds those of one light.
    """

    start: int = 1000
    stop: int = 12000
    every: int = 500
    clone_above: float = 0.005
    clone_ratio: float = 0.2
    noise: float = 0.02
    prune_below: float = 0.002
    max_gaussians: int = 20000

    def is_due(self, iteration: int) -> bool:
        """Return whether an iteration clones and prunes."""
        return self.start <= iteration <= self.stop and iteration % self.every == 0


def clone_and_prune(flare: LightFlare, optimiser: Adam, names: Mapping[str, str], settings: DensitySettings,
                    generator: torch.Generator) -> None:
    """Clone and prune one light's canonical Gaussians in place.

    Gaussians of low opacity are removed; of the others, some of high opacity are copied, and the copies moved by noise.
    The optimiser's moments follow the rows; those of clones are 0. names: the optimiser's name of each parameter in
    `flare.gaussians`.
    """
    opacity = flare.gaussians["opacity_logits"].detach().sigmoid()[:, 0]
    keep = (opacity >= settings.prune_below).nonzero()[:, 0]
    chosen = torch.rand(len(opacity), generator=generator).to(opacity.device) < settings.clone_ratio
    cloned = (chosen & (opacity > settings.clone_above)).nonzero()[:, 0]
    cloned = cloned[: max(settings.max_gaussians - len(keep), 0)]
    clones = {names[name]: rows.detach()[cloned] for name, rows in flare.gaussians.items()}
    positions = clones[names["positions"]]
    positions += settings.noise * torch.randn(positions.shape, generator=generator).to(positions.device)
    optimiser.keep_rows(keep, names.values())
    optimiser.append_rows(clones)
