# SPDX-License-Identifier: GPL-3.0-or-later
"""One iteration of a training of the network in the box: its loss, its step, and the state that goes on from there."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its name everywhere
from torch import Tensor

from ...errors import RunError
from ..model.network import RemovalNetwork
from ..model.recipe import Recipe
from .batches import Batch
from .gpu.cuda_graphs import OnItsWay, Recorded
from .optimiser import Optimiser, has_bfloat16
from .pairs import Pair
from .workers import ALONE, Learner

FIGURES = ("loss", "error", "untouched", "gain")
"""Of an iteration, means over its frames: the loss, mean squares of the error and of the flare, the gain in PSNR."""
FAINT = (1e-3, 2e-4)
"""Mean square of a flare, to which the errors of fainter ones are compared: 30 dB, and from three quarters of a
training on falling to 37 dB."""
UNSEEN, SEEN_FROM = (3e-4, 3e-5), 0.8
"""Mean square of an error that is not seen: 35 dB, from that share of a training on 45 dB. By 45 dB from the first
iteration on, pictures without any flare have the larger part of the gradients, and what is told of flares that are
plain to see is held down with the rest."""

PATCH = 48
"""Pixels a side of the patches of a picture whose own gains count beside the picture's, by the recipe's `local`."""

NOTHING_AT_FIRST = (".second.", ".told.")
"""In the names of the last convolutions of blocks and of layers of attention, which are zero before training."""


def device() -> torch.device:
    """The graphics card where there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


class Trainer:
    """Network and optimiser at an iteration, of one of the learners."""

    def __init__(self, recipe: Recipe, learner: Learner = ALONE) -> None:
        self.recipe, self.iteration, self.learner = recipe, 0, learner
        self.device = device()
        torch.manual_seed(recipe.seed)
        self.network = RemovalNetwork(recipe.widths, recipe.blocks, recipe.attention).to(self.device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # twice as fast here
        self.optimiser = Optimiser(self.network, recipe.decay)
        self.averaged = {name: value.detach().clone() for name, value in self.network.state_dict().items()}
        self.begun_with: dict[str, Tensor] = {}
        self._recorded = {polishes: Recorded(partial(self._gradients, polishes)) for polishes in (False, True)}
        self._latest: OnItsWay | None = None
        if self.device.type == "cuda":
            torch.backends.cudnn.benchmark, torch.backends.cudnn.benchmark_limit = True, 4  # a minute for five shapes
            torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True

    def step(self, batch: Batch) -> dict[str, float]:
        """One iteration; its figures."""
        recipe = self.recipe
        figures = self._backward(batch)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step(recipe.rate(self.iteration), self.learner)
        # The first steps' weights are not worth keeping for as long as later ones'.
        kept = min(recipe.average, (self.iteration + 1) / (self.iteration + 10))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.averaged.values()), list(self.network.state_dict().values()), 1 - kept)
        self.iteration += 1
        return figures

    def _backward(self, batch: Batch) -> dict[str, float]:
        """Set the gradients, and give the figures, of all learners' frames together."""
        if self.device.type != "cpu":
            return self._backward_on_card(batch)
        figures = dict.fromkeys(FIGURES, 0.0)
        if batch.share:
            loss, figures = self.loss(batch)
            (loss * batch.share).backward()
        if self.learner.count > 1:
            of_all = torch.tensor([figures[name] * batch.share for name in FIGURES])
            parameters = list(self.network.parameters())
            for parameter in parameters:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
            self.learner.add_up([*(parameter.grad for parameter in parameters if parameter.grad is not None), of_all])
            figures = dict(zip(FIGURES, of_all.tolist(), strict=True))
        return figures

    def _backward_on_card(self, batch: Batch) -> dict[str, float]:
        """As recorded; the figures are those of the iteration before, so that the card is not waited for."""
        polishes, numbers = self._goal()
        *gradients, figures = self._recorded[polishes](batch.frame, batch.scene, batch.gentle,
                                                       numbers.pin_memory().to(self.device, non_blocking=True))
        for parameter, gradient in zip(self.network.parameters(), gradients, strict=True):
            parameter.grad = gradient
        before, self._latest = self._latest, OnItsWay(figures)
        return dict(zip(FIGURES, (before or self._latest).arrived(), strict=True))

    def _gradients(self, polishes: bool, frame: Tensor, scene: Tensor, gentle: Tensor, numbers: Tensor) -> list[Tensor]:
        """Of every parameter, then the figures."""
        loss, figures = self._loss(polishes, frame, scene, gentle, numbers)
        return [*torch.autograd.grad(loss, list(self.network.parameters())), figures]

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """As of this iteration (`_loss`), and the figures."""
        polishes, numbers = self._goal()
        frame, scene, gentle = (part.to(self.device) for part in (batch.frame, batch.scene, batch.gentle))
        loss, figures = self._loss(polishes, frame, scene, gentle, numbers.to(self.device))
        return loss, dict(zip(FIGURES, figures.tolist(), strict=True))

    def _goal(self) -> tuple[bool, Tensor]:
        """Whether a training polishes by now; then the power, the mean square of a faint flare, and that of an error
        which is not seen."""
        done = min(self.iteration / self.recipe.iterations, 1.0)
        faint = FAINT[0] * (FAINT[1] / FAINT[0]) ** max(4 * done - 3, 0.0)
        unseen = UNSEEN[0] * (UNSEEN[1] / UNSEEN[0]) ** min(done / SEEN_FROM, 1.0)
        return done >= 1 - self.recipe.polish, torch.tensor([0.5 + 0.5 * done, faint, unseen])

    def _loss(self, polishes: bool, frame: Tensor, scene: Tensor, gentle: Tensor,
              numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Of each picture the squared error in parts of the flare's own square to a power that rises from a half to
        one: at first strong flares lead, which are learned sooner, in the end faint ones count as much, and what
        is told where there is none counts for more. Over the last `polish` of a training the logarithm of the
        error in parts of that square, which is the picture's gain in PSNR; what a picture loses counts twice. A
        share of that goal, `local`, is the mean of the same over patches of the picture. At half the weight the same of
        the gentle part. Then the FIGURES. `polishes` and `numbers` are those of `_goal`, given so that a card's record
        of this serves every iteration."""
        with _precision(self.device):
            told = self.network(frame)
        goals = torch.stack([frame - scene, frame - gentle])
        flares = goals.square().mean(2)
        errors = (torch.stack([told.flare, told.gentle]) - goals).square().mean(2)
        before, error = flares.mean((2, 3)), errors.mean((2, 3))
        power, faint, unseen = numbers.unbind()
        if polishes:
            left = _log_left(error, before, unseen)
            if self.recipe.local:
                in_patches = _log_left(_by_patch(errors), _by_patch(flares), unseen).mean((2, 3))
                left = torch.lerp(left, in_patches, self.recipe.local)
        else:
            left = error / (before[0] + faint) ** power
        loss = left[0].mean() + 0.5 * left[1].mean()
        with torch.no_grad():
            gain = 10 * torch.log10((before[0] + UNSEEN[1]) / (error[0] + UNSEEN[1]))
            figures = torch.stack([loss.detach(), error[0].mean(), before[0].mean(), gain.mean()])
        return loss, figures

    @torch.no_grad()
    def check(self, pairs: Mapping[str, Sequence[Pair]]) -> dict[str, float]:
        """PSNR gained over the untouched frame, dB, by class and on average, by the weights that are kept."""
        network = RemovalNetwork(self.recipe.widths, self.recipe.blocks, self.recipe.attention)
        network.load_state_dict(self.kept())
        network.to(self.device)
        gains: dict[str, float] = {}
        for kind, some in pairs.items():
            values = []
            for one in some:
                frame, scene = (torch.from_numpy(part).permute(2, 0, 1)[None].to(self.device)
                                for part in (one.frame, one.scene))
                told = network(frame).flare.clamp(min=0)
                after = ((frame - told).clamp(min=0) - scene).square().mean()
                before = (frame - scene).square().mean()
                values.append(float(10 * torch.log10((before + 1e-6) / (after + 1e-6))))
            gains[kind] = round(float(np.mean(values)), 3)
        gains["mean"] = round(float(np.mean(list(gains.values()))), 3)
        return gains

    def kept(self) -> dict[str, Tensor]:
        """The weights to keep: averaged over iterations, and with the recipe's share of those that the training began
        with, which wins back what it has forgotten (Wortsman et al. 2022, "Robust fine-tuning of zero-shot models")."""
        return {name: value.lerp(self.begun_with.get(name, value), self.recipe.begun)
                for name, value in self.averaged.items()}

    def state(self) -> dict[str, Tensor]:
        """Everything that a resumed training needs."""
        state = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        state |= {f"averaged.{name}": value for name, value in self.averaged.items()}
        state |= {f"begun.{name}": value for name, value in self.begun_with.items()}
        state |= self.optimiser.state()
        return {name: value.detach().cpu().contiguous() for name, value in state.items()}

    def load_state(self, state: Mapping[str, Tensor], iteration: int) -> None:
        """Go on from `state`, or from weights alone (then with fresh moments), of a network that may have fewer
        blocks and layers of attention: the others do nothing yet."""
        self.iteration = iteration
        grown: dict[str, Tensor] = {}
        if not any(name.startswith("network.") for name in state):
            grown = {name: value.clone() for name, value in self.network.state_dict().items()
                     if name.startswith(("enter.", "between.")) and name not in state}
            state = {f"{part}.{name}": value for name, value in {**grown, **state}.items()
                     for part in ("network", "averaged")}
        try:
            self.network.load_state_dict({name.removeprefix("network."): value.float()
                                          for name, value in state.items() if name.startswith("network.")})
        except RuntimeError as problem:
            raise RunError("The weights to go on from are of another network; give the recipe they were made "
                           "with.") from problem
        for name in self.averaged:
            self.averaged[name] = state[f"averaged.{name}"].to(self.device, torch.float32, copy=True)
        if iteration:
            self.begun_with = {name.removeprefix("begun."): value.float().to(self.device)
                               for name, value in state.items() if name.startswith("begun.")}
        else:
            # What has grown began with nothing, which is what the last of its convolutions say, not with what the
            # others were drawn as.
            self.begun_with = {name: value.clone() for name, value in self.averaged.items()
                               if name not in grown or any(part in name for part in NOTHING_AT_FIRST)}
        self.optimiser.load_state(state)


def _log_left(error: Tensor, before: Tensor, unseen: Tensor) -> Tensor:
    """The logarithm of squared errors in parts of what they were untouched; what has become worse counts twice."""
    left = torch.log((error + unseen) / (before + unseen))
    return left + left.clamp(min=0)


def _by_patch(squared: Tensor) -> Tensor:
    """Means over patches, of which the last of a row or column may be narrower: (2, n, h, w) to (2, n, rows,
    columns)."""
    return F.avg_pool2d(squared, PATCH, ceil_mode=True)


def _precision(on: torch.device) -> Any:
    # Weights that were cached in it would not be those of a recorded step's next time.
    return torch.autocast(on.type, dtype=torch.bfloat16, cache_enabled=False) if has_bfloat16(on) else nullcontext()
