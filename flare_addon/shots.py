# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's cameras, lights and sliders, frame by frame, written down for the engine to bake."""
from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import bpy

from ..core.bake import bake as bakes
from ..core.bake.layers import layer_names
from ..core.conventions.frame_numbers import layers_file
from ..core.conventions.run_files import FLARE, SCENE
from ..core.errors import CaptureError, FrameError, RunError, SettingsError
from ..core.look import Edit, LookEdits
from ..core.look.shot import Shot, ShotFrame
from ..core.system.files import digest_of, remove_file, write_json
from . import cameras, engine, fits, jobs, library, looks
from .images import read_again
from .jobs import Job
from .objects import view_layer_of
from .paths import absolute, stored

SHOT = "shot.json"
LIVE = "live.json"  # lights whose colour was left to the compositor


def frames_of(scene: Any) -> list[int]:
    """The frames to bake, as the panel asks."""
    state = scene.fit_flare
    if state.bake_range == "current":
        return [scene.frame_current]
    if state.bake_range == "custom":
        return list(range(state.bake_first, max(state.bake_last, state.bake_first) + 1))
    return list(range(scene.frame_start, scene.frame_end + 1))


def of_scene(scene: Any, chosen: Sequence[Any], frames: Sequence[int], flare: Path, run: Path | None,
             done: Callable[[int], None] = lambda _frame: None) -> Shot:
    """The shot of these camera objects at these frames; of none the scene's own, which markers on the timeline may
    change from frame to frame, under the name of the first. The scene's current frame is put back.

    Raises CaptureError for a camera that is no perspective camera, and for a light that is switched off in the viewport
    and moved there; FlareFileError for a bad .flare, SettingsError for frames below 0, which files have no numbers for.
    """
    if min(frames, default=0) < 0:
        raise SettingsError(f"Layers of the frame {min(frames)} have no name; begin the frames to bake at 0 or later.")
    view_layer = view_layer_of(scene)
    before, subframe = scene.frame_current, scene.frame_subframe
    made: list[ShotFrame] = []
    try:
        for frame in frames:
            scene.frame_set(frame)
            depsgraph = view_layer.depsgraph
            made += [frame_of(scene, depsgraph, camera, frame) for camera in chosen]
            if not chosen:
                one = frame_of(scene, depsgraph, scene.camera, frame)
                made.append(replace(one, name=made[0].name if made else one.name))
            done(frame)
    finally:
        scene.frame_set(before, subframe=subframe)
    return Shot(flare, tuple(made), looks.query_of(scene.fit_flare), run, scene.fit_flare.bake_live)


def frame_of(scene: Any, depsgraph: Any, camera: Any, frame: int) -> ShotFrame:
    """One camera as it stands now."""
    evaluated = camera.evaluated_get(depsgraph)
    pose, lights = looks.placed(scene, depsgraph, camera)
    core = cameras.core_camera(evaluated.data, evaluated.matrix_world, scene.render)
    edits = looks.edits_of(scene.fit_flare)
    if scene.fit_flare.bake_live:
        edits = without_live(edits)
    words = _of_lights(edits, {light.name for light in lights}).words()
    seen_by = replace(core, world_to_camera=pose, exposure=evaluated.fit_flare.exposure)
    return ShotFrame(frame, camera.name, seen_by, tuple(lights), tuple(words))


def without_live(edits: LookEdits) -> LookEdits:
    """The edits less what the compositor applies: intensity, tint, mute and solo of all lights and of each."""
    def kept(edit: Edit) -> Edit:
        return replace(edit, intensity=1.0, tint=(1.0, 1.0, 1.0), mute=False, solo=False)

    return LookEdits(kept(edits.master), {name: kept(edit) for name, edit in edits.lights.items()}, edits.elements)


def _of_lights(edits: LookEdits, names: set[str]) -> LookEdits:
    """The edits of these lights: one that is not in the shot has nothing to be edited."""
    return LookEdits(edits.master, {name: edit for name, edit in edits.lights.items() if name in names},
                     {pair: edit for pair, edit in edits.elements.items() if pair[0] in names})


def live_of(state: Any, names: Sequence[str]) -> dict[str, list[str]]:
    """What is written of flares whose colour is left to the compositor: the names of their layers, and what they are
    known by when they have others."""
    identities = {}
    for item in state.lights:
        item.identity = item.identity or uuid4().hex
        identities[item.name] = item.identity
    return {"lights": list(names), "identities": [identities[name] for name in names]}


def live_layers(state: Any, folder: Path) -> dict[str, int] | None:
    """Of layers whose colour was left to the compositor, the number of the flare in the scene that each is of; those of
    flares that are gone are left out. None where the folder, or the one that has it, says nothing of the kind."""
    folder = next((one for one in (folder, folder.parent) if (one / LIVE).is_file()), folder)
    try:
        live = json.loads((folder / LIVE).read_text(encoding="utf-8"))
        baked = layer_names(live["lights"])
        identities = dict(zip(live["lights"], live.get("identities", live["lights"]), strict=True))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    names, known = ({getattr(item, of): number for number, item in enumerate(state.lights)}
                    for of in ("name", "identity"))
    found = {layer: known.get(identities[name], names.get(name)) for name, layer in baked.items()}
    return {layer: number for layer, number in found.items() if number is not None}


def layers_folder(scene: Any, create: bool = False) -> Path:
    """The folder of the layers: as chosen, or beside the .blend or the flare."""
    state = scene.fit_flare
    if not state.layers and create:
        path = looks.path_of(scene)
        if path is None:
            raise RunError("There is no flare to bake; fit one, or open a .flare.")
        base = Path(bpy.data.filepath).parent if bpy.data.filepath else path.parent
        if base.resolve() == library.folder().resolve():
            raise RunError("Layers do not go into the library of flares; save the .blend first, or choose a folder for "
                           "Layers.")
        folder, number = base / "layers", 1
        while folder.exists():
            number += 1
            folder = base / f"layers_{number}"
        state.layers = stored(folder)
    return absolute(state.layers, scene.library) if state.layers else Path()


def folder_of_camera(layers: Path, camera: Any) -> Path:
    """Where a camera's layers are, in a folder into which the scene's own or chosen ones were baked. Raises FrameError
    where there are only others' layers."""
    try:
        last = Shot.read(layers / SHOT).folders
    except SettingsError:
        return layers
    folders = {**_folders_of_all_bakes(layers), **last}
    name = camera.name if camera is not None else ""
    if name not in folders and "" not in last.values() and not any(layers.glob("*.exr")):
        raise FrameError(f"{layers} has no layers of the camera {name!r}, only of {', '.join(map(repr, folders))}; "
                         "bake it too, or make one of those the scene's camera. One that was renamed needs its name "
                         "back.")
    return layers / folders.get(name, "")


def _folders_of_all_bakes(layers: Path) -> dict[str, str]:
    """Of each camera whose layers a folder has, those of bakes before the last too, the folder in it."""
    try:
        entries = bakes.read_record(layers)["frames"]
    except RunError:
        return {}
    return {entry["view"].rpartition("/")[0]: entry["file"].rpartition("/")[0] for entry in entries
            if "/" in entry["view"]}


def replaced(scene: Any, chosen: Sequence[Any]) -> list[int]:
    """Numbers of the frames whose layers a bake would take out of the folder: they were baked from another flare, of
    other lights or colours, and are not asked for now. Raises FitFlareError of every kind."""
    folder, frames = layers_folder(scene), frames_of(scene)
    if not scene.fit_flare.layers or not (folder / bakes.RECORD).exists():
        return []
    shot = _shot(scene, chosen, frames[:1])  # has the lights and cameras of all
    files = {layers_file(inner, frame) for inner in shot.folders.values() for frame in frames}

    def fingerprint() -> str:
        run = shot.run
        return shot.fingerprint("" if run is None else digest_of(run / name for name in (SCENE, FLARE)))

    return bakes.replaced(folder, fingerprint, shot.lights, files)


def losing(folder: Path, frames: Sequence[int]) -> str:
    """That a bake would take these frames out of the folder of the layers, and what to do."""
    which = f"frame {frames[0]}" if len(frames) == 1 else f"{len(frames)} frames from {frames[0]} to {frames[-1]}"
    return (f"{folder} has layers of {which} that were baked from another flare or with other lights or colours, and "
            "that would go: bake them too, or choose another folder for Layers.")


def _shot(scene: Any, chosen: Sequence[Any], frames: Sequence[int]) -> Shot:
    """What the panel asks for, at these frames."""
    shot = of_scene(scene, chosen, frames, looks.look_of(scene).path.resolve(), _run(scene))
    return replace(shot, apart=bool(chosen))


def _run(scene: Any) -> Path | None:
    """The run whose scene is baked too; None where it is not wanted. Raises RunError where there is none."""
    if not scene.fit_flare.bake_scene:
        return None
    run = fits.folder_of(scene)
    if run is None or not (run / SCENE).is_file():
        raise RunError("There is no fitted scene to bake; switch Fitted Scene Too off, or finish a fit.")
    return run.resolve()


def jobs_of(scene: Any) -> list[Job]:
    """The work of the engine that goes on for a scene: its fit, search for lights, cleaning and bake."""
    layers = jobs.find(layers_folder(scene)) if scene.fit_flare.layers else None
    return [job for job in (*fits.jobs_of(scene), layers) if job is not None and job.running]


def unnamed() -> list[Job]:
    """Fits and bakes that go on and that no scene names: undoing what followed the start of one forgets it."""
    found = [job for job in jobs.running() if job.kind in ("fit", "bake")]
    named = [job for scene in bpy.data.scenes for job in jobs_of(scene)] if found else []
    return [job for job in found if job not in named]


def bake(scene: Any, chosen: Sequence[Any], *, others_may_go: bool = False) -> Job:
    """Bake layers of these cameras through the engine, or of the scene's own. others_may_go: frames of the folder that
    were baked otherwise and are not asked for. Raises FitFlareError of every kind."""
    if not chosen and scene.camera is None:
        raise CaptureError("The scene has no camera to bake from; add one, or import a capture.")
    engine.command()
    state = scene.fit_flare
    if not any(looks.is_placed(item, scene) for item in state.lights):
        raise RunError("No flare has a light to come from; choose an object for each in the panel Look.")
    if looks.twice(state):
        raise RunError(f"Two flares have the name {looks.twice(state)!r}; rename one in the panel Look.")
    if not others_may_go and (lost := replaced(scene, chosen)):
        raise RunError(losing(layers_folder(scene), lost))
    shot, folder = _shot(scene, chosen, frames_of(scene)), layers_folder(scene, create=True)
    shot.write(folder / SHOT)
    if state.bake_live:
        write_json(folder / LIVE, live_of(state, shot.lights))
    else:
        remove_file(folder / LIVE)
    return engine.run("bake", folder, ["bake", folder / SHOT, "--out", folder, "--overwrite"])


def baked(job: Job) -> None:
    """Show the layers that were baked."""
    read_again(job.folder)


jobs.FINISHERS["bake"] = baked
