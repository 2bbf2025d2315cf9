# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads a .blend for the commands: as a shot (camera, lights and their visibility by frame), or as a capture.

`transfer` and `bake` use the shot, `solve` the capture. The scene needs no look; for the panel, `shots` and `exporter`
do the same from a scene that has one.
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
from ...core.look import PlacedLight
from ...core.look.shot import Shot, ShotFrame
from ...core.system.files import write_json
from .. import cameras, fcurves, lamp_drive, light_paths, lights, looks, properties
from ..objects import enabled_collections, world_matrix
from . import exporter

LAMP_TYPES = ("POINT", "SPOT", "AREA", "SUN")


def open_blend(path: Path) -> Any:
    """Open a .blend without running its scripts; return its active scene. Raises CaptureError."""
    if not path.is_file():
        raise CaptureError(f"{path} is missing; name a .blend.")
    if not hasattr(bpy.types.Scene, "fit_flare"):  # the extension is not enabled, as in commands
        properties.register()
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path.resolve()), load_ui=False, use_scripts=False)
    except RuntimeError as problem:
        reason = " ".join(str(problem).removeprefix("Error: ").split())
        raise CaptureError(f"{path} cannot be opened by Blender {bpy.app.version_string} ({reason}).") from problem
    return bpy.context.scene


def read_shot(scene: Any, flare: Path, names: Sequence[str], frames: Sequence[int], *, radius: float = 0.0,
              done: Callable[[], None] = lambda: None) -> Shot:
    """Return the shot of the scene's active camera at these frames, in the coordinates of Blender's world.

    Markers may change the camera; the frames are named after the scene. names: objects that are lights; without any,
    the scene's lamps. radius: radius of the lights' discs for soft occlusion, world units; 0 for that of the flare or
    lamp, else a part of the distance. done: called after each frame. Raises CaptureError for a scene without a camera,
    a light or a named object.
    """
    light_objects = _light_objects(scene, names)
    if not light_objects:
        raise CaptureError(f"The scene {scene.name!r} has no lights; name objects with --lights.")
    scene.frame_set(scene.frame_start)
    lamp_drive.measure_driven(scene)
    items = [_flare_settings(scene, obj, radius) for obj in light_objects]
    shot_frames = []
    for frame in frames:
        scene.frame_set(frame)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        camera = _active_camera(scene).evaluated_get(depsgraph)
        core_camera = cameras.core_camera(camera.data, camera.matrix_world, scene.render)
        rendered = lamp_drive.rendered_collections(scene)
        placed = tuple(_place_light(scene, depsgraph, item, camera.matrix_world, rendered) for item in items)
        shot_frames.append(ShotFrame(frame, scene.name, core_camera, placed))
        done()
    return Shot(flare, tuple(shot_frames))


def _active_camera(scene: Any) -> Any:
    """Return the active camera of the scene. Raises CaptureError where there is none."""
    if scene.camera is None or scene.camera.type != "CAMERA":
        raise CaptureError(f"The scene {scene.name!r} has no active camera; set one.")
    return scene.camera


def _light_objects(scene: Any, names: Sequence[str]) -> list[Any]:
    """Return the objects with these names, or all rendered lamps without names.

    Raises CaptureError for a wrong name.
    """
    if names:
        missing = [name for name in names if name not in scene.objects]
        if missing:
            raise CaptureError(f"The scene {scene.name!r} has no object {missing[0]!r}; use the names of its objects.")
        return [scene.objects[name] for name in names]
    rendered = {obj.name for layer in scene.view_layers
                for collection in enabled_collections(layer.layer_collection, "hide_render")
                for obj in collection.objects}
    return [obj for obj in scene.objects if obj.type == "LIGHT" and obj.data.type in LAMP_TYPES
            and (not obj.hide_render or _is_keyed(obj, "hide_render")) and obj.name in rendered]


def _is_keyed(obj: Any, path: str) -> bool:
    """Return whether keys or drivers change a property of an object."""
    data = obj.animation_data
    return data is not None and any(
        curve.data_path == path for group in (*fcurves.fcurves_of(obj), data.drivers) for curve in group)


def _flare_settings(scene: Any, obj: Any, radius: float) -> Any:
    """Return the settings of a flare at a light: copied from the scene's flare at this object, else the default ones.

    They have the attributes of a flare in `scene.fit_flare.lights` that `looks.place_light` reads. The scene is at its
    first frame, to which the power of lamps is relative by default. radius: world units; 0 for that of the flare, else
    of the lamp.
    """
    scene_flare = next((item for item in scene.fit_flare.lights if item.target == obj), None)
    if scene_flare is not None:
        names = (*lamp_drive.SWITCHES, "reference_light", "reference_distance", "extent")
        return SimpleNamespace(name=obj.name, source=obj.name, target=obj,
                               radius=radius or scene_flare.radius or _lamp_radius(obj),
                               **{name: getattr(scene_flare, name) for name in names})
    light = lamp_drive.light_of(obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).data).tolist() \
        if lamp_drive.is_lamp(obj) else (0.0, 0.0, 0.0)
    return SimpleNamespace(name=obj.name, source=obj.name, target=obj, radius=radius or _lamp_radius(obj),
                           follow_power=True, follow_visibility=True, follow_direction=True, follow_distance=False,
                           reference_light=light, reference_distance=0.0, extent="auto")


def _place_light(scene: Any, depsgraph: Any, item: Any, camera: Any, rendered: set[Any]) -> PlacedLight:
    """Return a light with its position, visibility, extent and power, seen by a camera of this matrix_world.

    rendered: the collections that renders show.
    """
    _light_position(depsgraph, item.target, camera.translation)  # refuses one that is not finite
    return looks.place_light(scene, depsgraph, camera, np.eye(4), item, hides=True, rendered=rendered)


def _light_entries(scene: Any, light_objects: Sequence[Any], numbers: Mapping[str, int]) -> list[dict[str, Any]]:
    """Return the entries of lights.json for light objects; lights that move become paths.

    numbers: frames of the scene by the name of the capture's picture. Raises CaptureError for a position that is not
    finite.
    """
    def position_of(obj: Any) -> cameras.Floats:
        return _light_position(bpy.context.evaluated_depsgraph_get(), obj, scene.camera.matrix_world.translation)

    paths = light_paths.world_paths(scene, {obj.name: obj for obj in light_objects}, numbers, position_of)
    return [light_paths.merge_entry({}, obj.name, position_of(obj).tolist(), paths.get(obj.name, {}))
            for obj in light_objects]


def _light_position(depsgraph: Any, obj: Any, eye: Any) -> cameras.Floats:
    """Return the position (3,) of a light in the world. Raises CaptureError where it is not finite."""
    position = np.array(lights.light_position(obj, world_matrix(obj, depsgraph), eye), np.float64)
    if not np.isfinite(position).all():
        raise CaptureError(f"The position of the light {obj.name!r} is not finite at frame "
                           f"{depsgraph.scene.frame_current}; correct its transform, and the drivers and parents that "
                           "move it.")
    return position


def _lamp_radius(obj: Any) -> float:
    """Return the radius of a lamp; 0 for a sun and for other objects."""
    has_radius = obj.type == "LIGHT" and obj.data.type != "SUN"
    return float(getattr(obj.data, "shadow_soft_size", 0.0)) if has_radius else 0.0


def write_capture(scene: Any, plates: Mapping[int, Path], folder: Path, names: Sequence[str],
                  done: Callable[[], None] = lambda: None) -> int:
    """Write a capture of the scene's camera; return its number of frames.

    lights.json is written where there are lights (`names`, or the scene's lamps): each at its place, or along its path
    where it moves, with its brightness by frame where that changes. plates: the picture of each frame. done: called
    after each frame. Raises CaptureError where the scene has no camera or no points, and where the folder or a plate
    cannot be used.
    """
    _active_camera(scene)
    light_objects = _light_objects(scene, names)
    entries = exporter.write_frames(scene, None, plates, folder, done)
    if light_objects:
        numbers = {Path(entry["file_path"]).name: frame for entry, frame in zip(entries, sorted(plates), strict=True)}
        write_json(folder / LIGHTS, {"lights": _light_entries(scene, light_objects, numbers)})
    exporter.write_cameras(folder, entries)
    return len(entries)
