# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the network in the box: one iteration, its checks, its state, the run from begin to end."""
from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import Cancelled, RunError, SettingsError
from ..progress import Progress
from . import weights
from .backgrounds import Backgrounds
from .bank import OneFlare, OwnFlares
from .batches import Batch, Batches, drawn_ahead
from .learners import ALONE, Learner, add_up, shared
from .network import RemovalNetwork
from .pairs import Pair, pair
from .recipe import Recipe, as_dict
from .synthesis.layers import CLASSES
from .synthesis.prescription import Prescription

CHECKPOINT, WEIGHTS, LOG = "checkpoint.safetensors", "removal.safetensors", "training.jsonl"
CHECK_EVERY = 1000
CHECK_SEED = 20_000
CHECKS = 64
CHECK_SIZE, CHECK_CANVAS = (384, 256), 448
FAINT = (1e-3, 2e-4)
"""Mean square of a flare, to which the errors of fainter ones are compared: 30 dB, and from three quarters of a
training on falling to 37 dB."""
FIGURES = ("loss", "error", "untouched", "gain")
UNSEEN = 3e-5
"""Mean square of an error that is not seen: 45 dB."""
MOST_LEARNERS, MOST_PROCESSES = 4, 8
"""Large frames are not many in an iteration; beside a graphics card more than these do not draw faster than it
learns."""


def device() -> torch.device:
    """The graphics card where there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def processes_here() -> int:
    """A training is best shared among."""
    return min(os.cpu_count() or 1, MOST_PROCESSES if torch.cuda.is_available() else MOST_LEARNERS)


def _half_where_fast(on: torch.device) -> Any:
    """bfloat16 on processors that have it: on others torch's convolutions take 9 times as long with it as without."""
    if on.type == "cpu" and not torch.cpu.get_capabilities().get("avx512_bf16"):
        return nullcontext()
    return torch.autocast(on.type, dtype=torch.bfloat16)


class Trainer:
    """Network and optimiser at an iteration, of one of the learners."""

    def __init__(self, recipe: Recipe, learner: Learner = ALONE) -> None:
        self.recipe, self.iteration, self.learner = recipe, 0, learner
        self.device = device()
        torch.manual_seed(recipe.seed)
        self.network = RemovalNetwork(recipe.widths, recipe.blocks).to(self.device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # twice as fast here
        self.optimiser = torch.optim.AdamW(self.network.parameters(), recipe.learning_rate,
                                           weight_decay=recipe.decay, fused=True)
        self.averaged = {name: value.detach().clone() for name, value in self.network.state_dict().items()}

    def step(self, batch: Batch) -> dict[str, float]:
        """One iteration; its figures."""
        recipe = self.recipe
        for group in self.optimiser.param_groups:
            group["lr"] = recipe.rate(self.iteration)
        self.optimiser.zero_grad(set_to_none=True)
        figures = self._learned(batch)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        # The first steps' weights are not worth keeping for as long as later ones'.
        kept = min(recipe.average, (self.iteration + 1) / (self.iteration + 10))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.averaged.values()), list(self.network.state_dict().values()), 1 - kept)
        self.iteration += 1
        return figures

    def _learned(self, batch: Batch) -> dict[str, float]:
        """Set the gradients, and give the figures, of all learners' frames together."""
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
            add_up([*(parameter.grad for parameter in parameters if parameter.grad is not None), of_all])
            figures = dict(zip(FIGURES, of_all.tolist(), strict=True))
        return figures

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, float]]:
        """Of each picture the squared error in parts of the flare's own square to a power that rises from a half to
        one: at first strong flares lead, which are learned sooner, in the end faint ones count as much, and what
        is told where there is none counts for more. Over the last `polish` of a training the logarithm of the
        error in parts of that square, which is the picture's gain in PSNR; what a picture loses counts twice. At half
        the weight the same of the gentle part."""
        frame, scene, gentle = (torch.from_numpy(part).permute(0, 3, 1, 2).to(self.device)
                                for part in (batch.frame, batch.scene, batch.gentle))
        with _half_where_fast(self.device):
            told = self.network(frame)
        goals = torch.stack([frame - scene, frame - gentle])
        before = goals.square().mean((2, 3, 4))
        error = (torch.stack([told.flare, told.gentle]) - goals).square().mean((2, 3, 4))
        done = min(self.iteration / self.recipe.iterations, 1.0)
        faint = FAINT[0] * (FAINT[1] / FAINT[0]) ** max(4 * done - 3, 0.0)
        if done < 1 - self.recipe.polish:
            left = error / (before[0] + faint) ** (0.5 + 0.5 * done)
        else:
            left = torch.log((error + UNSEEN) / (before + UNSEEN))
            left = left + left.clamp(min=0)
        loss = left[0].mean() + 0.5 * left[1].mean()
        gain = 10 * torch.log10((before[0] + UNSEEN) / (error[0].detach() + UNSEEN))
        return loss, {"loss": float(loss.detach()), "error": float(error[0].detach().mean()),
                      "untouched": float(before[0].mean()), "gain": float(gain.mean())}

    @torch.no_grad()
    def check(self, pairs: Mapping[str, Sequence[Pair]]) -> dict[str, float]:
        """PSNR gained over the untouched frame, dB, by class and on average, by the averaged weights."""
        network = RemovalNetwork(self.recipe.widths, self.recipe.blocks)
        network.load_state_dict({name: value.cpu() for name, value in self.averaged.items()})
        gains: dict[str, float] = {}
        for kind, some in pairs.items():
            values = []
            for one in some:
                frame, scene = (torch.from_numpy(part).permute(2, 0, 1)[None] for part in (one.frame, one.scene))
                told = network(frame).flare.clamp(min=0)
                after = ((frame - told).clamp(min=0) - scene).square().mean()
                before = (frame - scene).square().mean()
                values.append(float(10 * torch.log10((before + 1e-6) / (after + 1e-6))))
            gains[kind] = round(float(np.mean(values)), 3)
        gains["mean"] = round(float(np.mean(list(gains.values()))), 3)
        return gains

    def state(self) -> dict[str, Tensor]:
        """Everything that a resumed training needs."""
        state = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        state |= {f"averaged.{name}": value for name, value in self.averaged.items()}
        for (name, _), moments in zip(self.network.named_parameters(), self.optimiser.state.values(), strict=False):
            state |= {f"moment.{key}.{name}": moments[key] for key in ("exp_avg", "exp_avg_sq", "step")}
        return {name: value.detach().cpu().contiguous() for name, value in state.items()}

    def load_state(self, state: Mapping[str, Tensor], iteration: int) -> None:
        """Go on from `state`, or from weights alone (then with fresh moments)."""
        self.iteration = iteration
        if not any(name.startswith("network.") for name in state):
            state = {f"{part}.{name}": value for name, value in state.items() for part in ("network", "averaged")}
        try:
            self.network.load_state_dict({name.removeprefix("network."): value.float()
                                          for name, value in state.items() if name.startswith("network.")})
        except RuntimeError as problem:
            raise RunError("The weights to go on from are of another network; give the recipe they were made "
                           "with.") from problem
        for name in self.averaged:
            self.averaged[name] = state[f"averaged.{name}"].float().to(self.device)
        for name, parameter in self.network.named_parameters():
            if f"moment.step.{name}" in state:
                moments = {key: state[f"moment.{key}.{name}"].to(self.device) for key in ("exp_avg", "exp_avg_sq")}
                self.optimiser.state[parameter] = {**moments, "step": state[f"moment.step.{name}"]}


def checks(backgrounds: Backgrounds, lenses: Sequence[Prescription], count: int = CHECKS) -> dict[str, list[Pair]]:
    """Pairs that no training sees: other flares, lenses and backgrounds, some of each class."""
    def bank(kind: str, number: int) -> OneFlare:
        return OneFlare((CHECK_SEED, number), CHECK_CANVAS, lenses, kind)

    return {kind: [pair(np.random.default_rng((CHECK_SEED, index, k)), bank(kind, k), backgrounds, *CHECK_SIZE,
                        clean=0)
                   for k in range(max(count // len(CLASSES), 1))]
            for index, kind in enumerate(CLASSES)}


def train(recipe: Recipe, folder: Path | str, backgrounds: Backgrounds, lenses: Sequence[Prescription], *,
          tests: tuple[Backgrounds, Sequence[Prescription]] | None = None, own: OwnFlares | None = None,
          resume: bool = False, start: Path | None = None, save_every_s: float = 300, processes: int | None = None,
          progress: Progress | None = None) -> Path:
    """Train in `folder` and give the path of the weights (safetensors, fp16).

    With `resume` a training in the folder goes on, by the given recipe from there on. `start`:
    weights to begin with. `tests`: backgrounds and lenses kept out, for the checks in the log. `processes` share the
    work, this one among them: the pictures are the same by any number, the weights but for rounding.
    Raises RunError, SettingsError, and Cancelled when asked to stop (after a checkpoint).
    """
    progress, folder = progress or Progress(), Path(folder)
    processes = processes_here() if processes is None else processes
    if processes < 1:
        raise SettingsError(f"A training has at least one process, not {processes}.")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / CHECKPOINT
    if path.exists() and not resume:
        raise RunError(f"{folder} holds a training already; go on with --resume, or choose another folder.")
    beginning = Beginning(recipe, path if path.exists() else start, path.exists(), backgrounds, lenses, own)
    trainer = beginning.trainer(ALONE)  # before others are asked: it may refuse
    with shared(1 if torch.cuda.is_available() else processes, _learn, beginning) as learner:
        trainer.learner = learner
        batches = drawn_ahead(beginning.batches(trainer), trainer.iteration, trainer.recipe.iterations,
                              processes - 1 if torch.cuda.is_available() else 0)
        held_out = checks(*tests) if tests else {}
        _run(trainer, batches, folder, held_out, save_every_s, progress)
    return folder / WEIGHTS


class Beginning(NamedTuple):
    """What every learner begins with: the same."""

    recipe: Recipe
    source: Path | None  # weights, or the checkpoint of the same training
    goes_on: bool
    backgrounds: Backgrounds
    lenses: Sequence[Prescription]
    own: OwnFlares | None

    def trainer(self, learner: Learner) -> Trainer:
        """Of the recipe, or that of the weights where they say otherwise. Raises RunError."""
        if self.source is None:
            return Trainer(self.recipe, learner)
        state, about = weights.read(self.source)
        widths, blocks = weights.form(self.source, about)
        recipe = replace(self.recipe, widths=widths, blocks=blocks)
        iteration = 0
        if self.goes_on:
            recipe = replace(recipe, seed=json.loads(about["recipe"])["seed"])
            iteration = int(about["iteration"])
        trainer = Trainer(recipe, learner)
        trainer.load_state(state, iteration)
        return trainer

    def batches(self, trainer: Trainer) -> Batches:
        """That the trainer's learner sees."""
        return Batches(trainer.recipe, self.backgrounds, self.lenses, self.own, trainer.learner)


def _learn(learner: Learner, beginning: Beginning) -> None:
    """What the learners beside the first do."""
    trainer = beginning.trainer(learner)
    batches = beginning.batches(trainer)
    while trainer.iteration < trainer.recipe.iterations:
        trainer.step(batches[trainer.iteration])


def _run(trainer: Trainer, batches: Iterator[Batch], folder: Path, held_out: Mapping[str, Sequence[Pair]],
         save_every_s: float, progress: Progress) -> None:
    """To the recipe's end, with log and checkpoints."""
    iterations = trainer.recipe.iterations
    progress.stage("train", iterations, trainer.iteration)
    saved, began, first = time.monotonic(), time.monotonic(), trainer.iteration
    told, sums = first, dict.fromkeys(FIGURES, 0.0)
    try:
        while trainer.iteration < iterations:
            figures = trainer.step(next(batches))
            sums = {name: value + figures[name] for name, value in sums.items()}
            here = trainer.iteration
            if here % CHECK_EVERY == 0 or here == iterations:
                line: dict[str, Any] = {"iteration": here, "seconds": round(time.monotonic() - began, 1),
                                        "pace": round((time.monotonic() - began) / (here - first), 3),
                                        **{name: round(value / (here - told), 5) for name, value in sums.items()}}
                told, sums = here, dict.fromkeys(FIGURES, 0.0)
                if held_out:
                    line["gain_db"] = trainer.check(held_out)
                with open(folder / LOG, "a", encoding="utf-8") as stream:
                    stream.write(json.dumps(line) + "\n")
            if time.monotonic() - saved > save_every_s:
                _save(trainer, folder)
                saved = time.monotonic()
            progress.advance(1, **figures)
    except Cancelled:
        _save(trainer, folder)
        raise
    _save(trainer, folder)


def _save(trainer: Trainer, folder: Path) -> None:
    about = {"recipe": json.dumps(as_dict(trainer.recipe)), "iteration": str(trainer.iteration)}
    weights.write(folder / CHECKPOINT, trainer.state(), about)
    half = {name: value.half().contiguous() for name, value in trainer.averaged.items()}
    weights.write(folder / WEIGHTS, half, about)
