# SPDX-License-Identifier: GPL-3.0-or-later
"""Light objects: which there are, and how they become the lights.json of a fit."""
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
from ..core.system.files import named_by, read_json, rounded, write_json
from . import cameras
from .capture.importer import add_light
from .objects import depsgraph_of, matrix_of, view_layer_of
from .paths import absolute

SUN_DISTANCE = 1e4
"""Scene units at which a sun is from who looks."""

_listed: dict[Path, tuple[tuple[int, int], tuple[str, ...]]] = {}


def of_scene(scene: Any) -> list[Any]:
    """The objects of the scene that stand for lights of its capture, by name of the light."""
    root = scene.fit_flare.root
    found = [item for item in scene.objects if item.fit_flare.is_light and not _is_of_another(item, root)]
    return sorted(found, key=lambda item: name_of(item).casefold())


def _is_of_another(light: Any, root: Any) -> bool:
    """Whether a light belongs to another capture that was imported than the one `root` carries."""
    parent = light.parent if root is not None else None
    while parent is not None and parent != root:
        if parent.fit_flare.is_root:
            return True
        parent = parent.parent
    return False


def name_of(light: Any) -> str:
    """The light's name in lights.json."""
    return light.fit_flare.light or light.name


def place_of(light: Any, root: Any, depsgraph: Any) -> Any:
    """(3,) position in the capture's coordinates. Raises CaptureError as `matrix_of` does."""
    return cameras.point_in_capture(matrix_of(light, depsgraph).translation, root, depsgraph)


def stands(light: Any, matrix: Any, eye: Any) -> Any:
    """Where a light is for who looks from `eye`, in the world, `matrix` being its matrix_world: a sun is far away
    against its direction, wherever its object is put."""
    if light.type == "LIGHT" and light.data.type == "SUN":
        return eye + (matrix.to_3x3() @ Vector((0.0, 0.0, 1.0))).normalized() * SUN_DISTANCE
    return matrix.translation.copy()


def add(scene: Any, where: Any, name: str = "") -> Any:
    """A new light at a point (3,) of Blender's world. Raises CaptureError as `matrix_of` does."""
    state = scene.fit_flare
    root = state.root
    taken = {name_of(item) for item in of_scene(scene)}
    name = free_name(name or "light1", taken)
    size = max((item.empty_display_size for item in of_scene(scene) if item.type == "EMPTY"), default=0.2)
    local = cameras.point_in_capture(where, root, depsgraph_of(scene))
    return add_light(_collection_of(scene), root, name, local, size)


def _collection_of(scene: Any) -> Any:
    """Where new lights of a scene go: beside its root, unless that is another scene's or file's."""
    root, own = scene.fit_flare.root, {scene.collection, *scene.collection.children_recursive}
    beside = () if root is None else root.users_collection
    return next((one for one in beside if one in own and one.library is None and one.override_library is None),
                scene.collection)


def take(objects: Iterable[Any], taken: set[str]) -> int:
    """Make objects lights of the capture; how many were not before."""
    made = 0
    for item in objects:
        if item.type != "CAMERA" and not item.fit_flare.is_light:
            name = free_name(item.name, taken)
            taken.add(name)
            item.fit_flare.is_light, item.fit_flare.light = True, name
            made += 1
    return made


def free_name(name: str, taken: set[str]) -> str:
    """`name`, with another number where it is taken."""
    stem = name.rstrip("0123456789") or "light"
    number = 1
    while name in taken:
        number += 1
        name = f"{stem}{number}"
    return name


def write(scene: Any, folder: Path) -> int:
    """Write the scene's lights to the capture's lights.json; how many there are then. Entries keep what else was said
    of them, and lights that the scene has never had stay.

    Raises CaptureError where there are none, two have one name, or one is where nobody knows.
    """
    objects = of_scene(scene)
    if not objects:
        raise CaptureError("There are no lights to fit a flare to; add one, or find them in the frames.")
    names = [name_of(item) for item in objects]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise CaptureError(f"Two lights have the name {twice!r}; rename one in the panel Lights.")
    path = folder / LIGHTS
    data: dict[str, Any] = read_json(path, CaptureError) if path.is_file() else {}
    known = {entry.get("name"): entry for entry in data.get("lights", []) if isinstance(entry, dict)}
    lights, depsgraph = [known[name] for name in unknown(scene, folder)], depsgraph_of(scene)
    eye = scene.camera.matrix_world.translation if scene.camera is not None else objects[0].matrix_world.translation
    for item, name in zip(objects, names, strict=True):
        where = stands(item, matrix_of(item, depsgraph), eye)
        xyz = cameras.point_in_capture(where, scene.fit_flare.root, depsgraph)
        lights.append({**known.get(name, {}), "name": name, "xyz": [rounded(float(value)) for value in xyz]})
    if lights != data.get("lights"):
        write_json(named_by(path), {**data, "lights": lights})
    remember(scene)
    return len(lights)


def remember(scene: Any) -> None:
    """Note the names of the scene's lights: one that the scene has had and has no more was taken out on purpose."""
    state = scene.fit_flare
    names = {*state.known_lights.split("\n"), *map(name_of, of_scene(scene))} - {""}
    if not state.is_property_set("known_lights") and state.capture:  # a .blend of the version before: it had them all
        with contextlib.suppress(CaptureError):
            names |= {light.name for light in read_lights(absolute(state.capture, scene.library) / LIGHTS)}
    state.known_lights = "\n".join(sorted(names))


def unknown(scene: Any, folder: Path) -> list[str]:
    """Names of the lights in the capture's lights.json that the scene has never had: found by the engine while the
    .blend was closed, or by a command. None where a .blend of the version before says nothing of those it had."""
    if not scene.fit_flare.is_property_set("known_lights"):
        return []
    found = _names_in(folder / LIGHTS)
    had = {*scene.fit_flare.known_lights.split("\n"), *map(name_of, of_scene(scene))} if found else set()
    return [name for name in found if name not in had]


def _names_in(path: Path) -> tuple[str, ...]:
    """The names in a lights.json, which is read again where it is another: the panel asks at each redraw. None where it
    cannot be read."""
    try:
        stat = path.stat()
        state = (stat.st_mtime_ns, stat.st_size)
        if path not in _listed or _listed[path][0] != state:
            _listed[path] = (state, tuple(light.name for light in read_lights(path)))
        return _listed[path][1]
    except (OSError, CaptureError):
        return ()


def bring_in(scene: Any, folder: Path) -> int:
    """Bring lights of lights.json into the scene that it has never had; all of them into a scene that has none. How
    many. Those that are there stay where they are, which may be elsewhere by now. Raises CaptureError."""
    there = of_scene(scene)
    wanted = set(unknown(scene, folder)) if there else None
    found = [light for light in read_lights(folder / LIGHTS) if wanted is None or light.name in wanted]
    collection = _collection_of(scene)
    size = max((item.empty_display_size for item in there if item.type == "EMPTY"), default=0.2)
    for light in found:
        add_light(collection, scene.fit_flare.root, light.name, light.xyz, size)
    remember(scene)
    return len(found)


def _put(light: Any, xyz: ArrayLike) -> None:
    """Move a child of the root to a point (3,) of the capture's coordinates; one that was parented where it stood, as
    Ctrl+P does it, has a place of its own."""
    light.location = light.matrix_parent_inverse.inverted_safe() @ Vector(np.asarray(xyz).tolist())


def follow(scene: Any, places: Mapping[str, ArrayLike], capture: Path | None) -> None:
    """Move lights to where a fit has put them (3,), by name, in the capture's coordinates: those that still are where
    the fit was given them, as the capture's lights.json has it, and that nothing else moves."""
    path = None if capture is None else capture / LIGHTS
    given = {} if path is None or not path.is_file() else {light.name: light.xyz for light in read_lights(path)}
    depsgraph = depsgraph_of(scene)
    for item in of_scene(scene):
        name = name_of(item)
        if name in places and name in given and item.parent == scene.fit_flare.root and item.animation_data is None:
            try:
                where = place_of(item, scene.fit_flare.root, depsgraph)
            except CaptureError:  # it is switched off, and something else moves it
                continue
            if np.allclose(where, given[name], atol=1e-4) and not np.allclose(where, places[name], atol=1e-4):
                _put(item, places[name])
    view_layer_of(scene).update()
