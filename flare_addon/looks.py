# SPDX-License-Identifier: GPL-3.0-or-later
"""The look of a scene: its .flare, the flares with their light objects and edits, and their evaluation for a camera."""
from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import CaptureError, FlareFileError, SettingsError
from ..core.look import Edit, LightLook, Look, LookEdits, PlacedLight, PlaneGaussians, read_look
from ..core.look.look import Query
from ..core.look.network import OffsetsBudget
from . import cameras, fcurves, lamp_drive, light_extents, occlusion, stereo
from .compositor import drivers
from .lights import capture_position, free_name, light_name, light_position, scene_lights
from .objects import depsgraph_of, world_matrix
from .paths import absolute, blend_relative
from .properties import EDIT_NAMES, edit_of, set_slider

MIN_LIGHTS_FOR_BOXES = 8
"""Lights from which on the boxes of all objects cost less than the rays that they save."""

_look_cache: dict[str, tuple[tuple[float, int], Look | str]] = {}


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
    cached = _look_cache.get(str(path))
    if cached is None or cached[0] != stamp:
        try:
            result: Look | str = read_look(path)
        except FlareFileError as problem:
            result = str(problem)  # kept too, so that a panel does not read a bad file at each redraw
        cached = _look_cache[str(path)] = (stamp, result)
    if isinstance(cached[1], str):
        raise FlareFileError(cached[1])
    return cached[1]


def is_placed(item: Any, scene: Any) -> bool:
    """Return whether the light object of a flare is in the scene; a deleted object stays assigned to the flare."""
    return item.target is not None and scene.objects.get(item.target.name) == item.target


def show_look(scene: Any, path: Path | str, targets: Sequence[Any] = (), *, add: bool = False) -> Look:
    """Set the scene's .flare and match its flares to the lights of the new look. Raises FlareFileError.

    Each existing flare gets the first of these lights that the new look has: the one named like the flare's first
    light, the one named like its present light, else the one at the position of its first light among the first lights
    of all flares. The flare keeps its light object and its sliders, also sliders of elements that the look lacks.
    Sliders that the artist has not moved take the values of the file.

    A light of the look without a flare gets one if a light object has its name, or if the scene had no flare at all.
    The objects `targets` become the light objects of flares that have none. Without `add`, flares whose light object
    was deleted count as such too. add: each remaining target gets a flare of its own. Targets that have a flare already
    are skipped. Returns the look.
    """
    path = Path(path)
    look = read_look(path)
    state = scene.fit_flare
    is_first = not state.lights
    _change_look(scene, _stored_edits(scene), look)
    state.flare = blend_relative(path)
    state.file_edits = json.dumps([list(look.names), look.edits.texts()])
    objects = {light_name(lamp): lamp for lamp in scene_lights(scene)}
    for light in look.lights:
        flare = next((entry for entry in state.lights if entry.source == light.name), None)
        if flare is None and (is_first or light.name in objects):
            flare = _new_flare(state, look, light)
            flare.name = free_name(light.name, {entry.name for entry in state.lights})
        lamp = objects.get(light.name)
        if flare is not None and flare.target is None and lamp is not None and lamp not in _used_targets(state):
            flare.target = lamp
    _place_flares(scene, look, targets, add)
    state.light = min(state.light, max(len(state.lights) - 1, 0))
    # Blender shows this property as "Of This Capture".
    state.native = _is_of_this_capture(look, state, objects, depsgraph_of(scene))
    return look


def _used_targets(state: Any) -> list[Any]:
    """Return the light objects of all flares."""
    return [item.target for item in state.lights if item.target is not None]


def _place_flares(scene: Any, look: Look, targets: Sequence[Any], add: bool) -> None:
    """Place flares without a light object at these targets; with `add`, add a flare at each of the remaining ones."""
    state = scene.fit_flare
    remaining = [target for target in targets if target not in _used_targets(state)]
    unplaced = [item for item in state.lights if item.target is None or not (add or is_placed(item, scene))]
    for item in unplaced[:len(remaining)]:
        item.target = remaining.pop(0)
        if len(look.lights) == 1 and item.name == item.source:  # a name of the file tells an artist nothing
            item.name = free_name(item.target.name, {entry.name for entry in state.lights if entry != item})
        lamp_drive.measure_references(scene, item)
    for target in remaining if add else ():
        add_flare(scene, target, look.names[0])


def _stored_edits(scene: Any) -> LookEdits:
    """Return the edits that the scene's .flare had when it was opened, whatever has become of the file since."""
    try:
        names, texts = json.loads(scene.fit_flare.file_edits)
        return LookEdits.parse(texts, names)
    except (ValueError, TypeError, SettingsError):  # a .blend of an earlier version does not store them
        pass
    try:
        return look_of(scene).edits
    except FlareFileError:
        return LookEdits()


def _change_look(scene: Any, before: LookEdits, look: Look) -> None:
    """Give each flare a light of the look, as `show_look` describes.

    before: the edits in the earlier file. Sliders that still have these values get the values of the look's file. A
    flare without a light object is removed where another flare has the look of its light, unless the artist has edited
    it.
    """
    state, neutral, after = scene.fit_flare, Edit(), look.edits
    for item in state.lights:
        item.first_source = item.first_source or item.source
    first_sources = list(dict.fromkeys(item.first_source for item in state.lights))
    _follow_edit(state.master, before.master, after.master)
    for item in state.lights:
        old_source = item.source
        number = first_sources.index(item.first_source) % len(look.names)
        item.source = next((name for name in (item.first_source, old_source) if name in look.names), look.names[number])
        _follow_edit(item, before.lights.get(old_source, neutral), after.lights.get(item.source, neutral))
        for element in item.elements:
            _follow_edit(element, before.elements.get((old_source, element.name), neutral),
                         after.elements.get((item.source, element.name), neutral))
        _sync_elements(item, look, next(light for light in look.lights if light.name == item.source))
    for index in reversed(range(len(state.lights))):
        sources = [item.source for item in state.lights]
        if (sources.count(sources[index]) > 1 and not is_placed(state.lights[index], scene)
                and not _is_edited(state.lights[index])):
            remove_flare(scene, index)


def _follow_edit(sliders: Any, before: Edit, after: Edit) -> None:
    """Set each slider that the artist has not moved to the value of `after`.

    A slider whose value differs from `before` counts as moved, for all later looks too.
    """
    current, moved = edit_of(sliders), set(sliders.moved_sliders.split())
    moved |= {name for name in EDIT_NAMES
               if not np.allclose(getattr(current, name), getattr(before, name), rtol=1e-5, atol=1e-6)}
    for name in EDIT_NAMES:
        if name not in moved:
            set_slider(sliders, name, getattr(after, name))
    sliders.moved_sliders = " ".join(sorted(moved))


def _is_edited(item: Any) -> bool:
    """Return whether the artist has moved or animated sliders of a flare; `_follow_edit` has compared them."""
    return (bool(item.moved_sliders) or any(element.moved_sliders for element in item.elements)
            or fcurves.is_animated(item.id_data, item.path_from_id()))


def _new_flare(state: Any, look: Look, light: LightLook) -> Any:
    """Add a flare with the look of `light` and the edits in the look's file; return it."""
    item = state.lights.add()
    item.source = light.name
    _follow_edit(item, Edit(), look.edits.lights.get(light.name, Edit()))
    _sync_elements(item, look, light)
    return item


def edits_to_store(state: Any, look: Look) -> LookEdits:
    """Return the edits of the scene by the names of the look's lights, as a file of the library stores them.

    Where several flares have the look of one light, the edits of the chosen flare are taken, else those of the first.
    """
    edits, sources = edits_of(state), {item.source: item.name for item in reversed(state.lights)}
    if 0 <= state.light < len(state.lights):
        sources[state.lights[state.light].source] = state.lights[state.light].name
    names = {name: source for source, name in sources.items() if source in look.names}
    return LookEdits(edits.master, {names[name]: edit for name, edit in edits.lights.items() if name in names},
                     {(names[name], part): edit for (name, part), edit in edits.elements.items() if name in names})


def unstored_settings(scene: Any, stored: LookEdits) -> list[str]:
    """Return phrases for a message: the settings of the scene's flares that a .flare does not store.

    stored: the edits that it stores, of `edits_to_store`.
    """
    state, edits, neutral = scene.fit_flare, edits_of(scene.fit_flare), Edit()
    result = [f"the sliders of {item.name}" for item in state.lights
              if edits.lights.get(item.name, neutral) != stored.lights.get(item.source, neutral)
              or any(edits.elements.get((item.name, element.name), neutral)
                     != stored.elements.get((item.source, element.name), neutral) for element in item.elements)]
    if any(fcurves.is_animated(scene, f"fit_flare.{name}") for name in ("master", "lights")):
        result.append("keys and drivers")
    switched = [item.name for item in state.lights if item.target is not None and (
        item.extent != "auto" or item.radius > 0
        or any(getattr(item, name) != item.is_at_artists_light for name in lamp_drive.SWITCHES))]
    if switched:
        result.append(f"the Follow switches, Extent and Light Size of {', '.join(switched)}")
    return result


def lost_flares(scene: Any) -> list[int]:
    """Return the indices of the flares whose light object was deleted from the scene."""
    return [index for index, item in enumerate(scene.fit_flare.lights)
            if item.target is not None and not is_placed(item, scene)]


def remove_flare(scene: Any, number: int) -> None:
    """Remove the flare with this index from the scene.

    The flares after it keep their animation and their drivers in the compositor. The layer of the removed flare stays
    in the compositor as it was baked.
    """
    flare_by_layer = drivers.connected_flares(scene)
    fcurves.remove_item(scene.fit_flare.lights, "fit_flare.lights", number)
    if flare_by_layer:
        remaining = {layer: index - (index > number) for layer, index in flare_by_layer.items() if index != number}
        drivers.connect_node(scene, remaining)


def _is_of_this_capture(look: Look, state: Any, objects: dict[str, Any], depsgraph: Any) -> bool:
    """Return whether the look was learned from the scene's capture: lights of the same name are at the same positions.

    Positions may differ by 5% of the extent of the look's training cameras. objects: the scene's light objects by name.
    A capture that was made from Blender's own camera has no root; its world is Blender's.
    """
    root = state.root
    shared = [light for light in look.lights if light.name in objects]
    if not (root is not None or state.capture) or not shared:
        return False
    camera_span = max(float(np.linalg.norm(light.query_range.camera_high - light.query_range.camera_low))
                      for light in shared)
    try:
        return all(
            np.linalg.norm(capture_position(objects[light.name], root, depsgraph) - light.xyz) < 0.05 * camera_span
            for light in shared)
    except CaptureError:  # a light is disabled, so its position is unknown
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
    item = _new_flare(state, look, light)
    item.name, item.target = name, target
    lamp_drive.measure_references(scene, item)
    state.light = len(state.lights) - 1
    return item


def _sync_elements(item: Any, look: Look, light: LightLook) -> None:
    """Give a flare the elements of its look's light; elements that it had keep their sliders, new ones start with the
    edits in the look's file.

    Elements that the light lacks are marked as absent. They keep their indices, and so their keys and drivers.
    """
    kinds = {element.name: element.kind for element in light.elements}
    for element in item.elements:
        element.is_absent = element.name not in kinds
    existing = {element.name for element in item.elements}
    for name, kind in kinds.items():
        if name not in existing:
            new_element = item.elements.add()
            new_element.name = name
            _follow_edit(new_element, Edit(), look.edits.elements.get((light.name, name), Edit()))
        next(element for element in item.elements if element.name == name).kind = kind


def update_elements(scene: Any) -> None:
    """Give all flares the elements of the scene's .flare, which may have been replaced since it was opened.

    Raises FlareFileError.
    """
    look = look_of(scene)
    lights = {light.name: light for light in look.lights}
    for item in scene.fit_flare.lights:
        if item.source in lights:
            _sync_elements(item, look, lights[item.source])


def present_elements(item: Any) -> list[Any]:
    """Return the elements of a flare that its look has."""
    return [element for element in item.elements if not element.is_absent]


def edits_of(state: Any) -> LookEdits:
    """Return the edits that all sliders of a scene make.

    Sliders of elements that the look lacks make no edits. This also holds if another program has replaced the .flare
    since it was opened.
    """
    neutral = Edit()
    try:
        lights_of_look = look_of(state.id_data).lights
    except FlareFileError:  # it cannot be evaluated either
        lights_of_look = ()
    names = {(light.name, element.name) for light in lights_of_look for element in light.elements}
    lights = {item.name: edit for item in state.lights if (edit := edit_of(item)) != neutral}
    elements = {(item.name, element.name): edit for item in state.lights for element in present_elements(item)
                if (item.source, element.name) in names and (edit := edit_of(element)) != neutral}
    return LookEdits(edit_of(state.master), lights, elements)


def duplicate_name(state: Any) -> str:
    """Return a name that two flares of the scene have; "" where all differ, as edits and layers require."""
    names = [item.name for item in state.lights]
    return next((name for name in names if names.count(name) > 1), "")


def query_of(state: Any) -> Query:
    """Return the view that the look is evaluated for: the camera's in its own capture, else a training view."""
    return "target" if state.native else "source"


def place_lights(scene: Any, depsgraph: Any, camera: Any,
                 eye: stereo.Eye = "") -> tuple[NDArray[np.float64], list[PlacedLight]]:
    """Return world_to_camera (4, 4) of a camera object, moved to an eye, and the lights with their visibility.

    The coordinates are the capture's, or Blender's without a capture. Raises CaptureError.
    """
    state = scene.fit_flare
    matrix = stereo.eye_matrix(camera.evaluated_get(depsgraph), eye)
    to_capture = cameras.world_to_capture(state.root, depsgraph)
    rendered = lamp_drive.rendered_collections(scene)
    items = [item for item in state.lights if is_placed(item, scene)]
    occluders = occlusion.Occluders(depsgraph) if state.occlusion and len(items) >= MIN_LIGHTS_FOR_BOXES else None
    lights = [place_light(scene, depsgraph, matrix, to_capture, item, hides=state.occlusion, rendered=rendered,
                          occluders=occluders) for item in items]
    return cameras.pose_in_capture(matrix, state.root, depsgraph), lights


def place_light(scene: Any, depsgraph: Any, camera: Any, to_capture: NDArray[np.float64], item: Any, *,
                hides: bool, rendered: set[Any], occluders: occlusion.Occluders | None = None) -> PlacedLight:
    """Return the light of a flare as a camera sees it. Of a light with an extent, `shares` has the visible share of
    each cell, and the visibility is 1.

    Raises CaptureError where the light's object is disabled, so that its place is unknown, unless its flare is dark.
    camera: matrix_world of the camera. to_capture: matrix (4, 4) from Blender's world to the coordinates of the result.
    item: the flare. hides: whether objects hide the light. rendered: the collections that renders show.
    occluders: boxes of the objects that may hide lights, None to cast all rays.
    """
    camera_position, target = camera.translation, item.target
    is_dark = item.follow_visibility and not lamp_drive.is_visible(target, depsgraph, rendered)
    try:
        matrix = world_matrix(target, depsgraph)
    except CaptureError:
        if not is_dark:
            raise
        # Of a disabled object the last known position is good enough, since its flare is dark.
        xyz = (to_capture @ np.array([*target.matrix_world.translation, 1.0]))[:3]
        return PlacedLight(item.name, item.source, xyz, 0.0, factor=lamp_drive.DARK)
    position = light_position(target, matrix, camera_position)
    xyz = (to_capture @ np.array([*position, 1.0]))[:3]
    # A dark light has its visibility too, since a transfer smooths visibilities over neighbouring frames.
    gain = lamp_drive.DARK if is_dark else lamp_drive.flare_gain(scene, depsgraph, item, matrix, camera_position)
    reference = item.reference_distance if item.follow_distance and not lamp_drive.is_sun(target) else 0.0
    reference *= float(np.cbrt(abs(np.linalg.det(to_capture[:3, :3]))))  # scene units to units of the capture
    extent = light_extents.extent_of(item, depsgraph, matrix)
    if extent is None:
        visibility = occlusion.visibility(scene, depsgraph, camera_position, item, occluders) if hides else 1.0
        return PlacedLight(item.name, item.source, xyz, visibility, factor=gain, reference_distance=reference)
    extent, shares = extent.transformed(to_capture[:3, :3]), None
    if hides:
        cells = extent.sampled(xyz, cameras.transformed_pose(camera, to_capture))
        points = (np.pad(cells.points, ((0, 0), (0, 1)), constant_values=1) @ np.linalg.inv(to_capture).T)[:, :3]
        shares = tuple(cells.shares(occlusion.visible_points(scene, depsgraph, camera_position, item, points)).tolist())
    return PlacedLight(item.name, item.source, xyz, 1.0, extent, shares, gain, reference)


def evaluate_flares(scene: Any, depsgraph: Any, camera: Any, edits: LookEdits | None = None,
                    budget: OffsetsBudget | None = None, *, eye: stereo.Eye = "") -> dict[str, PlaneGaussians]:
    """Evaluate every flare of the scene for a camera object at the current frame; return the Gaussians by flare's name.

    edits: in place of the edits of the scene's sliders. budget: bounds the time for the network; None for exact flares.
    eye: the eye to which the camera is moved. Raises FlareFileError and CaptureError.
    """
    look = look_of(scene)
    pose, lights = place_lights(scene, depsgraph, camera, eye)
    edits = edits or edits_of(scene.fit_flare)
    gaussians = look.evaluate_lights(pose, lights, None if edits.is_neutral else edits, query_of(scene.fit_flare),
                                     budget)
    exposure = camera.evaluated_get(depsgraph).fit_flare.exposure
    return {name: light_gaussians.with_exposure(exposure, look.blend) for name, light_gaussians in gaussians.items()}


def clear_cache() -> None:
    """Forget all files that were read."""
    _look_cache.clear()
