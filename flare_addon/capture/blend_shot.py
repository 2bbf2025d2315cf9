# SPDX-License-Identifier: GPL-3.0-or-later
"""A .blend as a shot: its camera, its lights or named objects, and what its objects hide of them, frame by frame;
and its animated camera as a capture.

For the commands, which find no look set up in the scene; the panel's own ways are `shots` and `capture_export`.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np

from ...core.capture import LIGHTS
from ...core.errors import CaptureError
from ...core.look.shot import PlacedLight, Shot, ShotFrame
from ...core.system.files import write_json
from .. import cameras, lights, occlusion
from ..objects import collections_shown, matrix_of
from . import exporter

KINDS = ("POINT", "SPOT", "AREA", "SUN")


def opened(path: Path) -> Any:
    """The active scene of a .blend, which is opened without its scripts. Raises CaptureError."""
    if not path.is_file():
        raise CaptureError(f"{path} is missing; name a .blend.")
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path.resolve()), load_ui=False, use_scripts=False)
    except RuntimeError as problem:
        why = " ".join(str(problem).removeprefix("Error: ").split())
        raise CaptureError(f"{path} cannot be opened by Blender {bpy.app.version_string} ({why}).") from problem
    return bpy.context.scene


def shot_of(scene: Any, flare: Path, names: Sequence[str], frames: Sequence[int], *, radius: float = 0.0,
            done: Callable[[], None] = lambda: None) -> Shot:
    """The scene's active camera at these frames. names: of objects that are lights; none: the scene's lamps. Markers
    may change the camera; it is one shot all the same, and bears the scene's name.

    radius: of the lights' discs for the soft edge of shadows, world units; 0: a share of the distance. The shot's
    coordinates are Blender's world. Raises CaptureError for a scene without a camera, light, or named object.
    """
    things = _lights(scene, names)
    if not things:
        raise CaptureError(f"The scene {scene.name!r} has no lights; name objects with --lights.")
    made = []
    for frame in frames:
        scene.frame_set(frame)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        camera = _camera_of(scene).evaluated_get(depsgraph)
        core = cameras.core_camera(camera.data, camera.matrix_world, scene.render)
        eye = camera.matrix_world.translation
        placed = tuple(_placed(scene, depsgraph, thing, eye, radius) for thing in things)
        made.append(ShotFrame(frame, scene.name, core, placed))
        done()
    return Shot(flare, tuple(made))


def _camera_of(scene: Any) -> Any:
    """The active camera. Raises CaptureError where there is none, or an object that is none."""
    if scene.camera is None or scene.camera.type != "CAMERA":
        raise CaptureError(f"The scene {scene.name!r} has no active camera; set one.")
    return scene.camera


def _lights(scene: Any, names: Sequence[str]) -> list[Any]:
    """The objects of these names; of none the lamps that are rendered. Raises CaptureError for a name without one."""
    if names:
        missing = [name for name in names if name not in scene.objects]
        if missing:
            raise CaptureError(f"The scene {scene.name!r} has no object {missing[0]!r}; name lights as it does.")
        return [scene.objects[name] for name in names]
    rendered = {thing.name for layer in scene.view_layers
                for shown in collections_shown(layer.layer_collection, "hide_render") for thing in shown.objects}
    return [thing for thing in scene.objects if thing.type == "LIGHT" and thing.data.type in KINDS
            and not thing.hide_render and thing.name in rendered]


def _placed(scene: Any, depsgraph: Any, thing: Any, eye: Any, radius: float) -> PlacedLight:
    where = _position(depsgraph, thing, eye)
    item = SimpleNamespace(target=thing, radius=radius or _radius(thing))
    share = occlusion.visible_share(scene, depsgraph, eye, item)
    return PlacedLight(thing.name, thing.name, where, float(share))


def _position(depsgraph: Any, thing: Any, eye: Any) -> cameras.Floats:
    """(3,) in the world. Raises CaptureError where it is no number, as a driver may have it."""
    where = np.array(lights.stands(thing, matrix_of(thing, depsgraph), eye), np.float64)
    if not np.isfinite(where).all():
        raise CaptureError(f"The place of the light {thing.name!r} is not finite at frame "
                           f"{depsgraph.scene.frame_current}; mend its transform, and the drivers and parents that "
                           "move it.")
    return where


def _radius(thing: Any) -> float:
    """Of a lamp that has one; 0 where it is a point, a sun or a mesh."""
    sized = thing.type == "LIGHT" and thing.data.type != "SUN"
    return float(getattr(thing.data, "shadow_soft_size", 0.0)) if sized else 0.0


def capture_of(scene: Any, plates: Mapping[int, Path], folder: Path, names: Sequence[str],
               done: Callable[[], None] = lambda: None) -> int:
    """Write a capture of the scene's camera: transforms.json, images/, points.ply, and lights.json where there are
    lights (`names`, or the scene's lamps); how many frames it has.

    plates: the picture of each frame. Raises CaptureError where the scene lacks a camera, and what `write_frames` does.
    """
    _camera_of(scene)
    things = _lights(scene, names)
    entries = exporter.write_frames(scene, None, plates, folder, done)
    if things:
        eye, depsgraph = scene.camera.matrix_world.translation, bpy.context.evaluated_depsgraph_get()
        write_json(folder / LIGHTS, {"lights": [
            {"name": thing.name, "xyz": _position(depsgraph, thing, eye).tolist()} for thing in things]})
    exporter.write_cameras(folder, entries)
    return len(entries)
