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
from torch import Tensor

from ..errors import Cancelled, RunError
from ..progress import Progress
from . import weights
from .backgrounds import Backgrounds
from .bank import Mixed, OwnFlares, SynthesisBank
from .network import RemovalNetwork, inputs
from .pairs import Bank, Pair, pair
from .recipe import Recipe, as_dict, from_dict
from .synthesis.layers import flare
from .synthesis.prescription import Prescription

CHECKPOINT, WEIGHTS, LOG = "checkpoint.safetensors", "removal.safetensors", "training.jsonl"
CHECK_EVERY = 250
CHECK_SEED = 20_000
CHECKS = 40
CHECK_SIZE = (384, 256)


def device() -> torch.device:
    """The graphics card where there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


class Trainer:
    """Network, optimiser and flares at an iteration; what a step sees is a function of seed and iteration."""

    def __init__(self, recipe: Recipe, backgrounds: Backgrounds, lenses: Sequence[Prescription],
                 own: OwnFlares | None = None) -> None:
        self.recipe, self.iteration = recipe, 0
        self.device = device()
        self._backgrounds = backgrounds
        self._made = SynthesisBank(recipe.seed, recipe.bank, recipe.canvas, lenses)
        self._bank: Bank = Mixed(self._made, own, recipe.own_share) if own else self._made
        torch.manual_seed(recipe.seed)
        self.network = self._placed(RemovalNetwork(recipe.widths, recipe.depths))
        self.optimiser = torch.optim.AdamW(self.network.parameters(), recipe.learning_rate, betas=(0.9, 0.99),
                                           weight_decay=recipe.weight_decay, fused=True)
        self.averaged = {name: value.detach().clone() for name, value in self.network.state_dict().items()}

    def _placed(self, network: RemovalNetwork) -> RemovalNetwork:
        network.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        return network

    def fill(self, progress: Progress) -> None:
        """Make the flares that this iteration has at hand."""
        goal = self._serial()
        first = max(goal - len(self._made), 0)
        progress.stage("flares", goal - first)
        for number in range(first, goal):
            self._made.renew_to(number + 1)
            progress.advance()

    def _serial(self) -> int:
        return len(self._made) + self.iteration // self.recipe.renew_every

    def step(self) -> dict[str, float]:
        """One iteration; its figures."""
        recipe = self.recipe
        random = np.random.default_rng((recipe.seed, self.iteration))
        self._made.renew_to(self._serial())
        width, height = recipe.frame_size(random, self.iteration)
        count = max(round(recipe.pixels / (width * height)), 1)
        pairs = [pair(random, self._bank, self._backgrounds, width, height, clean=recipe.clean) for _ in range(count)]
        for group in self.optimiser.param_groups:
            group["lr"] = recipe.rate(self.iteration)
        loss, figures = self._loss(pairs)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        size = torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        if torch.isfinite(size):
            self.optimiser.step()
        self.iteration += 1
        keep = min(recipe.average, (1 + self.iteration) / (10 + self.iteration))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.averaged.values()), list(self.network.state_dict().values()), 1 - keep)
        return figures

    def _loss(self, pairs: Sequence[Pair]) -> tuple[Tensor, dict[str, float]]:
        """L1 and L2 of the two clean pictures, and the logarithm of the squared error of each, which asks as much of
        faint flares as of strong ones, down to `floor`; display values.

        A low floor lets the pictures without flare outweigh the others, and the network then learns to do nothing.
        """
        frame, scene, gentle = (self._stack([getattr(one, name) for one in pairs])
                                for name in ("frame", "scene", "gentle"))
        seen = inputs(frame).to(memory_format=torch.channels_last)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.recipe.half):
            told = self.network(seen)
        wrong, mild = frame - told.flare - scene, frame - told.gentle - gentle
        squared, distance = wrong.square().mean((1, 2, 3)), wrong.abs().mean()
        loss = (distance + 4 * squared.mean() + 0.5 * (mild.abs().mean() + 4 * mild.square().mean())
                + 0.02 * torch.log(squared + self.recipe.floor).mean())
        return loss, {"l1": float(distance.detach()),
                      "psnr": float(-10 * torch.log10(squared.detach() + 1e-6).mean())}

    def _stack(self, pictures: Sequence[Any]) -> Tensor:
        stacked = torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2)
        return stacked.to(self.device, memory_format=torch.channels_last)

    @torch.no_grad()
    def check(self, pairs: Mapping[str, Sequence[Pair]]) -> dict[str, float]:
        """PSNR gained over the untouched frame, dB, by class and on average, by the averaged weights."""
        network = RemovalNetwork(self.recipe.widths, self.recipe.depths)
        network.load_state_dict(self.averaged)
        self._placed(network)
        gains: dict[str, float] = {}
        for kind, some in pairs.items():
            values = []
            for one in some:
                frame, scene = self._stack([one.frame]), self._stack([one.scene])
                with torch.autocast(self.device.type, torch.bfloat16, enabled=self.recipe.half):
                    told = network(inputs(frame).to(memory_format=torch.channels_last))
                after = (frame - told.flare.clamp(min=0) - scene).clamp(min=-1).square().mean()
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
                # In the parameter's own order of memory, which the fused step takes for granted.
                moments = {key: torch.empty_like(parameter).copy_(state[f"moment.{key}.{name}"])
                           for key in ("exp_avg", "exp_avg_sq")}
                self.optimiser.state[parameter] = {**moments, "step": state[f"moment.step.{name}"].to(self.device)}


def checks(backgrounds: Backgrounds, lenses: Sequence[Prescription], count: int = CHECKS) -> dict[str, list[Pair]]:
    """Pairs that no training sees: other flares, lenses and backgrounds, some of each class."""
    from .synthesis.layers import CLASSES

    class One:
        def __init__(self, kind: str, number: int) -> None:
            self.kind, self.number = kind, number

        def draw(self, random: np.random.Generator) -> Any:
            from .pairs import Layers
            made = flare((CHECK_SEED, self.number, int(random.integers(1 << 30))), 384, lenses, self.kind)
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
        recipe = replace(recipe, widths=given.widths, depths=given.depths, seed=given.seed)
        iteration = int(kept["iteration"])
    elif start is not None:
        state, kept = weights.read(start)
        given = from_dict(json.loads(kept["recipe"]))
        recipe = replace(recipe, widths=given.widths, depths=given.depths)
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
