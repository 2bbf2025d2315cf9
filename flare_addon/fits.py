# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits: started, found again, and what they leave taken into the scene."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy

from ..core.capture import REMOVED
from ..core.conventions import exposures
from ..core.conventions.run_files import CONFIG, FLARE, SMALL_PREVIEW
from ..core.errors import CaptureError, FitFlareError, RunError
from ..core.look import Look, read
from . import engine, jobs, lights, looks
from .capture.importer import expose
from .images import read_again
from .jobs import Job
from .paths import absolute, is_file, is_folder, stored
from .reports import NO_CAPTURE


def folder_of(scene: Any) -> Path | None:
    """The run's folder; None where none is chosen."""
    return absolute(scene.fit_flare.run, scene.library) if scene.fit_flare.run else None


def capture_of(scene: Any) -> Path | None:
    """The capture's folder; None where none is chosen."""
    return absolute(scene.fit_flare.capture, scene.library) if scene.fit_flare.capture else None


def has_clean_frames(scene: Any) -> bool:
    """Whether the imported capture has frames without flare, to be shown behind its cameras."""
    folder = capture_of(scene)
    return scene.fit_flare.root is not None and folder is not None and is_folder(folder / REMOVED)


def job_of(scene: Any) -> Job | None:
    """The fit that runs or ran in the scene's run folder."""
    return jobs.find(folder_of(scene))


def jobs_of(scene: Any) -> list[Job | None]:
    """The scene's fit, search for lights and cleaning, where there is or was one."""
    capture = capture_of(scene)
    of_capture = [] if capture is None else [jobs.find(capture / "lights"), cleaning_of(capture)]
    return [job_of(scene), *of_capture]


def state_of(scene: Any) -> str:
    """"none", "running", "resumable" (broken off), "finished" or "lost" (its folder is gone)."""
    folder = folder_of(scene)
    if folder is None:
        return "none"
    job = jobs.find(folder)
    if job is not None and job.running:
        return "running"
    if is_file(folder / FLARE):
        return "finished"
    if is_file(folder / CONFIG):
        return "resumable"
    return "none" if not scene.fit_flare.run or is_folder(folder) else "lost"


def why_not(scene: Any) -> str:
    """What keeps a fit from being started, and what to do; "" where nothing does. No full stop: for tooltips."""
    capture = capture_of(scene)
    if capture is None:
        return NO_CAPTURE
    if not is_folder(capture):
        return f"The capture {capture} is not there any more; choose where it is now"
    if not lights.of_scene(scene):
        return "Add a light first, or find the lights in the frames"
    if missing := engine.missing():
        return missing
    if state_of(scene) == "running":
        return "A fit is running"
    return ""


def new_folder(scene: Any) -> Path:
    """A free folder for a run: beside the .blend where it is saved, else in the capture's own fits/."""
    capture = capture_of(scene)
    if capture is None:
        raise CaptureError("There is no capture yet; import one first.")
    base = Path(bpy.data.filepath).parent / "fits" if bpy.data.filepath else capture / "fits"
    number = 1
    while (folder := base / f"{capture.name}_{scene.fit_flare.preset}_{number}").exists():
        number += 1
    return folder


def start(scene: Any) -> Job:
    """Begin a fit in a new folder, with the lights as they are in the scene.

    Raises EngineError without an engine, CaptureError without a capture or lights, RunError for the folder.
    """
    capture = capture_of(scene)
    if capture is None or not is_folder(capture):
        raise CaptureError(f"The capture {capture} is not there any more; import it from where it is now."
                           if capture else "There is no capture yet; import one first.")
    engine.command()  # says so before anything is written
    lights.write(scene, capture)
    folder, before = new_folder(scene), scene.fit_flare.run
    scene.fit_flare.run = stored(folder)
    folder = folder_of(scene) or folder  # by the name that it will be asked for
    try:
        return _run(scene, capture, folder)
    except FitFlareError:
        if not is_file(folder / CONFIG):  # refused before it began: an earlier fit is still what there is
            scene.fit_flare.run = before
        raise


def resume(scene: Any) -> Job:
    """Go on with the run of the scene. Raises as `start` does."""
    capture, folder = capture_of(scene), folder_of(scene)
    if folder is None or not is_file(folder / CONFIG):
        raise RunError(f"There is no fit to go on with in {folder}; start a new one.")
    begun = _begun_with(folder)
    if begun is None or _has_moved(folder, capture):
        begun = capture
    if begun is None or not is_folder(begun):
        raise CaptureError(f"The capture {begun} that this fit was begun with is not there; put it back, or start a "
                           "new fit.")
    return _run(scene, begun, folder)


def _run(scene: Any, capture: Path, folder: Path) -> Job:
    state = scene.fit_flare
    words: list[object] = ["fit", capture.resolve(), "--out", folder, "--resume", "--preset", state.preset, "--mode",
                           state.mode, "--holdout", 0]
    if state.width:
        words += ["--size", state.width]
    return engine.run("fit", folder, words)


def show(scene: Any, folder: Path) -> Look:
    """The flare of a run in the scene, its lights where the fit has put them, its cameras exposed as their frames were.
    Raises FlareFileError, CaptureError, RunError."""
    path = folder / FLARE
    # Before the look is used, which asks where the lights are.
    lights.follow(scene, {light.name: light.xyz for light in read(path).lights}, capture_of(scene))
    look = looks.use(scene, path)
    expose_cameras(scene, folder)
    return look


def expose_cameras(scene: Any, folder: Path | None) -> None:
    """The imported cameras, as the run in a folder found the frames that they are; nothing where it is a run of another
    capture. Raises RunError."""
    capture = capture_of(scene)
    if folder is None or capture is None or scene.fit_flare.root is None:
        return
    if _begun_with(folder) is not None and _may_be_of(folder, capture):
        expose(scene.fit_flare.root, exposures.read(folder))


def leave_another(scene: Any) -> None:
    """Let go of a run of another capture than the scene's present one; it goes on, and its folder stays."""
    folder, capture = folder_of(scene), capture_of(scene)
    if folder is not None and capture is not None and not _may_be_of(folder, capture):
        scene.fit_flare.run = ""


def _may_be_of(folder: Path, capture: Path) -> bool:
    """Whether a run is of a capture. One whose own is gone may be of one that has its name: that may have been moved;
    one that does not say may be of any."""
    begun = _begun_with(folder)
    if begun is None:
        return True
    return begun.samefile(capture) if is_folder(begun) and is_folder(capture) else begun.name == capture.name


def _has_moved(folder: Path, capture: Path | None) -> bool:
    """Whether the capture of a run is gone from where it was, and may be the one that is given now."""
    begun = _begun_with(folder)
    return (begun is not None and not is_folder(begun) and capture is not None and is_folder(capture)
            and _may_be_of(folder, capture))


def _begun_with(folder: Path) -> Path | None:
    """The capture of a run; None where its folder does not say."""
    try:
        return Path((folder / "capture.txt").read_text(encoding="utf-8").removesuffix("\n"))
    except (OSError, UnicodeDecodeError):
        return None


def finished(job: Job) -> None:
    """Show the flare of a fit that ended well, in every scene that has this run."""
    if job.state != "done":
        return
    scenes = [scene for scene in _own_scenes() if folder_of(scene) == job.folder]
    for scene in scenes:
        try:
            show(scene, job.folder)
        except FitFlareError as problem:
            job.error = str(problem)
    _remember("Fit", scenes)


def _own_scenes() -> list[Any]:
    """The scenes of this .blend, without those that are linked from another and cannot be changed here."""
    return [scene for scene in bpy.data.scenes if scene.library is None]


def _remember(what: str, scenes: Sequence[Any]) -> None:
    """An undo step for what a timer changed in scenes, so that undoing what came later does not take it away too."""
    manager = bpy.context.window_manager
    if bpy.app.background or not manager.windows or not scenes:
        return
    with bpy.context.temp_override(window=manager.windows[0]):
        bpy.ops.ed.undo_push(message=f"Fit Flare: {what}")


def find_lights(scene: Any) -> Job:
    """Have the engine look for lights in the frames; those of the scene stay. Raises EngineError, CaptureError."""
    capture = capture_of(scene)
    if capture is None or not is_folder(capture):
        raise CaptureError("There is no capture yet; import one first.")
    if lights.of_scene(scene):
        lights.write(scene, capture)
    lights.remember(scene)
    return engine.run("lights", capture / "lights", ["lights", capture, "--keep"])


def clean(scene: Any) -> Job:
    """Have the engine take the flares out of the frames, into the capture's removed/. Raises EngineError,
    CaptureError."""
    capture = capture_of(scene)
    if capture is None or not is_folder(capture / "images"):
        raise CaptureError("There is no capture with a folder images/ yet; import one first.")
    words = cleaning(scene, capture)
    made = cleaning_of(capture)
    # What the engine itself has made is made again; what it was stopped at is gone on with, if it is still the same.
    if made is not None and (made.state == "done" or made.words != list(map(str, words))):
        words = [*words, "--overwrite"]
    return engine.run("clean", _cleaning_folder(capture), words)


def cleaning_of(capture: Path) -> Job | None:
    """The cleaning of a capture's frames that runs or ran."""
    return jobs.find(_cleaning_folder(capture))


def _cleaning_folder(capture: Path) -> Path:
    return capture / "removal"


def cleaning(scene: Any, capture: Path) -> list[object]:
    """The engine's words for it: a finished fit knows the flare of all frames, a network sees a few at a time, and by
    a matte where there is one."""
    folder = folder_of(scene)
    if folder is not None and state_of(scene) == "finished" and _may_be_of(folder, capture):
        moved = ["--capture", capture] if _has_moved(folder, capture) else []
        return ["remove", "--run", folder, *moved, "--out", capture / REMOVED]
    given = scene.fit_flare.matte
    matte = ["--matte", absolute(given, scene.library)] if given else []
    glow = "--keep-glare" if scene.fit_flare.keep_glow else "--all-glare"
    return ["remove", capture / "images", "--out", capture / REMOVED, *matte, glow]


def cleaned(job: Job) -> None:
    """Fits of the scenes with this capture go by the clean frames from now on; those that are shown are read again."""
    read_again(job.folder.parent / REMOVED)
    if job.state != "done":
        return
    scenes = [scene for scene in _own_scenes()
              if (capture := capture_of(scene)) is not None and _cleaning_folder(capture) == job.folder]
    for scene in scenes:
        scene.fit_flare.mode = "estimated"
    _remember("Clean Frames", scenes)


def lights_found(job: Job) -> None:
    """Bring found lights into every scene with this capture."""
    if job.state != "done":
        return
    scenes = [scene for scene in _own_scenes()
              if (capture := capture_of(scene)) is not None and capture / "lights" == job.folder]
    for scene in scenes:
        try:
            lights.bring_in(scene, job.folder.parent)
        except FitFlareError as problem:
            job.error = str(problem)
    _remember("Lights", scenes)


jobs.FINISHERS.update({"fit": finished, "lights": lights_found, "clean": cleaned})


# ---- the preview ----------------------------------------------------------------------------------

_previews: Any = None
_shown: dict[str, float] = {}


def preview_icon(folder: Path) -> int:
    """An icon of the run's newest preview picture; 0 where there is none yet."""
    global _previews
    path = folder / SMALL_PREVIEW
    try:
        changed = path.stat().st_mtime
    except OSError:
        return 0
    if _previews is None:
        from bpy.utils import previews

        _previews = previews.new()
    key = str(path)
    if _shown.get(key) != changed:
        if key in _previews:
            del _previews[key]
        _previews.load(key, key, "IMAGE")
        _shown[key] = changed
    return int(_previews[key].icon_id)


def unregister() -> None:
    global _previews
    if _previews is not None:
        from bpy.utils import previews

        previews.remove(_previews)
        _previews = None
    _shown.clear()
