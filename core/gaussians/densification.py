# SPDX-License-Identifier: GPL-3.0-or-later
"""Densification: where Gaussians are added and taken away while a scene is optimised.

A strategy works on a scene and its optimiser, apart from the trainer, which calls, every iteration from 1:

    loss = ... + strategy.regulariser()
    loss.backward()
    strategy.observe(rendering)             # of this backward pass
    optimiser.step()
    changed = strategy.update(iteration)    # rows were moved, added or removed

`Classic` is that of 3DGS (Kerbl et al. 2023, section 5.2), with an optional cap at which the largest
gradients come first. `Mcmc` (Kheradmand et al. 2024) holds a budget: it moves the Gaussians that have
faded to where others are seen, and lets the faint ones wander. Both depend on nothing but their inputs and
the generator.
"""
from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from .optimiser import Adam
from .projection import rotation_matrices
from .rendering import Rendering
from .scene import SceneGaussians


class Strategy(Protocol):
    """See the module's head."""

    def regulariser(self) -> Tensor | float: ...
    def observe(self, rendering: Rendering) -> None: ...
    def update(self, iteration: int) -> bool: ...
    def reorder(self, order: Tensor) -> None: ...
    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: Mapping[str, Any]) -> None: ...


@dataclass(frozen=True)
class ClassicSettings:
    """Iterations count from 1; scales are shares of the scene's extent."""

    start: int = 500
    stop: int = 15_000
    every: int = 100
    gradient: float = 2e-4
    """Mean norm of the gradient by the centre, in half pictures (3DGS's normalised device coordinates)."""
    small: float = 0.01
    """Up to this scale a Gaussian is cloned, above it split in two."""
    large: float = 0.1
    """Above this scale it is removed, once opacities have been reset."""
    faint: float = 0.005
    """Below this opacity it is removed."""
    reset_every: int = 3000
    """Opacities are cut to `reset_to` this often: what is not needed then fades."""
    reset_to: float = 0.01
    cap: int | None = None
    """Most Gaussians there may be."""


class Classic:
    """3DGS's own densification. extent: of the scene, world units (see `Capture.extent`)."""

    SHRINK = 1.6  # scales of the halves of a split Gaussian, by which they are divided

    def __init__(
        self, scene: SceneGaussians, optimiser: Adam, extent: float, generator: torch.Generator,
        settings: ClassicSettings | None = None,
    ) -> None:  # fmt: skip
        self.scene, self.optimiser, self.generator = scene, optimiser, generator
        self.extent = extent
        self.settings = settings or ClassicSettings()
        self._clear()

    def _clear(self) -> None:
        self.gradients = torch.zeros_like(self.scene.opacity_logits, requires_grad=False)
        self.views = torch.zeros_like(self.gradients)

    def regulariser(self) -> float:
        """None."""
        return 0.0

    @torch.no_grad()
    def observe(self, rendering: Rendering) -> None:
        """Gathers the gradients of the Gaussians that were seen."""
        height, width = rendering.alpha.shape
        norms = torch.hypot(*(rendering.centre_gradients * rendering.alpha.new_tensor([width / 2, height / 2])).T)
        seen = rendering.radii > 0
        self.gradients += norms * seen
        self.views += seen

    @torch.no_grad()
    def update(self, iteration: int) -> bool:
        """Clones, splits and prunes where it is time to; resets opacities where it is time to."""
        s = self.settings
        if iteration > s.stop:
            return False
        changed = False
        if iteration > s.start and iteration % s.every == 0:
            self._refine(prune_large=iteration > s.reset_every)
            self._clear()
            changed = True
        if iteration % s.reset_every == 0 and iteration < s.stop:  # what comes after finds them again
            self.scene.opacity_logits.clamp_(max=math.log(s.reset_to / (1 - s.reset_to)))
            self.optimiser.forget("opacity_logits")
        return changed

    def _refine(self, prune_large: bool) -> None:
        s, scene = self.settings, self.scene
        size = scene.scales.amax(-1)
        removed = scene.opacities < s.faint
        if prune_large:
            removed |= size > s.large * self.extent
        score = self.gradients / self.views.clamp(min=1)
        grows = (score > s.gradient) & ~removed
        if s.cap is not None:
            room = max(0, s.cap - int((~removed).sum()))
            if int(grows.sum()) > room:  # each that grows, by clone or split, adds one
                first = torch.argsort(score.masked_fill(~grows, -1), descending=True, stable=True)[:room]
                grows = torch.zeros_like(grows).index_fill_(0, first, True)
        split = grows & (size > s.small * self.extent)
        clones = {name: p.detach()[grows & ~split] for name, p in scene.named_parameters()}
        halves = self._halves(split)
        self.optimiser.keep(torch.nonzero(~removed & ~split)[:, 0])
        self.optimiser.append(clones)
        self.optimiser.append(halves)

    def _halves(self, split: Tensor) -> dict[str, Tensor]:
        """Two for each: smaller, at places drawn from the Gaussian that they replace."""
        halves = {name: p.detach()[split].repeat_interleave(2, 0) for name, p in self.scene.named_parameters()}
        noise = _randn(halves["means"].shape, self.generator, halves["means"])
        offsets = rotation_matrices(halves["quaternions"]) @ (noise * halves["log_scales"].exp())[..., None]
        halves["means"] = halves["means"] + offsets[..., 0]
        halves["log_scales"] = halves["log_scales"] - math.log(self.SHRINK)
        return halves

    def reorder(self, order: Tensor) -> None:
        """Follows a new order of the rows."""
        self.gradients, self.views = self.gradients[order], self.views[order]

    def state_dict(self) -> dict[str, Any]:
        """What a resumed fit needs."""
        return {"gradients": self.gradients, "views": self.views, "generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes up what state_dict gave."""
        self.gradients, self.views = (
            state[name].to(self.scene.opacity_logits) for name in ("gradients", "views")
        )
        self.generator.set_state(state["generator"])


@dataclass(frozen=True)
class McmcSettings:
    """Iterations count from 1."""

    cap: int = 50_000
    start: int = 500
    stop: int = 25_000
    every: int = 100
    growth: float = 1.05
    """The count grows by this factor at each refinement, until the cap."""
    faint: float = 0.005
    """Gaussians at this opacity or below are moved."""
    noise: float = 5e5
    """Strength of the wandering, times the learning rate of the means."""
    opacity_weight: float = 0.01
    scale_weight: float = 0.01


class Mcmc:
    """Relocation within a budget, and noise (3D Gaussian Splatting as Markov Chain Monte Carlo)."""

    STEEPNESS = 100.0  # of the noise's fall with opacity, about `faint`
    NOISE_OPACITY_MAX = 0.15  # from here the noise is below 1e-6 of its full strength and left out
    COPIES_MAX = 51

    def __init__(
        self, scene: SceneGaussians, optimiser: Adam, generator: torch.Generator,
        settings: McmcSettings | None = None,
    ) -> None:  # fmt: skip
        self.scene, self.optimiser, self.generator = scene, optimiser, generator
        self.settings = settings or McmcSettings()

    def regulariser(self) -> Tensor:
        """Makes what is not needed fade and shrink (the paper's eq. 12): a scalar for the loss."""
        s = self.settings
        return s.opacity_weight * self.scene.opacities.mean() + s.scale_weight * self.scene.scales.mean()

    def observe(self, rendering: Rendering) -> None:
        """Nothing is gathered."""

    @torch.no_grad()
    def update(self, iteration: int) -> bool:
        """Moves and adds where it is time to; lets the faint wander, always."""
        s = self.settings
        changed = s.start < iteration <= s.stop and iteration % s.every == 0
        if changed:
            self._relocate()
            self._grow()
        self._wander()
        return changed

    def _relocate(self) -> None:
        dead = self.scene.opacities <= self.settings.faint
        targets = torch.nonzero(dead)[:, 0]
        alive = torch.nonzero(~dead)[:, 0]
        if len(targets) == 0 or len(alive) == 0:
            return
        sources = alive[self._draw(self.scene.opacities[alive], len(targets))]
        self._share(sources)
        for name, parameter in self.scene.named_parameters():
            parameter[targets] = parameter[sources]
            self.optimiser.forget(name, torch.cat([sources, targets]))

    def _grow(self) -> None:
        n = len(self.scene)
        new = min(self.settings.cap, int(n * self.settings.growth)) - n
        if new <= 0:
            return
        sources = self._draw(self.scene.opacities, new)
        self._share(sources)
        for name in dict(self.scene.named_parameters()):
            self.optimiser.forget(name, sources)
        self.optimiser.append({name: p.detach()[sources] for name, p in self.scene.named_parameters()})

    def _draw(self, weights: Tensor, number: int) -> Tensor:
        """Row numbers, drawn in proportion to the weights, with replacement."""
        drawn = torch.multinomial(weights.cpu().double(), number, replacement=True, generator=self.generator)
        return drawn.to(weights.device)

    def _share(self, sources: Tensor) -> None:
        """Changes the Gaussians of these rows (each as often as it was drawn) so that they and as many
        copies together look as each did alone."""
        rows, drawn = torch.unique(sources, return_counts=True)
        opacity, shrink = shared(self.scene.opacities[rows], (drawn + 1).clamp(max=self.COPIES_MAX))
        opacity = opacity.clamp(self.settings.faint, 1 - torch.finfo(opacity.dtype).eps)
        self.scene.opacity_logits[rows] = torch.logit(opacity)
        self.scene.log_scales[rows] += shrink.log()[:, None]

    def _wander(self) -> None:
        """Noise of the Gaussian's own shape, for those that are nearly transparent (the paper's eq. 9)."""
        rate = self.optimiser.rates["means"]
        opacities = self.scene.opacities
        rows = torch.nonzero(opacities < self.NOISE_OPACITY_MAX)[:, 0]
        if len(rows) == 0:
            return
        strength = torch.sigmoid(self.STEEPNESS * (self.settings.faint - opacities[rows])) * self.settings.noise
        noise = _randn((len(rows), 3), self.generator, opacities) * strength[:, None] * rate
        axes = rotation_matrices(self.scene.quaternions[rows]) * self.scene.scales[rows][:, None, :]
        self.scene.means[rows] += (axes @ (axes.transpose(1, 2) @ noise[..., None]))[..., 0]

    def reorder(self, order: Tensor) -> None:
        """Nothing depends on the order."""

    def state_dict(self) -> dict[str, Any]:
        """What a resumed fit needs."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes up what state_dict gave."""
        self.generator.set_state(state["generator"])


def shared(opacity: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity of each of `copies` Gaussians in one place that together look as one of `opacity`, and the
    factor of their scales; all (n,).

    o' = 1 - (1 - o)^(1/N) keeps the centre; o / sum_{j=1..N} (-1)^(j-1) C(N, j) o'^j / sqrt(j) keeps the
    integral along a line through it (Kheradmand et al. 2024, eq. 8, its double sum over binomials summed up).
    """
    o, count = opacity.double(), copies.double()
    new = 1 - (1 - o) ** (1 / count)
    j = torch.arange(1, int(copies.max()) + 1 if len(copies) else 1, dtype=torch.float64, device=o.device)
    log_binomial = (
        torch.lgamma(count + 1)[:, None]
        - torch.lgamma(j + 1)
        - torch.lgamma((count[:, None] - j + 1).clamp(min=1))
    )
    terms = torch.exp(log_binomial + j * new.log()[:, None]) / j.sqrt() * (1 - 2 * ((j - 1) % 2))
    total = torch.where(j <= count[:, None], terms, 0).sum(-1)
    return new.to(opacity), (o / total).to(opacity)


def _randn(shape: tuple[int, ...], generator: torch.Generator, like: Tensor) -> Tensor:
    """Normal noise, the same on every device: drawn where the generator lives."""
    return torch.randn(shape, generator=generator, dtype=like.dtype, device=generator.device).to(like.device)
