# SPDX-License-Identifier: GPL-3.0-or-later
"""The look of a scene: its .flare, which object each flare comes from, what it shows in a camera."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, FlareFileError
from ..core.look import Edit, Look, LookEdits, PlaneGaussians, read
from ..core.look.look import Query
from ..core.look.shot import PlacedLight, evaluate
from . import cameras, fcurves, occlusion
from .compositor import drivers
from .lights import name_of, of_scene, place_of, stands
from .objects import depsgraph_of, matrix_of
from .paths import absolute, stored
from .properties import edit_of

_cache: dict[str, tuple[tuple[float, int], Look | str]] = {}


def path_of(scene: Any) -> Path | None:
    """The .flare of the scene; None where none is chosen."""
    return absolute(scene.fit_flare.flare, scene.library) if scene.fit_flare.flare else None


def look_of(scene: Any) -> Look:
    """The scene's look, read again when the file changes. Raises FlareFileError."""
    path = path_of(scene)
    if path is None:
        raise FlareFileError("No flare is chosen; fit one, or open a .flare.")
    try:
        status = path.stat()
        stamp = (status.st_mtime, status.st_size)
    except OSError as problem:
        raise FlareFileError(f"{path} is missing; choose a .flare file that a fit has written.") from problem
    known = _cache.get(str(path))
    if known is None or known[0] != stamp:
        try:
            found: Look | str = read(path)
        except FlareFileError as problem:
            found = str(problem)
        known = _cache[str(path)] = (stamp, found)
    if isinstance(known[1], str):
        raise FlareFileError(known[1])
    return known[1]


def is_placed(item: Any, scene: Any) -> bool:
    """Whether a flare has a light in the scene; an object that was deleted there is still the flare's."""
    return item.target is not None and scene.objects.get(item.target.name) == item.target


def use(scene: Any, path: Path | str) -> Look:
    """Show a .flare in the scene: one flare for each of its lights, at the light object of that name.

    Edits of flares that stay are kept. Raises FlareFileError.
    """
    path = Path(path)
    look = read(path)
    state = scene.fit_flare
    before = state.flare
    state.flare = stored(path)
    objects = {name_of(item): item for item in of_scene(scene)}
    if before != state.flare:
        for index in reversed(range(len(state.lights))):
            if state.lights[index].source not in look.names:
                remove(scene, index)
    for light in look.lights:
        item = next((one for one in state.lights if one.source == light.name), None)
        if item is None:
            item = state.lights.add()
            item.name = item.source = light.name
        if item.target is None and light.name in objects:
            item.target = objects[light.name]
        _elements(item, light)
    state.light = min(state.light, max(len(state.lights) - 1, 0))
    state.native = _is_of(look, state, objects, depsgraph_of(scene))
    return look


def remove(scene: Any, number: int) -> None:
    """Take a flare out of the scene. Those after it keep their animation, and their wires to the compositor; its own
    layer is left there as it was baked."""
    gains = drivers.wired(scene)
    fcurves.take_out(scene.fit_flare.lights, "fit_flare.lights", number)
    if gains:
        drivers.wire(scene, {layer: one - (one > number) for layer, one in gains.items() if one != number})


def _is_of(look: Look, state: Any, objects: dict[str, Any], depsgraph: Any) -> bool:
    """Whether the look was learned in the scene's capture: its lights are where they were then. The world of a capture
    that was made of Blender's own camera, which has no root, is Blender's."""
    root = state.root
    shared = [light for light in look.lights if light.name in objects]
    if not (root is not None or state.capture) or not shared:
        return False
    extent = max(float(np.linalg.norm(light.query_range.camera_high - light.query_range.camera_low))
                 for light in shared)
    try:
        return all(np.linalg.norm(place_of(objects[light.name], root, depsgraph) - light.xyz) < 0.05 * extent
                   for light in shared)
    except CaptureError:  # nobody knows where one is
        return False


def add_instance(scene: Any, target: Any, source: str) -> Any:
    """One more flare: the look of the .flare's light `source`, coming from `target`. Raises FlareFileError."""
    look = look_of(scene)
    light = next((one for one in look.lights if one.name == source), None)
    if light is None:
        raise FlareFileError(f"{look.path} has no light {source!r}; it has {', '.join(look.names)}.")
    state = scene.fit_flare
    taken = {item.name for item in state.lights}
    name, number = target.name, 2
    while name in taken:
        name, number = f"{target.name} {number}", number + 1
    item = state.lights.add()
    item.name, item.source, item.target = name, source, target
    _elements(item, light)
    state.light = len(state.lights) - 1
    return item


def _elements(item: Any, light: Any) -> None:
    """Give a flare the elements of its look, keeping the sliders of those that stay."""
    wanted = {element.name: element.kind for element in light.elements}
    for index in reversed(range(len(item.elements))):
        if item.elements[index].name not in wanted:
            fcurves.take_out(item.elements, f"{item.path_from_id()}.elements", index)
    there = {element.name for element in item.elements}
    for name, kind in wanted.items():
        if name not in there:
            item.elements.add().name = name
        next(element for element in item.elements if element.name == name).kind = kind


def edits_of(state: Any) -> LookEdits:
    """All sliders of a scene."""
    neutral = Edit()
    lights = {item.name: edit for item in state.lights if (edit := edit_of(item)) != neutral}
    elements = {(item.name, element.name): edit for item in state.lights for element in item.elements
                if (edit := edit_of(element)) != neutral}
    return LookEdits(edit_of(state.master), lights, elements)


def twice(state: Any) -> str:
    """A name that two flares of the scene have, "" where all differ: edits and layers go by it."""
    names = [item.name for item in state.lights]
    return next((name for name in names if names.count(name) > 1), "")


def query_of(state: Any) -> Query:
    """What appearance follows: the view itself in the capture's own scene, else the middle of what was trained."""
    return "target" if state.native else "source"


def placed(scene: Any, depsgraph: Any, camera: Any) -> tuple[NDArray[np.float64], list[PlacedLight]]:
    """world_to_camera (4, 4) of a camera object and the lights with their visible shares, in the coordinates
    that the look is asked in: the capture's, or Blender's where there is no capture. Raises CaptureError."""
    state = scene.fit_flare
    matrix = camera.evaluated_get(depsgraph).matrix_world
    into = cameras.to_capture(state.root, depsgraph)
    lights = []
    for item in state.lights:
        if not is_placed(item, scene):
            continue
        where = stands(item.target, matrix_of(item.target, depsgraph), matrix.translation)
        share = occlusion.visible_share(scene, depsgraph, matrix.translation, item) if state.occlusion else 1.0
        xyz = (into @ np.array([*where, 1.0]))[:3]
        lights.append(PlacedLight(item.name, item.source, xyz, share))
    return cameras.pose_in_capture(matrix, state.root, depsgraph), lights


def seen(scene: Any, depsgraph: Any, camera: Any) -> dict[str, PlaneGaussians]:
    """What every flare of the scene shows in a camera at the present frame. Raises FlareFileError, CaptureError."""
    look = look_of(scene)
    pose, lights = placed(scene, depsgraph, camera)
    found = evaluate(look, pose, lights, edits_of(scene.fit_flare), query_of(scene.fit_flare))
    exposure = camera.evaluated_get(depsgraph).fit_flare.exposure
    return {name: one.exposed(exposure, look.blend) for name, one in found.items()}


def forget() -> None:
    """Let go of all files that were read."""
    _cache.clear()
