# SPDX-License-Identifier: GPL-3.0-or-later
"""A fit from beginning to end, in a run folder that any stop leaves whole."""
from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterable
from pathlib import Path

import torch

from ..capture import Capture
from ..conventions.pixel_grid import Sampling
from ..conventions.run_files import CHECKPOINT, CONFIG, FLARE, LOG, METRICS, PREVIEW, SCENE, SMALL_PREVIEW
from ..errors import Cancelled, RunError
from ..flare import file as flare_file
from ..flare.file import FlareFile
from ..gaussians.ply import write_ply
from ..look import TrainedCamera, list_elements
from ..system.files import atomic_path, remove_file, remove_partial
from ..system.folder_lock import held
from ..system.progress import Progress
from . import checkpoint
from .metering import with_white
from .preview import row, spread, write_preview, write_small
from .rendering import render
from .run import Run
from .settings import FitSettings
from .trainer import Trainer
from .warnings import unlike

FIGURES_EVERY = 50
PREVIEW_ROWS = 4


def fit(capture: Capture, settings: FitSettings, folder: Path | str, progress: Progress | None = None, *,
        resume: bool = False) -> Run:
    """Fit scene and flare of a capture; the run's folder holds everything that comes of it.

    With `resume` an unfinished run in `folder` goes on from its checkpoint, with the settings it was begun
    with, and gives the fit that an unbroken one gives; without a run there, one is begun.

    Raises CaptureError, RunError, SettingsError, and Cancelled when asked to stop (after a checkpoint, if
    it has begun).
    """
    progress, folder = progress or Progress(), Path(folder)
    if resume and (folder / CONFIG).exists():
        with held(folder):
            run = Run.open(folder)
            _check_capture(run, capture)
            if run.finished:
                progress.say(f"The fit in {folder} is finished already.")
            else:
                trainer = Trainer(capture, run.settings, run.exposures)
                remove_partial(folder)
                if (folder / CHECKPOINT).exists():
                    trainer.load_state(checkpoint.load(folder / CHECKPOINT))
                else:
                    _say(trainer.says, run, progress)
                _carry_through(trainer, run, progress)
        return run
    settings, said = with_white(settings.checked(), capture)
    trainer = Trainer(capture, settings, progress=progress)  # before anything is written: it may refuse the capture
    with held(folder):
        run = Run.create(folder, settings, capture.folder, trainer.exposures)
        _say((*said, *trainer.says), run, progress)
        _carry_through(trainer, run, progress)
    return run


def _carry_through(trainer: Trainer, run: Run, progress: Progress) -> None:
    """From where the trainer stands to the results."""
    folder = run.folder
    _forget_after(folder / METRICS, trainer.iteration)
    _log(run, f"begun at iteration {trainer.iteration} of {run.settings.iterations}")
    progress.stage("fit", run.settings.iterations, trainer.iteration)
    with trainer.frames.cache.overflowing_into(folder):
        try:
            _train(trainer, run, progress)
        except Cancelled:
            checkpoint.save(folder / CHECKPOINT, trainer.state())
            _log(run, f"stopped at iteration {trainer.iteration}")
            raise
        _finish(trainer, run)
    if len(trainer.losses) == len(trainer.views):  # each has been looked at
        _say(unlike(trainer.losses), run, progress)
    _log(run, f"finished at iteration {trainer.iteration}")


def _say(texts: Iterable[str], run: Run, progress: Progress) -> None:
    """To the person who watches, and to the log."""
    for text in texts:
        progress.say(text)
        _log(run, text)


def _check_capture(run: Run, capture: Capture) -> None:
    """Raises RunError where the run was begun with another capture, which is still there: it did not move."""
    begun = run.capture_folder
    if begun.is_dir() and not begun.samefile(capture.folder):
        raise RunError(f"{run.folder} holds a fit of {begun}, not of {capture.folder}; choose another folder for this "
                       "one.")


def _train(trainer: Trainer, run: Run, progress: Progress) -> None:
    settings, path = run.settings, run.folder / CHECKPOINT
    saved, began, first = time.monotonic(), time.monotonic(), trainer.iteration
    while trainer.iteration < settings.iterations:
        figures = trainer.step()
        here = trainer.iteration
        if here % FIGURES_EVERY == 0 or here == settings.iterations:
            trainer.check_finite()
            counts = {"scene_gaussians": len(trainer.scene.means),
                      "flare_gaussians": trainer.flare.count if trainer.flare else 0}
            pace = (time.monotonic() - began) / (here - first)
            line = {"iteration": here, **figures, **counts, "seconds_per_iteration": round(pace, 5)}
            with open(run.folder / METRICS, "a", encoding="utf-8") as stream:
                stream.write(json.dumps(line) + "\n")
            figures = {**figures, **counts}
        if here % settings.preview_every == 0:
            _preview(trainer, run)
        # Saved before the progress speaks, since that is where a stop is noticed.
        if time.monotonic() - saved > settings.checkpoint_every_s:
            checkpoint.save(path, trainer.state())
            saved = time.monotonic()
        progress.advance(1, **figures)


def _finish(trainer: Trainer, run: Run) -> None:
    """Results first, the flare last and whole, then the checkpoint goes: a kill in between repeats the last steps, and
    loses nothing."""
    _preview(trainer, run)
    sampling = Sampling.of(trainer.frames.camera(view).focal_length for view in trainer.views)
    if not run.settings.scene.frozen:
        trainer.scene.sampling = sampling
    write_ply(run.folder / SCENE, trainer.scene)
    if trainer.flare is not None:
        camera = trainer.views[0].camera
        lens = TrainedCamera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        seen = trainer.flare.seen_from([torch.from_numpy(view.camera.world_to_camera) for view in trainer.views])
        with atomic_path(run.folder / FLARE) as unnamed:
            flare_file.save(unnamed, FlareFile(trainer.flare, run.settings.blend, lens, seen=seen,
                                                sampling=sampling))
            list_elements(unnamed)
    with contextlib.suppress(OSError):  # the fit is whole without that
        remove_file(run.folder / CHECKPOINT)


@torch.no_grad()
def _preview(trainer: Trainer, run: Run) -> None:
    """Some of the held-out views, or of all where none is held out."""
    _, held_out = trainer.capture.split(run.settings.holdout)
    views = held_out or trainer.views
    rows = []
    for index in spread(len(views), PREVIEW_ROWS):
        camera, frame, _ = trainer.frames.targets(views[index])
        view = render(trainer.scene, trainer.flare, run.settings.blend, camera, run.settings.kernels,
                      visibility=run.settings.flare.occluded_by_scene)
        rows.append(row(frame, view))
    write_preview(run.folder / PREVIEW, rows)
    if rows:
        write_small(run.folder / SMALL_PREVIEW, rows[len(rows) // 2])


def _forget_after(path: Path, iteration: int) -> None:
    """Drop the lines of figures that a resumed fit will make again."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            if json.loads(line)["iteration"] <= iteration:
                kept.append(line + "\n")
        except (ValueError, KeyError, TypeError):
            continue  # the line that a kill cut short
    with atomic_path(path) as temporary:
        temporary.write_text("".join(kept), encoding="utf-8", newline="\n")


def _log(run: Run, text: str) -> None:
    stamp = time.strftime("%Y-%m-%d %H:%M:%S")
    try:
        with open(run.folder / LOG, "a", encoding="utf-8") as stream:
            stream.write(f"{stamp}  {text}\n")
    except OSError as problem:
        raise RunError(f"{run.folder / LOG} cannot be written ({problem.strerror}); make room or choose another "
                       "folder.") from problem
