# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of the network in the box: one iteration, its checks, its state, the run from begin to end."""
from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - its name everywhere
from numpy.typing import NDArray
from torch import Tensor

from ..errors import Cancelled, RunError
from ..progress import Progress
from . import weights
from .backgrounds import Backgrounds
from .bank import Mixed, OwnFlares, SynthesisBank
from .network import CELL, INPUTS, RemovalNetwork, inputs
from .pairs import Bank, Pair, pair
from .recipe import Recipe, as_dict, from_dict
from .synthesis.layers import flare
from .synthesis.prescription import Prescription

CHECKPOINT, WEIGHTS, LOG = "checkpoint.safetensors", "removal.safetensors", "training.jsonl"
CHECK_EVERY = 250
CHECK_SEED = 20_000
CHECKS = 40
CHECK_SIZE = (192, 128)


def device() -> torch.device:
    """The graphics card where there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def cells_of(one: Pair, which: NDArray[np.int64]) -> tuple[Tensor, Tensor]:
    """Inputs (n, INPUTS) and goals (n, 7) of some cells of a pair: what the flare adds, its gentle part, weight."""
    parts = (one.frame, one.scene, one.gentle)
    frame, scene, gentle = (torch.from_numpy(part).permute(2, 0, 1)[None] for part in parts)
    added = F.avg_pool2d(torch.cat([frame - scene, frame - gentle], 1), CELL)[0].flatten(1).T
    weight = 0.01 / (float((frame - scene).square().mean()) + 0.002)
    seen = inputs(frame)[0].flatten(1).T
    index = torch.from_numpy(which % len(seen))
    return seen[index], torch.cat([added[index], torch.full((len(index), 1), min(max(weight, 0.3), 5.0))], 1)


class Trainer:
    """Network, optimiser, flares and store of cells at an iteration; what a step sees is a function of seed and
    iteration."""

    def __init__(self, recipe: Recipe, backgrounds: Backgrounds, lenses: Sequence[Prescription],
                 own: OwnFlares | None = None) -> None:
        self.recipe, self.iteration = recipe, 0
        self.device = device()
        self._backgrounds = backgrounds
        self._made = SynthesisBank(recipe.seed, recipe.bank, recipe.canvas, lenses)
        self._bank: Bank = Mixed(self._made, own, recipe.own_share) if own else self._made
        self._seen = torch.zeros((recipe.store, recipe.frames * recipe.cells, INPUTS))
        self._goals = torch.zeros((recipe.store, recipe.frames * recipe.cells, 7))
        torch.manual_seed(recipe.seed)
        self.network = RemovalNetwork(recipe.widths).to(self.device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), recipe.learning_rate)
        self.averaged = {name: value.detach().clone() for name, value in self.network.state_dict().items()}

    def fill(self, progress: Progress) -> None:
        """Make the flares and the cells that this iteration has at hand."""
        goal = self._serial(self.iteration)
        first = max(goal - len(self._made), 0)
        progress.stage("flares", goal - first)
        for number in range(first, goal):
            self._made.renew_to(number + 1)
            progress.advance()
        progress.stage("frames", self.recipe.store)
        for number in range(self.iteration - self.recipe.store, self.iteration):
            self._draw(number)
            progress.advance()
        if self.iteration == 0:
            self.network.mean.copy_(self._seen.mean((0, 1)))
            self.network.spread.copy_(self._seen.std((0, 1)) + 1e-3)

    def _serial(self, iteration: int) -> int:
        return len(self._made) + iteration // self.recipe.renew_every

    def _draw(self, number: int) -> None:
        """Put the cells of the frames of an iteration (negative: of those before the first) into the store. A resumed
        training draws them again, under the flares that are at hand then."""
        random = np.random.default_rng((self.recipe.seed, number + (1 << 30)))
        parts = []
        for _ in range(self.recipe.frames):
            one = pair(random, self._bank, self._backgrounds, *self.recipe.frame_size(random), clean=self.recipe.clean)
            parts.append(cells_of(one, random.integers(1 << 40, size=self.recipe.cells)))
        slot = number % self.recipe.store
        self._seen[slot] = torch.cat([seen for seen, _ in parts])
        self._goals[slot] = torch.cat([goals for _, goals in parts])

    def step(self) -> dict[str, float]:
        """One iteration; its figures."""
        recipe = self.recipe
        self._made.renew_to(self._serial(self.iteration))
        self._draw(self.iteration)
        chosen = torch.Generator().manual_seed(recipe.seed * (1 << 32) + self.iteration)
        for group in self.optimiser.param_groups:
            group["lr"] = recipe.rate(self.iteration)
        seen, goals = self._seen.flatten(0, 1), self._goals.flatten(0, 1)
        figures: dict[str, float] = {}
        for _ in range(recipe.steps):
            which = torch.randint(len(seen), (recipe.batch,), generator=chosen)
            loss, figures = self.loss(seen[which].to(self.device), goals[which].to(self.device))
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
            self.optimiser.step()
            with torch.no_grad():
                for name, value in self.network.state_dict().items():
                    self.averaged[name].lerp_(value, 1 - recipe.average)
        self.iteration += 1
        return figures

    def loss(self, seen: Tensor, goals: Tensor) -> tuple[Tensor, dict[str, float]]:
        """L1 and L2 of what the flare adds, and of its gentle part at half the weight; cells of pictures with a
        faint flare, or none, count for more, since there an error is seen."""
        told = self.network.cells(seen)
        wrong = (told - goals[:, :6])
        each = wrong.abs() + 4 * wrong.square()
        loss = (goals[:, 6:] * (each[:, :3] + 0.5 * each[:, 3:])).mean()
        return loss, {"l1": float(wrong[:, :3].detach().abs().mean()),
                      "untouched": float(goals[:, :3].abs().mean())}

    @torch.no_grad()
    def check(self, pairs: Mapping[str, Sequence[Pair]]) -> dict[str, float]:
        """PSNR gained over the untouched frame, dB, by class and on average, by the averaged weights."""
        network = RemovalNetwork(self.recipe.widths)
        network.load_state_dict({name: value.cpu() for name, value in self.averaged.items()})
        gains: dict[str, float] = {}
        for kind, some in pairs.items():
            values = []
            for one in some:
                frame, scene = (torch.from_numpy(part).permute(2, 0, 1)[None] for part in (one.frame, one.scene))
                told = network(inputs(frame)).flare.clamp(min=0)
                after = ((frame - told).clamp(min=0) - scene).square().mean()
                before = (frame - scene).square().mean()
                values.append(float(10 * torch.log10((before + 1e-8) / (after + 1e-8))))
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
    from .synthesis.layers import CLASSES

    class One:
        def __init__(self, kind: str, number: int) -> None:
            self.kind, self.number = kind, number

        def draw(self, random: np.random.Generator) -> Any:
            from .pairs import Layers
            made = flare((CHECK_SEED, self.number, int(random.integers(1 << 30))), 224, lenses, self.kind)
            return Layers(made.rest, made.glare, made.light, made.lights)

    return {kind: [pair(np.random.default_rng((CHECK_SEED, index, k)), One(kind, k), backgrounds, *CHECK_SIZE, clean=0)
                   for k in range(max(count // len(CLASSES), 1))]
            for index, kind in enumerate(CLASSES)}


def train(recipe: Recipe, folder: Path | str, backgrounds: Backgrounds, lenses: Sequence[Prescription], *,
          tests: tuple[Backgrounds, Sequence[Prescription]] | None = None, own: OwnFlares | None = None,
          resume: bool = False, start: Path | None = None, save_every_s: float = 300,
          progress: Progress | None = None) -> Path:
    """Train in `folder` and give the path of the weights (safetensors, fp16).

    With `resume` a training in the folder goes on, by the given recipe from there on. `start`:
    weights to begin with. `tests`: backgrounds and lenses kept out, for the checks in the log.
    Raises RunError, SettingsError, and Cancelled when asked to stop (after a checkpoint).
    """
    progress, folder = progress or Progress(), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / CHECKPOINT
    if path.exists() and not resume:
        raise RunError(f"{folder} holds a training already; go on with --resume, or choose another folder.")
    state: Mapping[str, Tensor] = {}
    iteration = 0
    if path.exists():
        state, kept = weights.read(path)
        given = from_dict(json.loads(kept["recipe"]))
        recipe = replace(recipe, widths=given.widths, seed=given.seed)
        iteration = int(kept["iteration"])
    elif start is not None:
        state, kept = weights.read(start)
        given = from_dict(json.loads(kept["recipe"]))
        recipe = replace(recipe, widths=given.widths)
    trainer = Trainer(recipe, backgrounds, lenses, own)
    if state:
        trainer.load_state(state, iteration)
    trainer.fill(progress)
    held_out = checks(*tests) if tests else {}
    progress.stage("train", recipe.iterations, trainer.iteration)
    saved, began, first = time.monotonic(), time.monotonic(), trainer.iteration
    sums: dict[str, float] = {}
    try:
        while trainer.iteration < recipe.iterations:
            figures = trainer.step()
            sums = {name: sums.get(name, 0.0) + value for name, value in figures.items()}
            here = trainer.iteration
            if here % CHECK_EVERY == 0 or here == recipe.iterations:
                line: dict[str, Any] = {"iteration": here, "seconds": round(time.monotonic() - began, 1),
                                        "pace": round((time.monotonic() - began) / (here - first), 3),
                                        **{name: round(value / CHECK_EVERY, 5) for name, value in sums.items()}}
                sums = {}
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
    return folder / WEIGHTS


def _save(trainer: Trainer, folder: Path) -> None:
    about = {"recipe": json.dumps(as_dict(trainer.recipe)), "iteration": str(trainer.iteration)}
    weights.write(folder / CHECKPOINT, trainer.state(), about)
    half = {name: value.half().contiguous() for name, value in trainer.averaged.items()}
    weights.write(folder / WEIGHTS, half, about)
