# SPDX-License-Identifier: GPL-3.0-or-later
"""A training of the network in the box from begin to end: shared among processes, logged, checked, kept."""
from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import Cancelled, RunError, SettingsError
from ...system.files import write_text
from ...system.folder_lock import held
from ...system.processes import cores
from ...system.progress import Progress
from ..model import weights
from ..model.recipe import Recipe, as_dict, from_dict
from ..synthesis.flare import CLASSES
from ..synthesis.prescription import Prescription
from .backgrounds import Backgrounds
from .batches import Batch, Batches
from .flare_bank import OneFlare, OwnFlares
from .gpu.batches import drawn_on_card
from .pairs import Pair, pair
from .trainer import FIGURES, Trainer, device
from .workers import ALONE, Learner, shared

CHECKPOINT, WEIGHTS, LOG = "checkpoint.safetensors", "removal.safetensors", "training.jsonl"
GAIN = "gain_db"  # of a check: in the log, and in the header of the weights that were kept for it
CHECK_EVERY = 1000
CHECK_SEED = 20_000
CHECKS = 64
CHECK_SIZE, CHECK_CANVAS = (384, 256), 448
MOST_LEARNERS = 4
"""Large frames are not many in an iteration."""


def processes_here() -> int:
    """How many processes a training is best shared among on this machine: learners on a processor; beside a graphics
    card that learns, those that draw scenes and flares."""
    return min(cores(), MOST_LEARNERS) if device().type == "cpu" else max(cores(), 3)


def checks(backgrounds: Backgrounds, lenses: Sequence[Prescription], count: int = CHECKS) -> dict[str, list[Pair]]:
    """Pairs that no training sees: other flares, lenses and backgrounds, some of each class."""
    def bank(kind: str, number: int) -> OneFlare:
        return OneFlare((CHECK_SEED, number), CHECK_CANVAS, lenses, kind)

    return {kind: [pair(np.random.default_rng((CHECK_SEED, index, k)), bank(kind, k), backgrounds, *CHECK_SIZE,
                        clean=0)
                   for k in range(max(count // len(CLASSES), 1))]
            for index, kind in enumerate(CLASSES)}


def recipe_in(folder: Path | str) -> Recipe | None:
    """By which the training in a folder went when it was last kept; None where it holds none. Raises RunError where its
    checkpoint is damaged, SettingsError where it is of a program that knew other recipes."""
    path = Path(folder) / CHECKPOINT
    if not path.exists():
        return None
    _, about = weights.read(path)
    weights.form(path, about)  # or it is none of ours
    return from_dict(json.loads(about["recipe"]))


def train(recipe: Recipe, folder: Path | str, backgrounds: Backgrounds, lenses: Sequence[Prescription], *,
          tests: tuple[Backgrounds, Sequence[Prescription]] | None = None, own: OwnFlares | None = None,
          resume: bool = False, start: Path | None = None, save_every_s: float = 300, processes: int | None = None,
          progress: Progress | None = None) -> Path:
    """Train in `folder` and give the path of the weights (safetensors, fp16).

    With `resume` a training in the folder goes on, by the given recipe from there on. `start`: weights to begin with,
    in a network of their widths and with as many blocks as they or the recipe have, whichever are more. `tests`:
    backgrounds and lenses kept out, for the checks in the log; the weights given are those of the best check then.
    Without them, and with flares of the user's own, which the checks have none of, they are the last. `processes`
    share the work, this one among them: on a processor the pictures are the same by any number, the weights but for
    rounding.
    Raises RunError, SettingsError, and Cancelled when asked to stop (after a checkpoint).
    """
    progress, folder = progress or Progress(), Path(folder)
    processes = processes_here() if processes is None else processes
    if processes < 1:
        raise SettingsError(f"A training has at least one process, not {processes}.")
    with held(folder):
        path = folder / CHECKPOINT
        if path.exists() and not resume:
            raise RunError(f"{folder} holds a training already; go on with --resume, or choose another folder.")
        beginning = Beginning(recipe, path if path.exists() else start, path.exists(), backgrounds, lenses, own)
        trainer = beginning.trainer(ALONE)  # before others are asked: it may refuse
        with shared(processes if trainer.device.type == "cpu" else 1, _learn, beginning) as learner:
            trainer.learner = learner
            held_out = checks(*tests) if tests else {}
            with beginning.batches(trainer, processes - 1) as batches:
                _run(trainer, batches, folder, held_out, bool(held_out) and own is None, save_every_s, progress)
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
        """Of the recipe, as wide as the weights' network and at least as deep. Raises RunError."""
        if self.source is None:
            return Trainer(self.recipe, learner)
        state, about = weights.read(self.source)
        form = weights.form(self.source, about)
        recipe = replace(self.recipe, widths=form.widths, blocks=tuple(map(max, self.recipe.blocks, form.blocks)),
                         attention=tuple(map(max, self.recipe.attention, form.attention)))
        iteration = 0
        if self.goes_on:
            recipe = replace(recipe, **form._asdict(), seed=json.loads(about["recipe"])["seed"])
            iteration = int(about["iteration"])
        trainer = Trainer(recipe, learner)
        trainer.load_state(state, iteration)
        return trainer

    @contextmanager
    def batches(self, trainer: Trainer, drawing: int = 0) -> Iterator[Iterator[Batch]]:
        """That the trainer's learner sees from its iteration on; on a card out of what `drawing` processes draw."""
        if trainer.device.type == "cpu":
            drawn = Batches(trainer.recipe, self.backgrounds, self.lenses, self.own, trainer.learner)
            yield (drawn[iteration] for iteration in range(trainer.iteration, trainer.recipe.iterations))
        else:
            with drawn_on_card(trainer.recipe, trainer.iteration, self.backgrounds, self.lenses, self.own,
                               trainer.device, max(drawing, 2)) as on_card:
                yield on_card


def _learn(learner: Learner, beginning: Beginning) -> None:
    """What the learners beside the first do."""
    trainer = beginning.trainer(learner)
    with beginning.batches(trainer) as batches:
        for batch in batches:
            trainer.step(batch)


def _run(trainer: Trainer, batches: Iterator[Batch], folder: Path, held_out: Mapping[str, Sequence[Pair]],
         chosen: bool, save_every_s: float, progress: Progress) -> None:
    """To the recipe's end, with log and checkpoints; the weights are `chosen` by the checks, or the last."""
    iterations = trainer.recipe.iterations
    progress.stage("train", iterations, trainer.iteration)
    saved, began, first = time.monotonic(), time.monotonic(), trainer.iteration
    told, sums = first, dict.fromkeys(FIGURES, 0.0)
    best = _best_of(folder) if chosen and first else None
    log = _log_until(folder / LOG, first)
    try:
        while trainer.iteration < iterations:
            figures = trainer.step(next(batches))
            if not math.isfinite(figures["loss"]):
                raise RunError(f"Iteration {trainer.iteration} of the training came to no number; go on from the last "
                               f"checkpoint in {folder} with --resume and a lower learning_rate.")
            sums = {name: value + figures[name] for name, value in sums.items()}
            here = trainer.iteration
            if here % CHECK_EVERY == 0 or here == iterations:
                line: dict[str, Any] = {"iteration": here, "seconds": round(time.monotonic() - began, 1),
                                        "pace": round((time.monotonic() - began) / (here - first), 3),
                                        **{name: round(value / (here - told), 5) for name, value in sums.items()}}
                told, sums = here, dict.fromkeys(FIGURES, 0.0)
                if held_out:
                    line[GAIN] = trainer.check(held_out)
                    if chosen:
                        best = _keep_better(trainer, folder, line[GAIN]["mean"], best)
                log.append(line)
                write_text(folder / LOG, "".join(json.dumps(one) + "\n" for one in log))
            if time.monotonic() - saved > save_every_s:
                _save(trainer, folder, best)
                saved = time.monotonic()
            progress.advance(1, **figures)
    except Cancelled:
        _save(trainer, folder, best)
        raise
    _save(trainer, folder, best)


def _save(trainer: Trainer, folder: Path, best: float | None) -> None:
    """The checkpoint; the weights too where there are none of a check. Those are better than the last, when a training
    begins to know its photographs by heart."""
    weights.write(folder / CHECKPOINT, trainer.state(), _about(trainer))
    if best is None:
        _write_kept(trainer, folder, _about(trainer))


def _keep_better(trainer: Trainer, folder: Path, gain: float, best: float | None) -> float:
    """Keep the weights when their check gains more than `best`, dB; the best gain then."""
    if best is not None and gain <= best:
        return best
    _write_kept(trainer, folder, {**_about(trainer), GAIN: str(gain)})
    return gain


def _log_until(path: Path, iteration: int) -> list[dict[str, Any]]:
    """The lines of a log up to an iteration: those of a training that was killed after its last checkpoint are told
    anew."""
    lines: list[dict[str, Any]] = []
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
        with contextlib.suppress(ValueError):  # cut off by an earlier program
            lines.append(json.loads(text))
    return [line for line in lines if line.get("iteration", math.inf) <= iteration]


def _best_of(folder: Path) -> float | None:
    """What the weights in the folder gained in their check, dB; None where they are of none, or not there."""
    path = folder / WEIGHTS
    if not path.exists():
        return None
    _, about = weights.read(path)
    return float(about[GAIN]) if GAIN in about else None


def _write_kept(trainer: Trainer, folder: Path, about: Mapping[str, str]) -> None:
    half = {name: value.half().contiguous() for name, value in trainer.kept().items()}
    weights.write(folder / WEIGHTS, half, about)


def _about(trainer: Trainer) -> dict[str, str]:
    return {"recipe": json.dumps(as_dict(trainer.recipe)), "iteration": str(trainer.iteration)}
