# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a fit from start to end in a run folder that any stop leaves whole; the entry of `core.fit`."""
from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import torch

from ..capture import Capture
from ..choices import Device
from ..conventions.pixel_grid import PixelGrid
from ..conventions.run_files import CHECKPOINT, CONFIG, FLARE, LOG, METRICS, PREVIEW, SMALL_PREVIEW
from ..errors import Cancelled, RunError
from ..flare import file as flare_file
from ..flare.file import FlareFile
from ..look import TrainedCamera, store_elements
from ..system.files import atomic_path, remove_file, remove_partials_below
from ..system.folder_lock import folder_lock
from ..system.progress import Progress
from ..system.reading import append_text, parse_json, read_text
from . import checkpoint
from .flare_trainer import FlareTrainer
from .initial_points import ensure_points
from .metering import resolve_white
from .plate_trainer import PlateTrainer
from .preview import preview_row, spread_indices, write_preview, write_small_preview
from .run import Run
from .settings import FitSettings
from .trainer import Trainer

METRICS_INTERVAL = 50
PREVIEW_ROWS = 4


def fit(capture: Capture, settings: FitSettings, folder: Path | str, progress: Progress | None = None, *,
        resume: bool = False, device: Device | None = None) -> Run:
    """Fit scene and flare of a capture; results, checkpoints, metrics and previews are written to the run's folder.

    With `resume`, an unfinished run in `folder` continues from its checkpoint with its own settings, and gives the same
    fit as an uninterrupted one; without a run there, one is started. device: that of a resumed fit, which may differ
    from that of its start, and then rounds otherwise; None for the run's own.

    Raises CaptureError, RunError, SettingsError, and Cancelled after a requested stop (with a checkpoint, if the fit
    had started).
    """
    progress, folder = progress or Progress(), Path(folder)
    if resume and (folder / CONFIG).exists():
        with folder_lock(folder):
            run = Run.open(folder, progress)
            run.settings = replace(run.settings, device=device or run.settings.device)
            _check_capture(run, capture)
            if run.finished:
                progress.say(f"The fit in {folder} is finished already.")
            else:
                capture, point_messages = ensure_points(capture, run.settings, progress)
                trainer = _make_trainer(capture, run.settings, run.exposures)
                remove_partials_below(folder)
                if (folder / CHECKPOINT).exists():
                    trainer.load_state(checkpoint.load(folder / CHECKPOINT))
                else:
                    _report((*point_messages, *trainer.warnings), run, progress)
                _run_to_end(trainer, run, progress)
        return run
    settings, warnings = resolve_white(settings.validated(), capture)
    capture, point_messages = ensure_points(capture, settings, progress)
    # Made before anything is written: it may refuse the capture.
    trainer = _make_trainer(capture, settings, progress=progress)
    with folder_lock(folder):
        run = Run.create(folder, settings, capture.folder, trainer.exposures)
        _report((*warnings, *point_messages, *trainer.warnings), run, progress)
        _run_to_end(trainer, run, progress)
    return run


def _make_trainer(capture: Capture, settings: FitSettings, exposures: Mapping[str, float] | None = None,
                  progress: Progress | None = None) -> FlareTrainer:
    """Return the trainer for the kind of scene that the settings name."""
    return (PlateTrainer if settings.uses_plates else Trainer)(capture, settings, exposures, progress)


def _run_to_end(trainer: FlareTrainer, run: Run, progress: Progress) -> None:
    """Train from the trainer's iteration on, and write the results.

    A requested stop writes a checkpoint and raises Cancelled. Start, stop and end are logged.
    """
    folder = run.folder
    _truncate_metrics(folder / METRICS, trainer.iteration)
    _log(run, f"started at iteration {trainer.iteration} of {run.settings.iterations}")
    progress.stage("fit", run.settings.iterations, trainer.iteration)
    with trainer.frames.cache.overflowing_into(folder):
        try:
            _train(trainer, run, progress)
        except Cancelled:
            checkpoint.save(folder / CHECKPOINT, trainer.state())
            _log(run, f"stopped at iteration {trainer.iteration}")
            raise
        _finish(trainer, run, progress)
    _report(trainer.final_warnings(), run, progress)
    _log(run, f"finished at iteration {trainer.iteration}")


def _report(texts: Iterable[str], run: Run, progress: Progress) -> None:
    """Report sentences to the user and to the log."""
    for text in texts:
        progress.say(text)
        _log(run, text)


def _check_capture(run: Run, capture: Capture) -> None:
    """Raise RunError if the run was made from another capture that still exists: a moved one is accepted."""
    expected = run.capture_folder
    if expected.is_dir() and not expected.samefile(capture.folder):
        raise RunError(f"{run.folder} holds a fit of {expected}, not of {capture.folder}; choose another folder for "
                       "this one.")


def _train(trainer: FlareTrainer, run: Run, progress: Progress) -> None:
    """Run the remaining iterations, with metrics, previews and checkpoints at their intervals."""
    settings, checkpoint_path = run.settings, run.folder / CHECKPOINT
    saved_at, started_at, first_iteration = time.monotonic(), time.monotonic(), trainer.iteration
    while trainer.iteration < settings.iterations:
        metrics = trainer.step()
        iteration = trainer.iteration
        if iteration % METRICS_INTERVAL == 0 or iteration == settings.iterations:
            trainer.check_finite()
            counts = {"scene_gaussians": trainer.scene_size,
                      "flare_gaussians": trainer.flare.count if trainer.flare else 0}
            pace = (time.monotonic() - started_at) / (iteration - first_iteration)
            line = {"iteration": iteration, **metrics, **counts, "seconds_per_iteration": round(pace, 5)}
            append_text(run.folder / METRICS, json.dumps(line) + "\n")
            metrics = {**metrics, **counts}
        if iteration % settings.preview_every == 0:
            _write_previews(trainer, run)
        # Saved before `advance`, which raises Cancelled after a requested stop.
        if time.monotonic() - saved_at > settings.checkpoint_every_s:
            checkpoint.save(checkpoint_path, trainer.state())
            saved_at = time.monotonic()
        progress.advance(1, **metrics)


def _finish(trainer: FlareTrainer, run: Run, progress: Progress) -> None:
    """Write the results, the flare last and whole, then delete the checkpoint.

    After a kill in between, a resumed fit repeats these steps and loses nothing.
    """
    light_messages = trainer.finish_lights(run.folder)
    _write_previews(trainer, run)
    pixel_grid = PixelGrid.from_focal_lengths(trainer.frames.camera(view).focal_length for view in trainer.views)
    trainer.finish(run.folder, pixel_grid, progress)
    _report(light_messages, run, progress)
    if trainer.flare is not None:
        camera = trainer.views[0].camera
        lens = TrainedCamera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        poses = [torch.from_numpy(view.camera.world_to_camera) for view in trainer.views]
        training_views = trainer.flare.training_views(poses, [view.name for view in trainer.views])
        with atomic_path(run.folder / FLARE) as temporary:
            flare_file.save(temporary, FlareFile(trainer.flare, run.settings.blend, lens, training_views=training_views,
                                                 pixel_grid=pixel_grid))
            store_elements(temporary)
    with contextlib.suppress(OSError):  # a checkpoint that stays does no harm
        remove_file(run.folder / CHECKPOINT)


@torch.no_grad()
def _write_previews(trainer: FlareTrainer, run: Run) -> None:
    """Write previews of some held-out views, or of some training views where none is held out."""
    _, held_out = trainer.capture.split(run.settings.holdout)
    views = held_out or trainer.views
    rows = [preview_row(trainer.frames.frame(views[index]), trainer.render_view(views[index]))
            for index in spread_indices(len(views), PREVIEW_ROWS)]
    write_preview(run.folder / PREVIEW, rows)
    if rows:
        write_small_preview(run.folder / SMALL_PREVIEW, rows[len(rows) // 2])


def _truncate_metrics(path: Path, iteration: int) -> None:
    """Drop the lines of a metrics file for iterations after `iteration`, which a resumed fit writes again."""
    if not path.exists():
        return
    lines = []
    for line in read_text(path, errors="replace").splitlines():
        try:
            if parse_json(line)["iteration"] <= iteration:
                lines.append(line + "\n")
        except (ValueError, KeyError, TypeError):
            continue  # a line that was cut short when the process was killed
    with atomic_path(path) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8", newline="\n")


def _log(run: Run, text: str) -> None:
    stamp = time.strftime("%Y-%m-%d %H:%M:%S")
    try:
        append_text(run.folder / LOG, f"{stamp}  {text}\n")
    except OSError as problem:
        raise RunError(f"{run.folder / LOG} cannot be written ({problem.strerror}); make room or choose another "
                       "folder.") from problem
