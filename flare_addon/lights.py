# SPDX-License-Identifier: GPL-3.0-or-later
"""Light objects of a scene, and their exchange with the lights.json of the capture."""
from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mathutils import Vector
from numpy.typing import ArrayLike

from ..core.capture import LIGHTS, read_lights
from ..core.errors import CaptureError
from ..core.system.files import follow_link, read_json, round_for_text, write_json
from ..core.system.steps import finish
from . import cameras, light_paths
from .capture.importer import add_light
from .objects import depsgraph_of, view_layer_of, world_matrix
from .paths import absolute

SUN_DISTANCE = 1e4
"""Distance of a sun from the camera, scene units."""

_names_cache: dict[Path, tuple[tuple[int, int], tuple[str, ...]]] = {}


def scene_lights(scene: Any) -> list[Any]:
    """Return the light objects of the scene's capture, sorted by the name of the light."""
    root = scene.fit_flare.root
    objects = [item for item in scene.objects if item.fit_flare.is_light and not _belongs_to_other_capture(item, root)]
    return sorted(objects, key=lambda item: light_name(item).casefold())


def _belongs_to_other_capture(light: Any, root: Any) -> bool:
    """Return whether a light belongs to another imported capture than the one below `root`; False without a root."""
    parent = light.parent if root is not None else None
    while parent is not None and parent != root:
        if parent.fit_flare.is_root:
            return True
        parent = parent.parent
    return False


def light_name(light: Any) -> str:
    """Return the name of the light in lights.json."""
    return light.fit_flare.light or light.name


def capture_position(light: Any, root: Any, depsgraph: Any) -> Any:
    """Return the position (3,) in the capture's coordinates. Raises CaptureError as `world_matrix` does."""
    return cameras.point_in_capture(world_matrix(light, depsgraph).translation, root, depsgraph)


def light_position(light: Any, matrix: Any, eye: Any) -> Any:
    """Return the position of a light in the world as seen from `eye`; `matrix` is its matrix_world.

    A sun is SUN_DISTANCE away against its direction, independent of the position of its object.
    """
    if light.type == "LIGHT" and light.data.type == "SUN":
        return eye + (matrix.to_3x3() @ Vector((0.0, 0.0, 1.0))).normalized() * SUN_DISTANCE
    return matrix.translation.copy()


def add_to_scene(scene: Any, position: Any, name: str = "") -> Any:
    """Add a light at a point (3,) of Blender's world; return its object. Raises CaptureError for a disabled root."""
    state = scene.fit_flare
    root = state.root
    used_names = {light_name(item) for item in scene_lights(scene)}
    name = free_name(name or "light1", used_names)
    size = max((item.empty_display_size for item in scene_lights(scene) if item.type == "EMPTY"), default=0.2)
    local = cameras.point_in_capture(position, root, depsgraph_of(scene))
    return add_light(_collection_of(scene), root, name, local, size)


def _collection_of(scene: Any) -> Any:
    """Return the collection for new lights: that of the root, unless it is of another scene or file."""
    root, collections = scene.fit_flare.root, {scene.collection, *scene.collection.children_recursive}
    root_collections = () if root is None else root.users_collection
    return next((item for item in root_collections
                 if item in collections and item.library is None and item.override_library is None), scene.collection)


def mark_as_lights(objects: Iterable[Any], used_names: set[str]) -> int:
    """Mark objects as lights of the capture; return how many were not lights before."""
    count = 0
    for item in objects:
        if item.type != "CAMERA" and not item.fit_flare.is_light:
            name = free_name(item.name, used_names)
            used_names.add(name)
            item.fit_flare.is_light, item.fit_flare.light = True, name
            count += 1
    return count


def free_name(name: str, used_names: set[str]) -> str:
    """Return `name`, with another number where it is taken."""
    stem = name.rstrip("0123456789") or "light"
    number = 1
    while name in used_names:
        number += 1
        name = f"{stem}{number}"
    return name


def write_to_capture(scene: Any, folder: Path) -> int:
    """Write the scene's lights to the capture's lights.json; return the number of lights in it.

    Entries keep their other keys, and lights that the scene never had are kept. Raises CaptureError where the scene has
    no lights, two have the same name, or the position of one is unknown.
    """
    objects = scene_lights(scene)
    if not objects:
        raise CaptureError("There are no lights to fit a flare to; add one, or find them in the frames.")
    names = [light_name(item) for item in objects]
    if len(set(names)) < len(names):
        duplicate = next(name for name in names if names.count(name) > 1)
        raise CaptureError(f"Two lights have the name {duplicate!r}; rename one in the panel Lights.")
    path = folder / LIGHTS
    data: dict[str, Any] = read_json(path, CaptureError) if path.is_file() else {}
    entries_by_name = {entry.get("name"): entry for entry in data.get("lights", []) if isinstance(entry, dict)}
    lights = [entries_by_name[name] for name in new_light_names(scene, folder)]
    # The camera's position, from which a sun is placed.
    eye = scene.camera.matrix_world.translation if scene.camera is not None else objects[0].matrix_world.translation

    def position_in_capture(item: Any) -> Any:
        """Return the light's position (3,) in the capture's coordinates at the current frame of the scene."""
        depsgraph = depsgraph_of(scene)
        return cameras.point_in_capture(light_position(item, world_matrix(item, depsgraph), eye), scene.fit_flare.root,
                                        depsgraph)

    paths = light_paths.world_paths(scene, dict(zip(names, objects, strict=True)),
                                    light_paths.frame_numbers(folder), position_in_capture)
    for item, name in zip(objects, names, strict=True):
        xyz = [round_for_text(float(value)) for value in position_in_capture(item)]
        lights.append(light_paths.merge_entry(entries_by_name.get(name, {}), name, xyz, paths.get(name, {})))
    if lights != data.get("lights"):
        write_json(follow_link(path), {**data, "lights": lights})
    remember_names(scene)
    return len(lights)


def remember_names(scene: Any) -> None:
    """Add the names of the scene's lights to those that it stores: a stored light that is missing later was removed."""
    state = scene.fit_flare
    names = {*state.known_lights.split("\n"), *map(light_name, scene_lights(scene))} - {""}
    if not state.is_property_set("known_lights") and state.capture:  # a .blend of an earlier version had all of them
        with contextlib.suppress(CaptureError):
            names |= {light.name for light in read_lights(absolute(state.capture, scene.library) / LIGHTS)}
    state.known_lights = "\n".join(sorted(names))


def new_light_names(scene: Any, folder: Path) -> list[str]:
    """Return the names in the capture's lights.json that the scene never had.

    The engine may find lights while the .blend is closed. Empty for a .blend of an earlier version, which did not
    store the names.
    """
    if not scene.fit_flare.is_property_set("known_lights"):
        return []
    names = _names_in(folder / LIGHTS)
    known_names = {*scene.fit_flare.known_lights.split("\n"), *map(light_name, scene_lights(scene))} if names else set()
    return [name for name in names if name not in known_names]


def _names_in(path: Path) -> tuple[str, ...]:
    """Return the names in a lights.json, cached until the file changes; empty where it cannot be read."""
    try:
        stat = path.stat()
        stamp = (stat.st_mtime_ns, stat.st_size)
        if path not in _names_cache or _names_cache[path][0] != stamp:
            _names_cache[path] = (stamp, tuple(light.name for light in read_lights(path)))
        return _names_cache[path][1]
    except (OSError, CaptureError):
        return ()


def import_new_lights(scene: Any, folder: Path) -> int:
    """Add the lights of lights.json that the scene never had, or all where it has no lights; return their number.

    Existing lights are not moved. Raises CaptureError.
    """
    existing = scene_lights(scene)
    names = set(new_light_names(scene, folder)) if existing else None
    new_lights = [light for light in read_lights(folder / LIGHTS) if names is None or light.name in names]
    collection = _collection_of(scene)
    size = max((item.empty_display_size for item in existing if item.type == "EMPTY"), default=0.2)
    capture_and_frames = light_paths.capture_of_moving_lights(folder, new_lights)
    for light in new_lights:
        # The position of a light that moves is NaN; its keys place it.
        item = add_light(collection, scene.fit_flare.root, light.name, np.nan_to_num(light.xyz), size)
        if capture_and_frames is not None and light.moves:
            finish(light_paths.key_light_path(item, light, *capture_and_frames))
    remember_names(scene)
    return len(new_lights)


def _move_to(light: Any, xyz: ArrayLike) -> None:
    """Move a child of the root to a point (3,) of the capture's coordinates.

    The parent inverse is taken into account, which Blender sets where an object is parented with Ctrl+P.
    """
    light.location = light.matrix_parent_inverse.inverted_safe() @ Vector(np.asarray(xyz).tolist())


def move_to_fit(scene: Any, fitted: Mapping[str, ArrayLike], capture: Path | None) -> None:
    """Move lights to their positions from a fit.

    Only lights that are still where the capture's lights.json, from which the fit started, has them are moved; none
    that is animated or has another parent than the root. fitted: positions (3,) by name, in the capture's coordinates.
    capture: its folder; None moves nothing.
    """
    path = None if capture is None else capture / LIGHTS
    captured = {} if path is None or not path.is_file() else {light.name: light.xyz for light in read_lights(path)}
    depsgraph = depsgraph_of(scene)
    for item in scene_lights(scene):
        name = light_name(item)
        is_still = item.parent == scene.fit_flare.root and item.animation_data is None
        if name in fitted and name in captured and is_still:
            try:
                position = capture_position(item, scene.fit_flare.root, depsgraph)
            except CaptureError:  # it is disabled, and its position is unknown
                continue
            is_unmoved = np.allclose(position, captured[name], atol=1e-4)
            if is_unmoved and not np.allclose(position, fitted[name], atol=1e-4):
                _move_to(item, fitted[name])
    view_layer_of(scene).update()
