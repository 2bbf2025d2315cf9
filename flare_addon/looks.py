# SPDX-License-Identifier: GPL-3.0-or-later
"""The look of a scene: its .flare, the flares with their light objects and edits, and their evaluation for a camera."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, FlareFileError
from ..core.look import Edit, Look, LookEdits, PlacedLight, PlaneGaussians, read
from ..core.look.look import Query
from . import cameras, fcurves, occlusion
from .compositor import drivers
from .lights import capture_position, light_name, light_position, scene_lights
from .objects import depsgraph_of, world_matrix
from .paths import absolute, blend_relative
from .properties import edit_of

_cache: dict[str, tuple[tuple[float, int], Look | str]] = {}


def path_of(scene: Any) -> Path | None:
    """Return the .flare of the scene; None where none is set."""
    return absolute(scene.fit_flare.flare, scene.library) if scene.fit_flare.flare else None


def look_of(scene: Any) -> Look:
    """Return the look of the scene, cached until its file changes. Raises FlareFileError."""
    path = path_of(scene)
    if path is None:
        raise FlareFileError("No flare is set; fit one, or open a .flare.")
    try:
        status = path.stat()
        stamp = (status.st_mtime, status.st_size)
    except OSError as problem:
        raise FlareFileError(f"{path} is missing; choose a .flare file that a fit wrote.") from problem
    known = _cache.get(str(path))
    if known is None or known[0] != stamp:
        try:
            result: Look | str = read(path)
        except FlareFileError as problem:
            result = str(problem)
        known = _cache[str(path)] = (stamp, result)
    if isinstance(known[1], str):
        raise FlareFileError(known[1])
    return known[1]


def is_placed(item: Any, scene: Any) -> bool:
    """Return whether the light object of a flare is in the scene; a deleted object stays assigned to the flare."""
    return item.target is not None and scene.objects.get(item.target.name) == item.target


def show_look(scene: Any, path: Path | str) -> Look:
    """Show a .flare in the scene: one flare for each of its lights, at the light object of the same name.

    Flares that were there keep their edits. Returns the look. Raises FlareFileError.
    """
    path = Path(path)
    look = read(path)
    state = scene.fit_flare
    before = state.flare
    state.flare = blend_relative(path)
    objects = {light_name(item): item for item in scene_lights(scene)}
    if before != state.flare:
        for index in reversed(range(len(state.lights))):
            if state.lights[index].source not in look.names:
                remove_flare(scene, index)
    for light in look.lights:
        item = next((entry for entry in state.lights if entry.source == light.name), None)
        if item is None:
            item = state.lights.add()
            item.name = item.source = light.name
        if item.target is None and light.name in objects:
            item.target = objects[light.name]
        _sync_elements(item, light)
    state.light = min(state.light, max(len(state.lights) - 1, 0))
    state.native = _was_learned_here(look, state, objects, depsgraph_of(scene))
    return look


def remove_flare(scene: Any, number: int) -> None:
    """Remove a flare from the scene.

    The flares after it keep their animation and their drivers in the compositor. The layer of the removed flare stays
    in the compositor as it was baked.
    """
    gains = drivers.connected_flares(scene)
    fcurves.remove_item(scene.fit_flare.lights, "fit_flare.lights", number)
    if gains:
        drivers.connect(scene, {layer: index - (index > number) for layer, index in gains.items() if index != number})


def _was_learned_here(look: Look, state: Any, objects: dict[str, Any], depsgraph: Any) -> bool:
    """Return whether the look was learned from the scene's capture, by the positions of the lights.

    A capture that was made from Blender's own camera has no root; its world is Blender's.
    """
    root = state.root
    shared = [light for light in look.lights if light.name in objects]
    if not (root is not None or state.capture) or not shared:
        return False
    extent = max(float(np.linalg.norm(light.query_range.camera_high - light.query_range.camera_low))
                 for light in shared)
    try:
        return all(np.linalg.norm(capture_position(objects[light.name], root, depsgraph) - light.xyz) < 0.05 * extent
                   for light in shared)
    except CaptureError:  # the position of one is unknown
        return False


def add_flare(scene: Any, target: Any, source: str) -> Any:
    """Add a flare at the object `target`, with the look of the .flare's light `source`. Raises FlareFileError."""
    look = look_of(scene)
    light = next((item for item in look.lights if item.name == source), None)
    if light is None:
        raise FlareFileError(f"{look.path} has no light {source!r}; it has {', '.join(look.names)}.")
    state = scene.fit_flare
    used_names = {item.name for item in state.lights}
    name, number = target.name, 2
    while name in used_names:
        name, number = f"{target.name} {number}", number + 1
    item = state.lights.add()
    item.name, item.source, item.target = name, source, target
    _sync_elements(item, light)
    state.light = len(state.lights) - 1
    return item


def _sync_elements(item: Any, light: Any) -> None:
    """Update the elements of a flare to those of its look; elements that stay keep their sliders."""
    kinds = {element.name: element.kind for element in light.elements}
    for index in reversed(range(len(item.elements))):
        if item.elements[index].name not in kinds:
            fcurves.remove_item(item.elements, f"{item.path_from_id()}.elements", index)
    existing = {element.name for element in item.elements}
    for name, kind in kinds.items():
        if name not in existing:
            item.elements.add().name = name
        next(element for element in item.elements if element.name == name).kind = kind


def edits_of(state: Any) -> LookEdits:
    """Return the edits that all sliders of a scene make."""
    neutral = Edit()
    lights = {item.name: edit for item in state.lights if (edit := edit_of(item)) != neutral}
    elements = {(item.name, element.name): edit for item in state.lights for element in item.elements
                if (edit := edit_of(element)) != neutral}
    return LookEdits(edit_of(state.master), lights, elements)


def duplicate_name(state: Any) -> str:
    """Return a name that two flares of the scene have; "" where all differ, as edits and layers require."""
    names = [item.name for item in state.lights]
    return next((name for name in names if names.count(name) > 1), "")


def query_of(state: Any) -> Query:
    """Return the view that the look is evaluated for: the camera's in its own capture, else a training view."""
    return "target" if state.native else "source"


def place_lights(scene: Any, depsgraph: Any, camera: Any) -> tuple[NDArray[np.float64], list[PlacedLight]]:
    """Return world_to_camera (4, 4) of a camera object, and the lights with their visibility.

    The coordinates are the capture's, or Blender's without a capture. Raises CaptureError.
    """
    state = scene.fit_flare
    matrix = camera.evaluated_get(depsgraph).matrix_world
    to_capture = cameras.world_to_capture(state.root, depsgraph)
    lights = []
    for item in state.lights:
        if not is_placed(item, scene):
            continue
        position = light_position(item.target, world_matrix(item.target, depsgraph), matrix.translation)
        visibility = occlusion.visibility(scene, depsgraph, matrix.translation, item) if state.occlusion else 1.0
        xyz = (to_capture @ np.array([*position, 1.0]))[:3]
        lights.append(PlacedLight(item.name, item.source, xyz, visibility))
    return cameras.pose_in_capture(matrix, state.root, depsgraph), lights


def evaluate_flares(scene: Any, depsgraph: Any, camera: Any) -> dict[str, PlaneGaussians]:
    """Evaluate every flare of the scene for a camera at the current frame. Raises FlareFileError and CaptureError."""
    look = look_of(scene)
    pose, lights = place_lights(scene, depsgraph, camera)
    gaussians = look.evaluate_lights(pose, lights, edits_of(scene.fit_flare), query_of(scene.fit_flare))
    exposure = camera.evaluated_get(depsgraph).fit_flare.exposure
    return {name: light_gaussians.with_exposure(exposure, look.blend) for name, light_gaussians in gaussians.items()}


def clear_cache() -> None:
    """Forget all files that were read."""
    _cache.clear()
