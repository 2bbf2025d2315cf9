# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes a scene: reads it in short steps, so that the window stays responsive, then starts the process that draws.

The process is the engine. Without one it is Blender's own Python, which draws with numpy, slower. `operators.bake`
starts a bake; the panel Bake shows it.
"""
from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import FitFlareError, RunError, os_error_message
from ..core.system.files import remove_file, write_json
from ..core.system.processes import available_cores
from ..core.system.steps import Steps, finish
from . import engine, jobs, lamp_drive, looks, shots
from .compositor.flare_node import find_node
from .compositor.trees import forget_composited_frames
from .shots import ShotReading
from .turns import INTERVAL_S, run_turn
from .views import redraw_viewports

MAX_PROCESSES = 8
"""Most processes that draw without an engine; each needs about a gigabyte for frames of 4K."""


class Preparation:
    """A scene that is being read for a bake."""

    def __init__(self, reading: ShotReading, own_folder: bool, folder: Path) -> None:
        """Prepare the bake of a scene.

        own_folder: the layers of a single camera have a subfolder too. folder: where the layers are written.
        """
        self.reading = reading
        self._own_folder, self._folder = own_folder, folder
        self.steps = self._read_and_start()

    @property
    def fraction_done(self) -> float:
        """The part of the frames that is read, 0..1."""
        return self.reading.done / max(self.reading.total, 1)

    def end(self) -> None:
        """Restore the timeline; leave no half-written shot."""
        self.steps.close()
        self.reading.restore()

    def _read_and_start(self) -> Steps[None]:
        """Read the scene frame by frame, write the shot file, and start the process that bakes it."""
        while self.reading.done < self.reading.total:
            self.reading.step()
            yield
        self.reading.restore()
        yield
        scene = self.reading.scene
        shot = self.reading.shot(looks.look_of(scene).path.resolve(), shots.run_to_bake(scene))
        shot = replace(shot, own_folder=self._own_folder)
        yield from shot.write_in_steps(self._folder / shots.SHOT_FILE)
        scene = self.reading.scene  # an undo between two steps replaces it
        if scene.fit_flare.bake_live:
            write_json(self._folder / shots.LIVE_FILE, shots.live_record(scene.fit_flare, shot.lights))
        else:
            remove_file(self._folder / shots.LIVE_FILE)
        yield
        _start_process(self._folder, len(shot.frames))


_preparation: Preparation | None = None
_last_error = ""


def preparation() -> Preparation | None:
    """Return the scene that is being read now; None without one."""
    return _preparation


def last_error(scene: Any) -> str:
    """Return why the last reading of this scene ended early; "" where it did not."""
    return _last_error if _preparation is None and _last_error and scene.name == _last_scene else ""


_last_scene = ""


def is_baking(scene: Any) -> bool:
    """Return whether this scene is read for a bake, or its layers are being baked."""
    if _preparation is not None and _preparation.reading.scene_name == scene.name:
        return True
    job = jobs.find_job(shots.layers_folder(scene)) if scene.fit_flare.layers else None
    return job is not None and job.running


def why_not_bake(scene: Any) -> str:
    """Return why the scene cannot be baked now, for the tooltip; "" where it can."""
    if is_baking(scene) or _preparation is not None:
        return "A bake is running"
    if scene.fit_flare.bake_scene and engine.find_engine() is None:
        return f"Fitted Scene Too needs the engine. {engine.missing_reason()}"
    # Without any engine Blender's Python draws; one that is configured but missing is an error.
    return engine.missing_reason() if engine.configured_engine()[1] else ""


def start_bake(scene: Any, camera_objects: Sequence[Any], *, replace_others: bool = False) -> None:
    """Start a bake of these camera objects, or of the scene's camera for [].

    With a window, a timer reads the scene and then starts the process; without one, the bake has ended on return.
    replace_others: delete layers in the folder that were baked from other flares, lights or colours; without it they
    raise RunError. Raises FitFlareError.
    """
    global _preparation, _last_error, _last_scene
    shots.check_bake(scene, camera_objects)
    if not replace_others and (replaced := shots.frames_to_replace(scene, camera_objects)):
        raise RunError(shots.replacement_warning(shots.layers_folder(scene), replaced))
    lamp_drive.measure_driven(scene)
    reading = ShotReading(scene, camera_objects, shots.frames_to_bake(scene))
    folder = shots.choose_layers_folder(scene)
    shots.live_record(scene.fit_flare, ())  # gives each flare its id inside the operator's undo step
    new_preparation = Preparation(reading, bool(camera_objects), folder)
    _last_error, _last_scene = "", scene.name
    if bpy.app.background:
        try:
            finish(new_preparation.steps)
        finally:
            new_preparation.end()
        return
    _preparation = new_preparation
    bpy.app.timers.register(_read_scene, first_interval=INTERVAL_S)


def cancel() -> None:
    """Stop reading the scene."""
    if _preparation is not None:
        _end_reading("Stopped before it began.")


def _read_scene() -> float | None:
    """Run a turn of the reading; return the seconds to the next turn, None to stop the timer."""
    if _preparation is None:
        return None
    try:
        if run_turn(_preparation.steps):
            jobs.redraw_bars()
            return INTERVAL_S
        _end_reading("")
    except FitFlareError as problem:
        _end_reading(str(problem))
    except OSError as problem:
        _end_reading(os_error_message(problem))
    return None


def _end_reading(error: str) -> None:
    """End the reading of a scene, with the reason where it ended early."""
    global _preparation, _last_error
    assert _preparation is not None
    finished, _preparation, _last_error = _preparation, None, error
    finished.end()
    jobs.redraw_bars()
    redraw_viewports()


def _start_process(folder: Path, frame_count: int) -> None:
    """Start the process that bakes the shot in a folder: the engine, else Blender's own Python."""
    args = ["bake", folder / shots.SHOT_FILE, "--out", folder, "--overwrite"]
    if engine.find_engine() is not None or engine.configured_engine()[1]:
        engine.run("bake", folder, args)
        return
    processes = min(max(available_cores() - 1, 1), MAX_PROCESSES, frame_count)
    jobs_option = ["--jobs", str(processes)] if processes > 1 else []
    engine.run_without_engine("bake", folder, [*args, "--without-engine", *jobs_option])


ON_BAKED: list[Callable[[jobs.Job, Any], Steps[None] | None]] = []
"""Functions to call with the job and the scene when the layers of a scene are baked; they return steps to run, or None.
"""


def _on_finished(job: jobs.Job) -> None:
    """Reload the layers that Blender shows; after success, call `ON_BAKED` for each scene with these layers.

    With a window, a timer runs the steps that these functions return.
    """
    from .images import reload_images

    if reload_images(job.folder):
        for scene in bpy.data.scenes:
            if find_node(scene) is not None:
                forget_composited_frames(scene)
    folder = os.path.normcase(job.folder.absolute())
    for scene in bpy.data.scenes if job.state == "done" else ():
        if scene.fit_flare.layers and os.path.normcase(shots.layers_folder(scene).absolute()) == folder:
            for function in ON_BAKED:
                steps = function(job, scene)
                if steps is not None and bpy.app.background:
                    finish(steps)
                elif steps is not None:
                    bpy.app.timers.register(partial(_run_steps, steps, job), first_interval=INTERVAL_S)


def _run_steps(steps: Steps[None], job: jobs.Job) -> float | None:
    """Run a turn of the steps that follow a bake; return the seconds to the next turn, None to stop the timer.

    An unexpected exception is shown in the panel and the console, as one of the job.
    """
    try:
        if run_turn(steps):
            return INTERVAL_S
    except Exception as problem:
        jobs.report_exception(job, problem)
    jobs.redraw_bars()
    return None


jobs.ON_FINISHED["bake"] = _on_finished


def abandon() -> None:
    """Drop the scene that is being read, because its file is closed."""
    global _preparation
    _preparation = None


def unregister() -> None:
    """Stop reading a scene."""
    abandon()
    if bpy.app.timers.is_registered(_read_scene):
        bpy.app.timers.unregister(_read_scene)
