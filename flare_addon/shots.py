# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's cameras, lights and sliders, frame by frame, written down for the engine to bake."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import CaptureError, RunError, SettingsError
from ..core.files import write_json
from ..core.look import Edit, LookEdits
from ..core.look.shot import Shot, ShotFrame
from . import cameras, engine, fits, looks
from .jobs import Job
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

    Raises CaptureError for a camera that is no perspective camera, FlareFileError for a bad .flare, SettingsError for
    frames below 0, which files have no numbers for.
    """
    if min(frames, default=0) < 0:
        raise SettingsError(f"Layers of the frame {min(frames)} have no name; begin the frames to bake at 0 or later.")
    view_layer = bpy.context.view_layer if bpy.context.scene == scene else scene.view_layers[0]
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
    words = edits.words()
    seen_by = replace(core, world_to_camera=pose, exposure=evaluated.fit_flare.exposure)
    return ShotFrame(frame, camera.name, seen_by, tuple(lights), tuple(words))


def without_live(edits: LookEdits) -> LookEdits:
    """The edits less what the compositor applies: intensity, tint, mute and solo of all lights and of each."""
    def kept(edit: Edit) -> Edit:
        return replace(edit, intensity=1.0, tint=(1.0, 1.0, 1.0), mute=False, solo=False)

    return LookEdits(kept(edits.master), {name: kept(edit) for name, edit in edits.lights.items()}, edits.elements)


def layers_folder(scene: Any, create: bool = False) -> Path:
    """The folder of the layers: as chosen, or beside the .blend or the flare."""
    state = scene.fit_flare
    if not state.layers and create:
        path = looks.path_of(scene)
        base = Path(bpy.data.filepath).parent if bpy.data.filepath else path.parent if path else None
        if base is None:
            raise RunError("There is no flare to bake; fit one, or open a .flare.")
        folder, number = base / "layers", 1
        while folder.exists():
            number += 1
            folder = base / f"layers_{number}"
        state.layers = stored(folder)
    return absolute(state.layers) if state.layers else Path()


def folder_of_camera(layers: Path, camera: Any) -> Path:
    """Where a camera's layers are, in a folder into which one or several were baked."""
    try:
        folders = Shot.read(layers / SHOT).folders
    except SettingsError:
        return layers
    return layers / folders.get(camera.name if camera is not None else "", "")


def bake(scene: Any, chosen: Sequence[Any]) -> Job:
    """Bake layers of these cameras through the engine, or of the scene's own. Raises FitFlareError of every kind."""
    if not chosen and scene.camera is None:
        raise CaptureError("The scene has no camera to bake from; add one, or import a capture.")
    engine.command()
    look = looks.look_of(scene)
    state = scene.fit_flare
    if not any(item.target is not None for item in state.lights):
        raise RunError("No flare has a light to come from; choose an object for each in the panel Look.")
    if looks.twice(state):
        raise RunError(f"Two flares have the name {looks.twice(state)!r}; rename one in the panel Look.")
    run = None
    if state.bake_scene:
        run = fits.folder_of(scene)
        if run is None or not (run / "scene.ply").is_file():
            raise RunError("There is no fitted scene to bake; switch Fitted Scene Too off, or finish a fit.")
        run = run.resolve()
    folder = layers_folder(scene, create=True)
    shot = of_scene(scene, chosen, frames_of(scene), look.path.resolve(), run)
    shot.write(folder / SHOT)
    if state.bake_live:
        write_json(folder / LIVE, {"lights": list(shot.lights)})
    else:
        (folder / LIVE).unlink(missing_ok=True)
    return engine.run("bake", folder, ["bake", folder / SHOT, "--out", folder, "--overwrite"])
