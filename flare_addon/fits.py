# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits, light searches and clean frames: starts the jobs of a scene and brings their results into it."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import bpy

from ..core.capture import REMOVED
from ..core.choices import OUR_PRESETS
from ..core.conventions import exposures
from ..core.conventions.run_files import CONFIG, FLARE, SMALL_PREVIEW
from ..core.errors import CaptureError, FitFlareError, RunError
from ..core.images.video import is_video
from ..core.look import Look, read_look
from ..core.system.reading import MAX_PATH_BYTES, read_text
from . import engine, jobs, lights, looks, plate_space, weights
from .capture.importer import set_exposures
from .images import reload_images
from .jobs import Job
from .paths import absolute, blend_relative, is_file, is_folder
from .reports import NO_CAPTURE

TRUE_SCENE = Path("truth", "scene")
"""Folder of a sample capture with its exact clean frames."""

FitState = Literal["none", "running", "resumable", "finished", "lost"]
"""resumable: stopped or failed before its end. lost: the folder of the run does not exist any more."""
SHOT_RUN = "run"
"""Folder of the run in the folder of the command `shot`."""


def run_folder(scene: Any) -> Path | None:
    """Return the folder of the scene's run; None where none is set."""
    return absolute(scene.fit_flare.run, scene.library) if scene.fit_flare.run else None


def capture_folder(scene: Any) -> Path | None:
    """Return the folder of the scene's capture; None where none is set."""
    return absolute(scene.fit_flare.capture, scene.library) if scene.fit_flare.capture else None


def has_clean_frames(scene: Any) -> bool:
    """Return whether the imported capture has clean frames to show behind its cameras."""
    folder = capture_folder(scene)
    return scene.fit_flare.root is not None and folder is not None and is_folder(folder / REMOVED)


def fit_job(scene: Any) -> Job | None:
    """Return the job of the scene's current or last fit; None without one."""
    return jobs.find_job(run_folder(scene))


def engine_jobs(scene: Any) -> list[Job | None]:
    """Return the jobs of the scene's fit, light search and clean frames; None for each without one."""
    capture = capture_folder(scene)
    capture_jobs = [] if capture is None else [jobs.find_job(capture / "lights"), cleaning_job(capture)]
    return [fit_job(scene), *capture_jobs]


def fit_state(scene: Any) -> FitState:
    """Return the state of the scene's fit."""
    folder = run_folder(scene)
    if folder is None:
        return "none"
    job = jobs.find_job(folder)
    if job is not None and job.running:
        return "running"
    if is_file(folder / FLARE):
        return "finished"
    if is_file(folder / CONFIG):
        return "resumable"
    return "none" if not scene.fit_flare.run or is_folder(folder) else "lost"


def why_not_fit(scene: Any) -> str:
    """Return why a fit cannot start and what to do, without a full stop; "" where it can."""
    capture = capture_folder(scene)
    if capture is None:
        return NO_CAPTURE
    if not is_folder(capture):
        return f"The capture {capture} does not exist any more; choose its present folder"
    if not lights.scene_lights(scene):
        return "Add a light first, or find the lights in the frames"
    if missing := engine.missing_reason():
        return missing
    if fit_state(scene) == "running":
        return "A fit is running"
    if scene.fit_flare.mode == "split" or any(is_folder(capture / name) for name in (REMOVED, TRUE_SCENE)):
        return ""
    missing = weights.missing_reason()
    return f"The fit starts by making clean frames. {missing}, or choose No Clean Frames" if missing else ""


def new_run_folder(scene: Any) -> Path:
    """Return a free folder for a run: beside a saved .blend, else in fits/ of the capture. Raises CaptureError."""
    capture = capture_folder(scene)
    if capture is None:
        raise CaptureError("There is no capture yet; import one first.")
    parent = Path(bpy.data.filepath).parent / "fits" if bpy.data.filepath else capture / "fits"
    number = 1
    while (folder := parent / f"{capture.name}_{scene.fit_flare.preset}_{number}").exists():
        number += 1
    return folder


def start_fit(scene: Any) -> Job:
    """Start a fit in a new folder, with the present lights of the scene; the folder becomes the scene's run.

    Raises EngineError without an engine, CaptureError without a capture or lights, RunError for an unusable folder.
    """
    capture = capture_folder(scene)
    if capture is None or not is_folder(capture):
        raise CaptureError(f"The capture {capture} does not exist any more; import it from its present folder."
                           if capture else "There is no capture yet; import one first.")
    engine.command()  # raises before anything is written
    lights.write_to_capture(scene, capture)
    folder, earlier_run = new_run_folder(scene), scene.fit_flare.run
    scene.fit_flare.run = blend_relative(folder)
    folder = run_folder(scene) or folder  # the path as it is read back from the .blend
    try:
        return _run_fit(scene, capture, folder)
    except FitFlareError:
        if not is_file(folder / CONFIG):  # refused before it started: keep the earlier fit
            scene.fit_flare.run = earlier_run
        raise


def start_from_footage(scene: Any, source: Path) -> Job:
    """Start the command `shot` on a video or on the folder of a frame, in a new folder; its run becomes the scene's.

    Raises EngineError without an engine, CaptureError without the footage, RunError for an unusable folder.
    """
    footage = source.parent if is_file(source) and not is_video(source) else source
    if not source.name or not footage.exists():
        raise CaptureError(f"{source} is missing; choose a video, or a frame of a folder of frames.")
    engine.command()  # raises before anything is written
    parent, number = (Path(bpy.data.filepath).parent / "fits" if bpy.data.filepath else footage.parent), 1
    while (out := parent / f"{footage.stem}_flare_{number}").exists():
        number += 1
    state, earlier_run = scene.fit_flare, scene.fit_flare.run
    state.run = blend_relative(out / SHOT_RUN)
    folder = run_folder(scene) or out / SHOT_RUN  # the path as it is read back from the .blend
    args: list[object] = ["shot", footage.resolve(), "--out", folder.parent,
                          "--preset", state.preset if state.preset in OUR_PRESETS else "standard"]
    if state.width:
        args += ["--size", state.width]
    try:
        return engine.run("fit", folder, args)
    except FitFlareError:
        state.run = earlier_run
        raise


def resume_fit(scene: Any) -> Job:
    """Resume the run of the scene, from the capture that it was started with, or its present folder if it was moved.

    Raises EngineError without an engine, CaptureError without the capture, RunError without a fit to resume.
    """
    capture, folder = capture_folder(scene), run_folder(scene)
    stopped_job = fit_job(scene)
    if folder is not None and stopped_job is not None and stopped_job.args[:1] == ["shot"]:
        return engine.run("fit", folder, stopped_job.args)  # goes on with the steps after the fit too
    if folder is None or not is_file(folder / CONFIG):
        raise RunError(f"There is no fit to resume in {folder}; start a new one.")
    recorded = _capture_of_run(folder)
    if recorded is None or _capture_has_moved(folder, capture):
        recorded = capture
    if recorded is None or not is_folder(recorded):
        raise CaptureError(f"The capture {recorded} of this fit does not exist; put it back, or start a new fit.")
    return _run_fit(scene, recorded, folder)


def _run_fit(scene: Any, capture: Path, folder: Path) -> Job:
    """Start the command `fit` with the scene's settings and no held-out views."""
    state = scene.fit_flare
    args: list[object] = ["fit", capture.resolve(), "--out", folder, "--resume", "--preset", state.preset, "--mode",
                          state.mode, "--holdout", 0]
    if state.width:
        args += ["--size", state.width]
    args += plate_space.command_args(scene)
    return engine.run("fit", folder, args)


def show_result(scene: Any, folder: Path) -> Look:
    """Show the flare of a run in the scene, with the lights and exposures of the fit; return its look.

    Raises FlareFileError, CaptureError and RunError.
    """
    path = folder / FLARE
    # Before show_look, which compares the positions of the lights.
    lights.move_to_fit(scene, {light.name: light.xyz for light in read_look(path).lights}, capture_folder(scene))
    look = looks.show_look(scene, path)
    expose_cameras(scene, folder)
    return look


def expose_cameras(scene: Any, folder: Path | None) -> None:
    """Set the exposure of the imported cameras from a run, if the run stores its capture and that may be the scene's.

    Raises RunError.
    """
    capture = capture_folder(scene)
    if folder is None or capture is None or scene.fit_flare.root is None:
        return
    if _capture_of_run(folder) is not None and _may_belong_to(folder, capture):
        set_exposures(scene.fit_flare.root, exposures.read_exposures(folder))


def clear_other_run(scene: Any) -> None:
    """Clear the scene's run where it is one of another capture; its job and its folder are left alone."""
    folder, capture = run_folder(scene), capture_folder(scene)
    if folder is not None and capture is not None and not _may_belong_to(folder, capture):
        scene.fit_flare.run = ""


def _may_belong_to(folder: Path, capture: Path) -> bool:
    """Return whether a run may be of this capture.

    Where the folder of the run's capture is missing, a capture of the same name counts, since it may have been moved. A
    run that does not store its capture may be of any.
    """
    recorded = _capture_of_run(folder)
    if recorded is None:
        return True
    return recorded.samefile(capture) if is_folder(recorded) and is_folder(capture) else recorded.name == capture.name


def _capture_has_moved(folder: Path, capture: Path | None) -> bool:
    """Return whether the capture of a run is missing from its folder and `capture` may be it."""
    recorded = _capture_of_run(folder)
    return (recorded is not None and not is_folder(recorded) and capture is not None and is_folder(capture)
            and _may_belong_to(folder, capture))


def _capture_of_run(folder: Path) -> Path | None:
    """Return the capture of a run; None where its folder does not store it."""
    try:
        return Path(read_text(folder / "capture.txt", MAX_PATH_BYTES).removesuffix("\n"))
    except (OSError, UnicodeDecodeError):
        return None


def on_fit_finished(job: Job) -> None:
    """Show the flare of a successful fit in every scene with this run."""
    if job.state != "done":
        return
    scenes = [scene for scene in _local_scenes() if run_folder(scene) == job.folder]
    for scene in scenes:
        try:
            show_result(scene, job.folder)
        except FitFlareError as problem:
            job.error = str(problem)
    _push_undo("Fit", scenes)


def _local_scenes() -> list[Any]:
    """Return the scenes of this .blend, without linked ones, which cannot be changed."""
    return [scene for scene in bpy.data.scenes if scene.library is None]


def _push_undo(label: str, scenes: Sequence[Any]) -> None:
    """Add an undo step for a change by a timer, so that undoing a later change does not undo this one too."""
    manager = bpy.context.window_manager
    if bpy.app.background or not manager.windows or not scenes:
        return
    with bpy.context.temp_override(window=manager.windows[0]):
        bpy.ops.ed.undo_push(message=f"Fit Flare: {label}")


def start_light_search(scene: Any) -> Job:
    """Start a search for lights in the frames; lights of the scene stay. Raises EngineError and CaptureError."""
    capture = capture_folder(scene)
    if capture is None or not is_folder(capture):
        raise CaptureError("There is no capture yet; import one first.")
    if lights.scene_lights(scene):
        lights.write_to_capture(scene, capture)
    lights.remember_names(scene)
    return engine.run("lights", capture / "lights", ["lights", capture, "--keep",
                                                     *plate_space.command_args(scene)])


def start_cleaning(scene: Any) -> Job:
    """Start the removal of flares from the frames into the capture's removed/. Raises EngineError and CaptureError."""
    capture = capture_folder(scene)
    if capture is None or not is_folder(capture / "images"):
        raise CaptureError("There is no capture with a folder images/ yet; import one first.")
    args = cleaning_args(scene, capture)
    earlier_job = cleaning_job(capture)
    # A finished job is replaced; one that was stopped is resumed if its arguments are the same.
    if earlier_job is not None and (earlier_job.state == "done" or earlier_job.args != list(map(str, args))):
        args = [*args, "--overwrite"]
    return engine.run("clean", _cleaning_folder(capture), args)


def why_not_clean(scene: Any) -> str:
    """Return why clean frames cannot be made and what to do, without a full stop; "" where they can."""
    capture = capture_folder(scene)
    if capture is None or not is_folder(capture / "images"):
        return NO_CAPTURE
    if missing := engine.missing_reason():
        return missing
    return "" if "--run" in cleaning_args(scene, capture) else weights.missing_reason()


def cleaning_job(capture: Path) -> Job | None:
    """Return the current or last job that makes the clean frames of a capture; None without one."""
    return jobs.find_job(_cleaning_folder(capture))


def _cleaning_folder(capture: Path) -> Path:
    """Return the folder of the job that makes the clean frames of a capture."""
    return capture / "removal"


def cleaning_args(scene: Any, capture: Path) -> list[object]:
    """Return the arguments of the command `remove`: to subtract the flare of the finished fit of this capture, or,
    without one, to use the removal network with the matte and the choice of glow."""
    folder, space = run_folder(scene), plate_space.command_args(scene)
    if folder is not None and fit_state(scene) == "finished" and _may_belong_to(folder, capture):
        moved_capture = ["--capture", capture] if _capture_has_moved(folder, capture) else []
        return ["remove", "--run", folder, *moved_capture, "--out", capture / REMOVED, *space]
    path = scene.fit_flare.matte
    matte = ["--matte", absolute(path, scene.library)] if path else []
    glow = "--keep-glow" if scene.fit_flare.keep_glow else "--all-glow"
    return ["remove", capture / "images", "--out", capture / REMOVED, *matte, glow, *space]


def on_cleaning_finished(job: Job) -> None:
    """Reload clean frames that are shown; after success, fits of the scenes with this capture use them as estimates."""
    reload_images(job.folder.parent / REMOVED)
    if job.state != "done":
        return
    scenes = [scene for scene in _local_scenes()
              if (capture := capture_folder(scene)) is not None and _cleaning_folder(capture) == job.folder]
    for scene in scenes:
        scene.fit_flare.mode = "estimated"
    _push_undo("Clean Frames", scenes)


def on_lights_found(job: Job) -> None:
    """Add the lights that were found to every scene with this capture."""
    if job.state != "done":
        return
    scenes = [scene for scene in _local_scenes()
              if (capture := capture_folder(scene)) is not None and capture / "lights" == job.folder]
    for scene in scenes:
        try:
            lights.import_new_lights(scene, job.folder.parent)
        except FitFlareError as problem:
            job.error = str(problem)
    _push_undo("Lights", scenes)


jobs.ON_FINISHED.update({"fit": on_fit_finished, "lights": on_lights_found, "clean": on_cleaning_finished})


# ---- the preview ----------------------------------------------------------------------------------

_previews: Any = None
_preview_times: dict[str, float] = {}


def preview_icon(folder: Path) -> int:
    """Return the icon id of the run's newest preview; 0 where there is none yet."""
    global _previews
    path = folder / SMALL_PREVIEW
    try:
        modified = path.stat().st_mtime
    except OSError:
        return 0
    if _previews is None:
        from bpy.utils import previews

        _previews = previews.new()
    key = str(path)
    if _preview_times.get(key) != modified:
        if key in _previews:
            del _previews[key]
        _previews.load(key, key, "IMAGE")
        _preview_times[key] = modified
    return int(_previews[key].icon_id)


def unregister() -> None:
    """Free the preview icons."""
    global _previews
    if _previews is not None:
        from bpy.utils import previews

        previews.remove(_previews)
        _previews = None
    _preview_times.clear()
