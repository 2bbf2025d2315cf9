# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a training of the removal network from start to end: workers, log, validation, checkpoints and weights.
`train-removal` calls `train`."""
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
from ...optics.prescription import Prescription
from ...system.files import write_text
from ...system.folder_lock import folder_lock
from ...system.processes import available_cores
from ...system.progress import Progress
from ...system.reading import is_finite_number, parse_json, read_text
from ..model import weights
from ..model.recipe import Recipe, as_dict, from_dict
from ..synthesis.flare import FLARE_CLASSES
from .backgrounds import Backgrounds
from .batches import Batch, Batches
from .flare_bank import SingleFlareBank, UserFlares
from .gpu.batches import open_gpu_batches
from .pairs import Pair, make_pair
from .trainer import METRICS, RemovalTrainer, default_device
from .workers import SINGLE_WORKER, Worker, worker_group

CHECKPOINT, WEIGHTS, LOG = "checkpoint.safetensors", "removal.safetensors", "training.jsonl"
GAIN = "gain_db"
"""Key of a validation gain in the log, and in the header of the weights that were written for it."""
VALIDATE_EVERY = 1000
VALIDATION_SEED = 20_000
VALIDATION_PAIRS = 64
VALIDATION_SIZE, VALIDATION_CANVAS = (384, 256), 448
MAX_WORKERS = 4
"""Workers on a CPU by default; an iteration has few large frames to share."""


def default_process_count() -> int:
    """Return how many processes share a training on this machine by default: workers on a CPU; beside a GPU, the
    processes that draw scenes and flares."""
    return min(available_cores(), MAX_WORKERS) if default_device().type == "cpu" else max(available_cores(), 3)


def make_validation_pairs(backgrounds: Backgrounds, lenses: Sequence[Prescription],
                          count: int = VALIDATION_PAIRS) -> dict[str, list[Pair]]:
    """Return about `count` pairs that no training sees, by flare class: other flares, lenses and backgrounds."""
    def bank(flare_class: str, number: int) -> SingleFlareBank:
        return SingleFlareBank((VALIDATION_SEED, number), VALIDATION_CANVAS, lenses, flare_class)

    return {flare_class: [make_pair(np.random.default_rng((VALIDATION_SEED, index, number)), bank(flare_class, number),
                                    backgrounds, *VALIDATION_SIZE, clean_share=0)
                          for number in range(max(count // len(FLARE_CLASSES), 1))]
            for index, flare_class in enumerate(FLARE_CLASSES)}


def read_recipe(folder: Path | str) -> Recipe | None:
    """Return the recipe of the training in a folder at its last checkpoint, or None if it holds none. Raises RunError
    where the checkpoint is damaged, SettingsError where an incompatible version wrote it."""
    path = Path(folder) / CHECKPOINT
    if not path.exists():
        return None
    _, metadata = weights.read_weights(path)
    weights.read_architecture(path, metadata)  # raises RunError if the file is no checkpoint
    return from_dict(parse_json(metadata["recipe"]))


def train(recipe: Recipe, folder: Path | str, backgrounds: Backgrounds, lenses: Sequence[Prescription], *,
          validation: tuple[Backgrounds, Sequence[Prescription]] | None = None, user_flares: UserFlares | None = None,
          resume: bool = False, start: Path | None = None, save_every_s: float = 300, processes: int | None = None,
          progress: Progress | None = None) -> Path:
    """Train in `folder` and return the path of the weights (safetensors, fp16).

    validation: backgrounds and lenses kept out of training; with them the log has validation gains, and the weights
    with the best gain are written. The last weights are written without `validation`, and with user_flares, which the
    validation pairs do not show. resume: continue the training in the folder, by the given recipe from there on. start:
    file of weights to begin with; the network gets their widths, and on each level the greater of their and the
    recipe's number of blocks. save_every_s: seconds between checkpoints. processes: how many processes share the work,
    this one included; on a CPU any number trains on the same pictures, to the same weights but for rounding.

    Raises RunError, SettingsError, and Cancelled after a checkpoint.
    """
    progress, folder = progress or Progress(), Path(folder)
    processes = default_process_count() if processes is None else processes
    if processes < 1:
        raise SettingsError(f"A training has at least one process, not {processes}.")
    with folder_lock(folder):
        checkpoint = folder / CHECKPOINT
        if checkpoint.exists() and not resume:
            raise RunError(f"{folder} holds a training already; resume it with --resume, or choose another folder.")
        resumes = checkpoint.exists()
        setup = TrainingSetup(recipe, checkpoint if resumes else start, resumes, backgrounds, lenses, user_flares)
        trainer = setup.create_trainer(SINGLE_WORKER)  # before other processes start: it may raise
        with worker_group(processes if trainer.device.type == "cpu" else 1, _run_worker, setup) as worker:
            trainer.worker = worker
            pairs = make_validation_pairs(*validation) if validation else {}
            with setup.open_batches(trainer, processes - 1) as batches:
                _run_to_end(trainer, batches, folder, pairs, bool(pairs) and user_flares is None, save_every_s,
                            progress)
    return folder / WEIGHTS


class TrainingSetup(NamedTuple):
    """Everything from which a worker starts its training."""

    recipe: Recipe
    source: Path | None  # file of weights to begin with, or the training's own checkpoint; None for random weights
    resumes: bool
    backgrounds: Backgrounds
    lenses: Sequence[Prescription]
    user_flares: UserFlares | None

    def create_trainer(self, worker: Worker) -> RemovalTrainer:
        """Return the trainer of a worker. Its network has the widths of the source's network and at least as many
        blocks. Raises RunError."""
        if self.source is None:
            return RemovalTrainer(self.recipe, worker)
        state, metadata = weights.read_weights(self.source)
        architecture = weights.read_architecture(self.source, metadata)
        recipe = replace(self.recipe, widths=architecture.widths,
                         blocks=tuple(map(max, self.recipe.blocks, architecture.blocks)),
                         attention=tuple(map(max, self.recipe.attention, architecture.attention)))
        iteration = 0
        if self.resumes:  # the checkpoint fits only its own architecture, and its seed determines the flares
            recipe = replace(recipe, **architecture._asdict(), seed=parse_json(metadata["recipe"])["seed"])
            iteration = int(metadata["iteration"])
        trainer = RemovalTrainer(recipe, worker)
        trainer.load_state(state, iteration)
        return trainer

    @contextmanager
    def open_batches(self, trainer: RemovalTrainer, drawing_processes: int = 0) -> Iterator[Iterator[Batch]]:
        """Yield the batches of the trainer's worker from its iteration on. On a GPU, `drawing_processes` processes draw
        the scenes and flares."""
        if trainer.device.type == "cpu":
            all_batches = Batches(trainer.recipe, self.backgrounds, self.lenses, self.user_flares, trainer.worker)
            yield (all_batches[iteration] for iteration in range(trainer.iteration, trainer.recipe.iterations))
        else:
            with open_gpu_batches(trainer.recipe, trainer.iteration, self.backgrounds, self.lenses, self.user_flares,
                                  trainer.device, max(drawing_processes, 2)) as batches:
                yield batches


def _run_worker(worker: Worker, setup: TrainingSetup) -> None:
    """Run a worker other than the first."""
    trainer = setup.create_trainer(worker)
    with setup.open_batches(trainer) as batches:
        for batch in batches:
            trainer.step(batch)


def _run_to_end(trainer: RemovalTrainer, batches: Iterator[Batch], folder: Path,
                pairs: Mapping[str, Sequence[Pair]], keeps_best: bool, save_every_s: float,
                progress: Progress) -> None:
    """Train to the recipe's end; write log, checkpoints and weights into `folder`.

    pairs: validation pairs by flare class; empty for no validation. keeps_best: write the weights of the best
    validation, not the last.
    """
    iterations = trainer.recipe.iterations
    progress.stage("train", iterations, trainer.iteration)
    last_saved, started, first_iteration = time.monotonic(), time.monotonic(), trainer.iteration
    last_logged, sums = first_iteration, dict.fromkeys(METRICS, 0.0)
    best = _read_best_gain(folder) if keeps_best and first_iteration else None
    log = _read_log(folder / LOG, first_iteration)
    try:
        while trainer.iteration < iterations:
            metrics = trainer.step(next(batches))
            if not math.isfinite(metrics["loss"]):
                raise RunError(f"The loss of iteration {trainer.iteration} is not finite; continue from the last "
                               f"checkpoint in {folder} with --resume and a lower learning_rate.")
            sums = {name: value + metrics[name] for name, value in sums.items()}
            iteration = trainer.iteration
            if iteration % VALIDATE_EVERY == 0 or iteration == iterations:
                means = {name: value / (iteration - last_logged) for name, value in sums.items()}
                log_entry = _log_entry(iteration, time.monotonic() - started, iteration - first_iteration, means)
                last_logged, sums = iteration, dict.fromkeys(METRICS, 0.0)
                if pairs:
                    log_entry[GAIN] = trainer.validate(pairs)
                    if keeps_best:
                        best = _write_weights_if_better(trainer, folder, log_entry[GAIN]["mean"], best)
                log.append(log_entry)
                write_text(folder / LOG, "".join(json.dumps(logged) + "\n" for logged in log))
            if time.monotonic() - last_saved > save_every_s:
                _save_checkpoint(trainer, folder, best)
                last_saved = time.monotonic()
            progress.advance(1, **metrics)
    except Cancelled:
        _save_checkpoint(trainer, folder, best)
        raise
    _save_checkpoint(trainer, folder, best)


def _log_entry(iteration: int, seconds: float, count: int, means: Mapping[str, float]) -> dict[str, Any]:
    """Return the entry of the log for an iteration.

    seconds, count: duration and number of the iterations since the training was started or resumed. means: of the
    metrics since the last entry.
    """
    return {"iteration": iteration, "seconds": round(seconds, 1), "pace": round(seconds / count, 3),
            **{name: round(value, 5) for name, value in means.items()}}


def _save_checkpoint(trainer: RemovalTrainer, folder: Path, best: float | None) -> None:
    """Write the checkpoint and, unless a validation has chosen weights (`best` is its gain, dB), the present
    weights."""
    weights.write_weights(folder / CHECKPOINT, trainer.state(), _metadata(trainer))
    if best is None:
        _write_weights(trainer, folder, _metadata(trainer))


def _write_weights_if_better(trainer: RemovalTrainer, folder: Path, gain: float, best: float | None) -> float:
    """Write the weights if their validation gain exceeds `best`, dB; return the best gain."""
    if best is not None and gain <= best:
        return best
    _write_weights(trainer, folder, {**_metadata(trainer), GAIN: str(gain)})
    return gain


def _read_log(path: Path, iteration: int) -> list[dict[str, Any]]:
    """Return the lines of a log up to an iteration, that of the checkpoint. Later lines were logged between the
    checkpoint and a kill; the resumed training logs them again."""
    lines: list[Any] = []
    for text in read_text(path, errors="replace").splitlines() if path.is_file() else ():
        with contextlib.suppress(ValueError):  # truncated by an earlier program
            lines.append(parse_json(text))
    return [line for line in lines
            if isinstance(line, dict) and is_finite_number(line.get("iteration")) and line["iteration"] <= iteration]


def _read_best_gain(folder: Path) -> float | None:
    """Return the validation gain of the weights in the folder, dB; None if there are none, or they were not validated.
    """
    path = folder / WEIGHTS
    if not path.exists():
        return None
    _, metadata = weights.read_weights(path)
    return float(metadata[GAIN]) if GAIN in metadata else None


def _write_weights(trainer: RemovalTrainer, folder: Path, metadata: Mapping[str, str]) -> None:
    half = {name: value.half().contiguous() for name, value in trainer.final_weights().items()}
    weights.write_weights(folder / WEIGHTS, half, metadata)


def _metadata(trainer: RemovalTrainer) -> dict[str, str]:
    return {"recipe": json.dumps(as_dict(trainer.recipe)), "iteration": str(trainer.iteration)}
