# SPDX-License-Identifier: GPL-3.0-or-later
"""One iteration of a training of the removal network: its loss, its step, and the state that a resumed training
continues from. `run` drives it."""
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
from .gpu.cuda_graphs import AsyncCopy, GraphedFunction
from .optimiser import MuonAdamW, has_bfloat16
from .pairs import Pair
from .workers import SINGLE_WORKER, Worker

METRICS = ("loss", "error", "untouched", "gain")
"""Logged per iteration, means over its frames: the loss, mean squares of the error and of the flare, the gain in PSNR.
They are keys of training.jsonl."""
FAINT_FLARE_MSE = (1e-3, 2e-4)
"""Mean square added to that of a flare, so that errors of fainter flares count less: 30 dB, falling to 37 dB from three
quarters of a training on."""
ERROR_FLOOR_MSE, ERROR_FLOOR_RAMP = (3e-4, 3e-5), 0.8
"""Mean square of an error that does not matter: 35 dB, falling to 45 dB until that share of a training. With 45 dB from
the start, pictures without flare have the larger part of the gradients, and predictions of obvious flares are held down
with the rest."""

PATCH_SIZE = 48
"""Side in pixels of the patches whose own gain counts beside the picture's, by the recipe's share."""

ZERO_INITIALISED = (".conv2.", ".proj.")
"""Parts of the names of the last convolutions of blocks and attention layers, which are zero before training."""


def default_device() -> torch.device:
    """Return the GPU if there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


class RemovalTrainer:
    """The network and the optimiser of one worker, and the iteration that they have reached."""

    def __init__(self, recipe: Recipe, worker: Worker = SINGLE_WORKER) -> None:
        """Build a network with random weights by the recipe's seed, the same for all workers, at iteration 0."""
        self.recipe, self.iteration, self.worker = recipe, 0, worker
        self.device = default_device()
        torch.manual_seed(recipe.seed)
        self.network = RemovalNetwork(recipe.widths, recipe.blocks, recipe.attention).to(self.device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # twice as fast on CPUs
        self.optimiser = MuonAdamW(self.network, recipe.weight_decay)
        self.averaged_weights = {name: value.detach().clone() for name, value in self.network.state_dict().items()}
        self.initial_weights: dict[str, Tensor] = {}  # empty unless the training begins with given weights
        # A CUDA graph cannot branch, so there is one for the PSNR phase and one for before.
        self._graphed_gradients = {phase: GraphedFunction(partial(self._gradients, phase)) for phase in (False, True)}
        self._pending_metrics: AsyncCopy | None = None
        if self.device.type == "cuda":
            torch.backends.cudnn.benchmark, torch.backends.cudnn.benchmark_limit = True, 4  # a minute for 5 shapes
            torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True

    def step(self, batch: Batch) -> dict[str, float]:
        """Run one iteration and return its metrics."""
        recipe = self.recipe
        metrics = self._backward(batch)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step(recipe.learning_rate_at(self.iteration), self.worker)
        # The average forgets faster at first, so that it does not keep the random weights of the start.
        decay = min(recipe.ema_decay, (self.iteration + 1) / (self.iteration + 10))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.averaged_weights.values()), list(self.network.state_dict().values()),
                                 1 - decay)
        self.iteration += 1
        return metrics

    def _backward(self, batch: Batch) -> dict[str, float]:
        """Compute the gradients and return the metrics, both over all workers' frames together."""
        if self.device.type != "cpu":
            return self._backward_on_gpu(batch)
        metrics = dict.fromkeys(METRICS, 0.0)
        if batch.share:
            loss, metrics = self.loss(batch)
            (loss * batch.share).backward()
        if self.worker.count > 1:
            reduced = torch.tensor([metrics[name] * batch.share for name in METRICS])
            parameters = list(self.network.parameters())
            for parameter in parameters:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
            self.worker.all_reduce([*(parameter.grad for parameter in parameters if parameter.grad is not None),
                                    reduced])
            metrics = dict(zip(METRICS, reduced.tolist(), strict=True))
        return metrics

    def _backward_on_gpu(self, batch: Batch) -> dict[str, float]:
        """Compute the gradients by the captured CUDA graph. Return the metrics of the previous iteration (of this one
        if it is the first), so that the CPU does not wait for the GPU."""
        psnr_phase, schedule = self._loss_schedule()
        schedule = schedule.pin_memory().to(self.device, non_blocking=True)
        *gradients, metrics = self._graphed_gradients[psnr_phase](batch.frame, batch.scene, batch.scene_with_glow,
                                                                  schedule)
        for parameter, gradient in zip(self.network.parameters(), gradients, strict=True):
            parameter.grad = gradient
        previous_metrics, self._pending_metrics = self._pending_metrics, AsyncCopy(metrics)
        return dict(zip(METRICS, (previous_metrics or self._pending_metrics).wait(), strict=True))

    def _gradients(self, psnr_phase: bool, frame: Tensor, scene: Tensor, scene_with_glow: Tensor,
                   schedule: Tensor) -> list[Tensor]:
        """Return the gradient of every parameter, then the metrics."""
        loss, metrics = self._compute_loss(psnr_phase, frame, scene, scene_with_glow, schedule)
        return [*torch.autograd.grad(loss, list(self.network.parameters())), metrics]

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """Return the loss at this iteration (`_compute_loss`), and the metrics."""
        psnr_phase, schedule = self._loss_schedule()
        frame, scene, scene_with_glow = (part.to(self.device)
                                         for part in (batch.frame, batch.scene, batch.scene_with_glow))
        loss, metrics = self._compute_loss(psnr_phase, frame, scene, scene_with_glow, schedule.to(self.device))
        return loss, dict(zip(METRICS, metrics.tolist(), strict=True))

    def _loss_schedule(self) -> tuple[bool, Tensor]:
        """Return (whether the training is in its PSNR phase, schedule (3,)). The schedule has the power that a flare's
        mean square is raised to, and the present values of FAINT_FLARE_MSE and ERROR_FLOOR_MSE."""
        progress = min(self.iteration / self.recipe.iterations, 1.0)
        faint_mse = FAINT_FLARE_MSE[0] * (FAINT_FLARE_MSE[1] / FAINT_FLARE_MSE[0]) ** max(4 * progress - 3, 0.0)
        first, last = ERROR_FLOOR_MSE
        error_floor = first * (last / first) ** min(progress / ERROR_FLOOR_RAMP, 1.0)
        return progress >= 1 - self.recipe.psnr_phase, torch.tensor([0.5 + 0.5 * progress, faint_mse, error_floor])

    def _compute_loss(self, psnr_phase: bool, frame: Tensor, scene: Tensor, scene_with_glow: Tensor,
                      schedule: Tensor) -> tuple[Tensor, Tensor]:
        """Return the loss, a scalar, and the METRICS, (4,).

        Before the PSNR phase, the loss of a picture is its mean squared error, divided by its flare's mean square to a
        power that rises from 0.5 to 1. So strong flares, which are learned sooner, count more at the start; at the end
        faint ones count as much. In the PSNR phase, the loss is the log of (mean squared error / flare's mean square),
        proportional to the negative gain in PSNR; pictures that get worse count twice. The recipe's patch_loss_share
        mixes this loss with its mean over patches. The prediction without glow has half the weight of the whole one.

        psnr_phase, schedule: the results of `_loss_schedule`, passed in so that one captured graph serves every
        iteration.
        """
        with _autocast(self.device):
            prediction = self.network(frame)
        # First axis: the whole flare, and the flare without glow. Pictures (2, n, 3, h, w), mean squares over the
        # channels (2, n, h, w), then over each picture (2, n).
        targets = torch.stack([frame - scene, frame - scene_with_glow])
        flares = targets.square().mean(2)
        errors = (torch.stack([prediction.flare, prediction.flare_without_glow]) - targets).square().mean(2)
        mean_flare, error = flares.mean((2, 3)), errors.mean((2, 3))
        power, faint_mse, error_floor = schedule.unbind()
        if psnr_phase:
            error_term = _log_error_ratio(error, mean_flare, error_floor)
            if self.recipe.patch_loss_share:
                patch_term = _log_error_ratio(_patch_means(errors), _patch_means(flares), error_floor).mean((2, 3))
                error_term = torch.lerp(error_term, patch_term, self.recipe.patch_loss_share)
        else:
            error_term = error / (mean_flare[0] + faint_mse) ** power
        loss = error_term[0].mean() + 0.5 * error_term[1].mean()
        with torch.no_grad():
            gain = 10 * torch.log10((mean_flare[0] + ERROR_FLOOR_MSE[1]) / (error[0] + ERROR_FLOOR_MSE[1]))
            metrics = torch.stack([loss.detach(), error[0].mean(), mean_flare[0].mean(), gain.mean()])
        return loss, metrics

    @torch.no_grad()
    def validate(self, pairs: Mapping[str, Sequence[Pair]]) -> dict[str, float]:
        """Return the PSNR gained over the untouched frame, dB, by class and on average, with the averaged weights."""
        network = RemovalNetwork(self.recipe.widths, self.recipe.blocks, self.recipe.attention)
        network.load_state_dict(self.final_weights())
        network.to(self.device)
        gains: dict[str, float] = {}
        for flare_class, class_pairs in pairs.items():
            values = []
            for pair in class_pairs:
                frame, scene = (torch.from_numpy(part).permute(2, 0, 1)[None].to(self.device)
                                for part in (pair.frame, pair.scene))
                prediction = network(frame).flare.clamp(min=0)
                error = ((frame - prediction).clamp(min=0) - scene).square().mean()
                input_error = (frame - scene).square().mean()
                # 1e-6 limits what a perfect prediction counts: a PSNR of 60 dB.
                values.append(float(10 * torch.log10((input_error + 1e-6) / (error + 1e-6))))
            gains[flare_class] = round(float(np.mean(values)), 3)
        gains["mean"] = round(float(np.mean(list(gains.values()))), 3)
        return gains

    def final_weights(self) -> dict[str, Tensor]:
        """Return the weights to write: averaged over iterations, and interpolated with the initial ones by the recipe's
        share.

        That recovers what a fine-tuning forgets (Wortsman et al. 2022, "Robust fine-tuning of zero-shot models").
        """
        return {name: value.lerp(self.initial_weights.get(name, value), self.recipe.initial_weights_mix)
                for name, value in self.averaged_weights.items()}

    def state(self) -> dict[str, Tensor]:
        """Return everything that a resumed training needs, on the CPU. Names begin with "network.", "averaged.",
        "initial." or the optimiser's "moment."."""
        state = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        state |= {f"averaged.{name}": value for name, value in self.averaged_weights.items()}
        state |= {f"initial.{name}": value for name, value in self.initial_weights.items()}
        state |= self.optimiser.state()
        return {name: value.detach().cpu().contiguous() for name, value in state.items()}

    def load_state(self, state: Mapping[str, Tensor], iteration: int) -> None:
        """Load what `state` returned, or the weights of a network, which may have fewer blocks and attention layers
        than this one: the added ones begin as the identity, and the optimiser's moments at zero.

        iteration: the iteration of the state; 0 for a new training, whose `initial_weights` become the loaded ones.
        Raises RunError where the weights do not fit.
        """
        self.iteration = iteration
        added: dict[str, Tensor] = {}
        if not any(name.startswith("network.") for name in state):
            added = {name: value.clone() for name, value in self.network.state_dict().items()
                     if name.startswith(("encoder.", "inner_attention.")) and name not in state}
            state = {f"{part}.{name}": value for name, value in {**added, **state}.items()
                     for part in ("network", "averaged")}
        try:
            self.network.load_state_dict({name.removeprefix("network."): value.float()
                                          for name, value in state.items() if name.startswith("network.")})
        except RuntimeError as problem:
            raise RunError("The weights to start from belong to another network; give the recipe they were "
                           "trained with.") from problem
        for name in self.averaged_weights:
            self.averaged_weights[name] = state[f"averaged.{name}"].to(self.device, torch.float32, copy=True)
        if iteration:
            self.initial_weights = {name.removeprefix("initial."): value.float().to(self.device)
                                    for name, value in state.items() if name.startswith("initial.")}
        else:
            # Added blocks begin as the identity, by their zero-initialised last convolutions; the random values of
            # their other convolutions are no weights to pull towards.
            self.initial_weights = {name: value.clone() for name, value in self.averaged_weights.items()
                                    if name not in added or any(part in name for part in ZERO_INITIALISED)}
        self.optimiser.load_state(state)


def _log_error_ratio(error: Tensor, flare_error: Tensor, error_floor: Tensor) -> Tensor:
    """Return the log of (error / flare_error), doubled where it is above 0, which means that the frame got worse.

    error, flare_error: mean squared errors of the result and of the untouched frame. error_floor: added to both.
    """
    log_ratio = torch.log((error + error_floor) / (flare_error + error_floor))
    return log_ratio + log_ratio.clamp(min=0)


def _patch_means(squared: Tensor) -> Tensor:
    """Return means over patches, the last of a row or column maybe narrower: (2, n, h, w) to (2, n, rows, columns)."""
    return F.avg_pool2d(squared, PATCH_SIZE, ceil_mode=True)


def _autocast(on: torch.device) -> Any:
    """Return the context of the forward pass: bfloat16 where the device is fast at it."""
    # Without cache: a replayed CUDA graph would read the cached weights of the step in which it was captured.
    return torch.autocast(on.type, dtype=torch.bfloat16, cache_enabled=False) if has_bfloat16(on) else nullcontext()
