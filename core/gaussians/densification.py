# SPDX-License-Identifier: GPL-3.0-or-later
"""Densification strategies: add, remove and relocate Gaussians while a scene is optimised.

A strategy changes a scene and its optimiser. The trainer calls it in every iteration, from 1:

    loss = ... + strategy.regulariser()
    loss.backward()
    strategy.observe(rendering)             # of this backward pass
    optimiser.step()
    changed = strategy.update(iteration)    # True if rows were moved, added or removed

`Classic` is the strategy of 3DGS (Kerbl et al. 2023, section 5.2; gsplat's DefaultStrategy), with an optional cap,
under which the largest gradients are densified first. `Mcmc` (Kheradmand et al. 2024; gsplat's MCMCStrategy) keeps to a
budget: it relocates dead Gaussians to live ones and injects noise into the means. Both are functions of their inputs
and the generator alone.
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
    """A densification strategy; the module's head has the order of calls."""

    def regulariser(self) -> Tensor | float: ...
    def observe(self, rendering: Rendering) -> None: ...
    def update(self, iteration: int) -> bool: ...
    def reorder(self, order: Tensor) -> None: ...
    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: Mapping[str, Any]) -> None: ...


@dataclass(frozen=True)
class ClassicSettings:
    """Settings of `Classic`. Iterations count from 1; scales are relative to the scene's extent."""

    start: int = 500
    stop: int = 15_000
    every: int = 100
    """Iterations between refinements (gsplat: refine_every)."""
    gradient: float = 2e-4
    """Mean norm of the gradient by the centre above which a Gaussian is densified, in normalised device coordinates
    (gsplat: grow_grad2d)."""
    small: float = 0.01
    """Scale up to which a Gaussian is cloned; above it, it is split in two (gsplat: grow_scale3d)."""
    large: float = 0.1
    """Scale above which a Gaussian is pruned, once opacities have been reset (gsplat: prune_scale3d)."""
    faint: float = 0.005
    """Opacity below which a Gaussian is pruned (gsplat: prune_opa)."""
    reset_every: int = 3000
    """Iterations between resets of all opacities to at most `reset_to`."""
    reset_to: float = 0.01
    cap: int | None = None
    """Largest number of Gaussians; None for no limit."""


class Classic:
    """The densification of 3DGS: clone, split, prune, reset opacities. extent: of the scene, world units
    (`Capture.extent`)."""

    SPLIT_SHRINK = 1.6  # divisor of the scales of a split Gaussian

    def __init__(
        self, scene: SceneGaussians, optimiser: Adam, extent: float, generator: torch.Generator,
        settings: ClassicSettings | None = None,
    ) -> None:  # fmt: skip
        self.scene, self.optimiser, self.generator = scene, optimiser, generator
        self.extent = extent
        self.settings = settings or ClassicSettings()
        self._is_over = False  # after `stop`, when nothing reads the statistics
        self._reset_statistics()

    def _reset_statistics(self) -> None:
        self.gradients = torch.zeros_like(self.scene.opacity_logits, requires_grad=False)
        self.views = torch.zeros_like(self.gradients)

    def regulariser(self) -> float:
        """Return 0: this strategy adds nothing to the loss."""
        return 0.0

    @torch.no_grad()
    def observe(self, rendering: Rendering) -> None:
        """Accumulate, for each visible Gaussian, the norm of the loss's gradient by its projected centre, and a
        count."""
        if self._is_over:
            return
        height, width = rendering.alpha.shape
        # From px^-1 to normalised device coordinates, in which the picture is 2 wide and 2 high.
        norms = torch.hypot(*(rendering.centre_gradients * rendering.alpha.new_tensor([width / 2, height / 2])).T)
        is_visible = rendering.radii > 0
        self.gradients += norms * is_visible
        self.views += is_visible

    @torch.no_grad()
    def update(self, iteration: int) -> bool:
        """Clone, split and prune Gaussians every `every` iterations, and lower all opacities to at most `reset_to`
        every `reset_every` iterations. Return whether rows were added or removed."""
        settings = self.settings
        self._is_over = iteration >= settings.stop
        if iteration > settings.stop:
            return False
        changed = False
        if iteration > settings.start and iteration % settings.every == 0:
            self._refine(prune_large=iteration > settings.reset_every)
            self._reset_statistics()
            changed = True
        # Not at `stop`: later iterations have to restore the opacities that are needed.
        if iteration % settings.reset_every == 0 and iteration < settings.stop:
            self.scene.opacity_logits.clamp_(max=math.log(settings.reset_to / (1 - settings.reset_to)))
            self.optimiser.reset_moments("opacity_logits")
        return changed

    def _refine(self, prune_large: bool) -> None:
        """Clone small and split large Gaussians of high mean gradient, and prune faint ones; with `prune_large` very
        large ones too (gsplat: _grow_gs and _prune_gs).

        Under a cap, those of the highest gradient are cloned or split first."""
        settings, scene = self.settings, self.scene
        size = scene.scales.amax(-1) / scene.units(self.extent)
        is_removed = scene.opacities < settings.faint
        if prune_large:
            is_removed |= size > settings.large * self.extent
        mean_gradient = self.gradients / self.views.clamp(min=1)
        is_grown = (mean_gradient > settings.gradient) & ~is_removed
        if settings.cap is not None:
            free_rows = max(0, settings.cap - int((~is_removed).sum()))
            if int(is_grown.sum()) > free_rows:  # a clone and a split each add one Gaussian
                candidates = mean_gradient.masked_fill(~is_grown, -1)
                highest = torch.argsort(candidates, descending=True, stable=True)[:free_rows]
                is_grown = torch.zeros_like(is_grown).index_fill_(0, highest, True)
        is_split = is_grown & (size > settings.small * self.extent)
        clones = {name: p.detach()[is_grown & ~is_split] for name, p in scene.named_parameters()}
        halves = self._split(is_split)
        self.optimiser.keep_rows(torch.nonzero(~is_removed & ~is_split)[:, 0])
        self.optimiser.append_rows(clones)
        self.optimiser.append_rows(halves)

    def _split(self, is_split: Tensor) -> dict[str, Tensor]:
        """Return the parameters, by name, of two smaller Gaussians for each one to split; their means are sampled from
        the one that is split. is_split: (n,) mask of these."""
        halves = {name: p.detach()[is_split].repeat_interleave(2, 0) for name, p in self.scene.named_parameters()}
        noise = _randn(halves["means"].shape, self.generator, halves["means"])
        offsets = rotation_matrices(halves["quaternions"]) @ (noise * halves["log_scales"].exp())[..., None]
        halves["means"] = halves["means"] + offsets[..., 0]
        halves["log_scales"] = halves["log_scales"] - math.log(self.SPLIT_SHRINK)
        return halves

    def reorder(self, order: Tensor) -> None:
        """Apply a new order of the scene's rows (n,) to the statistics."""
        self.gradients, self.views = self.gradients[order], self.views[order]

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a resumed fit restores."""
        return {"gradients": self.gradients, "views": self.views, "generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a `state_dict`."""
        self.gradients, self.views = (
            state[name].to(self.scene.opacity_logits) for name in ("gradients", "views")
        )
        self.generator.set_state(state["generator"])


@dataclass(frozen=True)
class McmcSettings:
    """Settings of `Mcmc`. Iterations count from 1."""

    cap: int = 50_000
    """Largest number of Gaussians (gsplat: cap_max)."""
    start: int = 500
    stop: int = 25_000
    every: int = 100
    """Iterations between refinements (gsplat: refine_every)."""
    growth: float = 1.05
    """Factor of the number of Gaussians at each refinement, until the cap."""
    faint: float = 0.005
    """Opacity up to which a Gaussian is dead and relocated (gsplat: min_opacity)."""
    noise: float = 5e5
    """Strength of the injected noise, relative to the learning rate of the means (gsplat: noise_lr)."""
    opacity_weight: float = 0.01
    scale_weight: float = 0.01


class Mcmc:
    """Relocation within a budget, and noise (3D Gaussian Splatting as Markov Chain Monte Carlo)."""

    NOISE_STEEPNESS = 100.0  # steepness of the sigmoid by which noise falls with opacity, about `faint`
    MAX_NOISE_OPACITY = 0.15  # above this opacity the noise is below 1e-6 of its full strength and omitted
    MAX_COPIES = 51  # of one Gaussian in one relocation, as in gsplat

    def __init__(
        self, scene: SceneGaussians, optimiser: Adam, generator: torch.Generator,
        settings: McmcSettings | None = None, extent: float = 1.0,
    ) -> None:  # fmt: skip
        """Begin with the scene and its optimiser.

        extent: size of the scene, world units; Gaussians of the far layer are measured relative to it.
        """
        self.scene, self.optimiser, self.generator = scene, optimiser, generator
        self.extent = extent
        self.settings = settings or McmcSettings()

    def regulariser(self) -> Tensor:
        """Return the penalty on opacities and scales (the paper's eq. 12), a scalar for the loss."""
        settings, units = self.settings, self.scene.units(self.extent)
        scales = self.scene.scales if isinstance(units, float) else self.scene.scales / units[:, None]
        return settings.opacity_weight * self.scene.opacities.mean() + settings.scale_weight * scales.mean()

    def observe(self, rendering: Rendering) -> None:
        """Do nothing: this strategy needs no statistics."""

    @torch.no_grad()
    def update(self, iteration: int) -> bool:
        """Relocate dead Gaussians and add new ones every `every` iterations, and inject noise in each iteration.

        Return whether rows were moved or added."""
        settings = self.settings
        changed = settings.start < iteration <= settings.stop and iteration % settings.every == 0
        if changed:
            self._relocate()
            self._add_copies()
        self._inject_noise()
        return changed

    def _relocate(self) -> None:
        """Turn dead Gaussians, whose opacity is at most `faint`, into copies of live ones, sampled by opacity.

        The moments of both are set to zero."""
        is_dead = self.scene.opacities <= self.settings.faint
        targets = torch.nonzero(is_dead)[:, 0]
        alive = torch.nonzero(~is_dead)[:, 0]
        if len(targets) == 0 or len(alive) == 0:
            return
        sources = alive[self._sample_rows(self.scene.opacities[alive], len(targets))]
        self._split_opacity(sources)
        for name, parameter in self.scene.named_parameters():
            parameter[targets] = parameter[sources]
            self.optimiser.reset_moments(name, torch.cat([sources, targets]))

    def _add_copies(self) -> None:
        """Add copies of Gaussians, sampled by opacity: `growth` times as many in all, at most `cap`."""
        n = len(self.scene)
        num_added = min(self.settings.cap, int(n * self.settings.growth)) - n
        if num_added <= 0:
            return
        sources = self._sample_rows(self.scene.opacities, num_added)
        self._split_opacity(sources)
        for name in dict(self.scene.named_parameters()):
            self.optimiser.reset_moments(name, sources)
        self.optimiser.append_rows({name: p.detach()[sources] for name, p in self.scene.named_parameters()})

    def _sample_rows(self, weights: Tensor, number: int) -> Tensor:
        """Return row numbers sampled in proportion to the weights, with replacement."""
        drawn = torch.multinomial(weights.cpu().double(), number, replacement=True, generator=self.generator)
        return drawn.to(weights.device)

    def _split_opacity(self, sources: Tensor) -> None:
        """Reduce opacity and scale of Gaussians that are about to be copied, so that a Gaussian and its copies together
        render as the Gaussian did alone.

        sources: row numbers of the Gaussians, each as often as it is copied."""
        rows, drawn = torch.unique(sources, return_counts=True)
        copies = (drawn + 1).clamp(max=self.MAX_COPIES)
        opacity, shrink = relocated_opacity_and_scale(self.scene.opacities[rows], copies)
        opacity = opacity.clamp(self.settings.faint, 1 - torch.finfo(opacity.dtype).eps)
        self.scene.opacity_logits[rows] = torch.logit(opacity)
        self.scene.log_scales[rows] += shrink.log()[:, None]

    def _inject_noise(self) -> None:
        """Add noise, multiplied by the Gaussian's covariance, to the means of nearly transparent Gaussians (the paper's
        eq. 9).

        Its strength falls with opacity by a sigmoid, and is proportional to the learning rate of the means."""
        rate = self.optimiser.rates["means"]
        opacities = self.scene.opacities
        rows = torch.nonzero(opacities < self.MAX_NOISE_OPACITY)[:, 0]
        if len(rows) == 0:
            return
        strength = torch.sigmoid(self.NOISE_STEEPNESS * (self.settings.faint - opacities[rows])) * self.settings.noise
        noise = _randn((len(rows), 3), self.generator, opacities) * strength[:, None] * rate
        units = self.scene.units(self.extent)
        if isinstance(units, Tensor):
            noise = noise / units[rows][:, None]  # the covariance grows as units², but steps are to grow as units
        axes = rotation_matrices(self.scene.quaternions[rows]) * self.scene.scales[rows][:, None, :]
        self.scene.means[rows] += (axes @ (axes.transpose(1, 2) @ noise[..., None]))[..., 0]

    def reorder(self, order: Tensor) -> None:
        """Do nothing: no state depends on the order of the rows."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a resumed fit restores."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a `state_dict`."""
        self.generator.set_state(state["generator"])


def relocated_opacity_and_scale(opacity: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacity and scale factor of `copies` equal Gaussians in one place that together render as one of
    `opacity`; all (n,). The same as gsplat's compute_relocation.

    For N copies of a Gaussian of opacity o, the new opacity o' = 1 - (1 - o)^(1/N) preserves alpha at the centre, and
    the scale factor o / sum_{j=1..N} (-1)^(j-1) C(N, j) o'^j / sqrt(j) preserves the integral of alpha along a line
    through the centre (Kheradmand et al. 2024, eq. 8, with its double sum over binomials in closed form).
    """
    o, count = opacity.double(), copies.double()
    new_opacity = 1 - (1 - o) ** (1 / count)
    j = torch.arange(1, int(copies.max()) + 1 if len(copies) else 1, dtype=torch.float64, device=o.device)
    log_binomial = (
        torch.lgamma(count + 1)[:, None]
        - torch.lgamma(j + 1)
        - torch.lgamma((count[:, None] - j + 1).clamp(min=1))
    )
    # The last factor is (-1)^(j-1).
    terms = torch.exp(log_binomial + j * new_opacity.log()[:, None]) / j.sqrt() * (1 - 2 * ((j - 1) % 2))
    total = torch.where(j <= count[:, None], terms, 0).sum(-1)
    return new_opacity.to(opacity), (o / total).to(opacity)


def _randn(shape: tuple[int, ...], generator: torch.Generator, like: Tensor) -> Tensor:
    """Sample normal noise on the generator's device, so that it is the same on every device."""
    return torch.randn(shape, generator=generator, dtype=like.dtype, device=generator.device).to(like.device)
