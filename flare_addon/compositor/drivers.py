# SPDX-License-Identifier: GPL-3.0-or-later
"""Drivers by which the sliders of the panel Look act on the node "Fit Flare".

They apply what the layers were baked without: intensity, tint, mute and solo of all lights and of each. Their paths
contain the indices of the flares, which `looks.remove_flare` keeps valid.
"""
from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import bpy

from .. import fcurves
from .flare_node import GROUP, find_node, gain_input, layer_of_gain
from .trees import GROUPS_ARE_TREES, tree_of

SOLOS = "solos"  # a property of the node: how many flares are solo
_INPUT_PATH = re.compile(rf'nodes\["{GROUP}"\]\.inputs\[(\d+)\]\.default_value')
_OUR_PATHS = re.compile(rf'fit_flare\.|(node_tree\.)?nodes\["{GROUP}"\]\["{SOLOS}"\]$')
_LIVE_PATH = re.compile(r"fit_flare\.(master|lights\[\d+\])\.(intensity|tint|mute|solo)$")
_LIGHT_PATH = re.compile(r'fit_flare\.lights\[(?:(\d+)|"(.*)")\]\.intensity')


def connect_node(scene: Any, flare_by_layer: dict[str, int]) -> None:
    """Drive the node's inputs by the panel's sliders. flare_by_layer: the index of the flare for each layer.

    In the expressions, i is an intensity, t a channel of a tint, m a mute, s a solo, and n the number of solo flares.
    The layers must be baked without Intensity, Tint, Mute and Solo. A layer without a flare is shown as baked.
    """
    node = find_node(scene)
    disconnect_node(scene)
    _drive(node, "Intensity", -1, "i*(1-m)", {"i": _slider(scene, "master.intensity"),
                                              "m": _slider(scene, "master.mute")})
    for channel in range(3):
        _drive(node, "Tint", channel, "t", {"t": _slider(scene, f"master.tint[{channel}]")})
    solos = _count_solos(scene, node, sorted(set(flare_by_layer.values())))
    for layer, index in flare_by_layer.items():
        path = f"lights[{index}]"
        for channel in range(3):
            _drive(node, gain_input(layer), channel, "i*t*(1-m)*(s if n else 1)", {
                "i": _slider(scene, f"{path}.intensity"), "t": _slider(scene, f"{path}.tint[{channel}]"),
                "m": _slider(scene, f"{path}.mute"), "s": _slider(scene, f"{path}.solo"), "n": solos})


def connected_flares(scene: Any) -> dict[str, int]:
    """Return the index of the flare whose sliders drive the Gain of each layer."""
    node, index_by_layer = find_node(scene), {}
    names = [item.name for item in scene.fit_flare.lights]
    for curve in node_drivers(scene):
        socket, variable = _driven_input(node, curve), curve.driver.variables.get("i")
        target = variable.targets[0] if variable else None
        match = _LIGHT_PATH.fullmatch(target.data_path) if target and target.id == scene else None
        layer = layer_of_gain(socket.name) if socket is not None else ""
        if match is None or not layer:
            continue
        # Drivers of an earlier version have the name of the flare in place of the index.
        name = bpy.utils.unescape_identifier(match[2] or "")
        if match[1] or name in names:
            index_by_layer[layer] = int(match[1]) if match[1] else names.index(name)
    return index_by_layer


def migrate_to_indices(scene: Any) -> None:
    """Replace drivers of an earlier version, whose paths contain the names of flares, by ones with indices.

    With names in the paths, renaming a flare disconnects its sliders.
    """
    tree = tree_of(scene)
    if tree is None or tree.library is not None or scene.library is not None:
        return
    if any(target.id == scene and 'lights["' in target.data_path for curve in node_drivers(scene)
           for variable in curve.driver.variables for target in variable.targets):
        for item in scene.fit_flare.lights:
            item.identity = item.identity or item.name  # that version identified layers by names
        connect_node(scene, connected_flares(scene))


def is_animated(scene: Any) -> bool:
    """Return whether keys or drivers move those sliders of the panel that drive the node."""
    scene_drivers = scene.animation_data.drivers if scene.animation_data is not None else ()
    return any(_LIVE_PATH.match(curve.data_path) for curves in (*fcurves.fcurves_of(scene), scene_drivers)
               for curve in curves)


def is_complete(scene: Any) -> bool:
    """Return whether all drivers of the node work."""
    curves = node_drivers(scene)
    return all(curve.driver.is_valid for curve in curves) and None not in _current_values(curves).values()


def store_fallbacks(scene: Any) -> None:
    """Store the present values of the sliders in the drivers, for a Blender that renders without this extension."""
    curves = [curve for curve in node_drivers(scene) if curve.id_data.library is None]
    values = _current_values(curves)
    for target in _targets(curves):
        if (value := values[target.id, target.data_path]) is not None:
            target.use_fallback_value, target.fallback_value = True, value


def _targets(curves_of_drivers: Iterable[Any]) -> Iterator[Any]:
    """Yield the targets of our drivers, not those of drivers that an artist added to the same inputs."""
    for curve in curves_of_drivers:
        for variable in curve.driver.variables:
            yield from (target for target in variable.targets
                        if target.id is not None and _OUR_PATHS.match(target.data_path))


def _current_values(curves_of_drivers: Iterable[Any]) -> dict[tuple[Any, str], float | None]:
    """Return the values that our drivers read, by data block and path; None for a missing property."""
    values: dict[tuple[Any, str], float | None] = dict.fromkeys(
        (target.id, target.data_path) for target in _targets(curves_of_drivers))
    for block, path in values:
        with contextlib.suppress(ValueError):  # its flare was removed
            values[block, path] = float(block.path_resolve(path))
    return values


def node_drivers(scene: Any) -> list[Any]:
    """Return the drivers of the node's inputs."""
    tree = tree_of(scene)
    if tree is None or tree.animation_data is None:
        return []
    return [curve for curve in tree.animation_data.drivers if curve.data_path.startswith(f'nodes["{GROUP}"]')]


def disconnect_node(scene: Any) -> None:
    """Remove the drivers of the node's inputs, and reset the inputs to 1.

    Otherwise an input would keep its last driven value, and a muted flare would stay invisible.
    """
    node = find_node(scene)
    for curve in node_drivers(scene):
        socket, channel = _driven_input(node, curve), curve.array_index
        tree_of(scene).animation_data.drivers.remove(curve)
        if socket is not None and isinstance(socket.default_value, float):
            socket.default_value = 1.0
        elif socket is not None:
            socket.default_value[channel] = 1.0
    if node is not None:
        node.pop(SOLOS, None)


def _driven_input(node: Any, curve: Any) -> Any:
    """Return the input that a driver drives; None where it does not exist."""
    match = _INPUT_PATH.fullmatch(curve.data_path)
    return node.inputs[int(match[1])] if node and match and int(match[1]) < len(node.inputs) else None


def _slider(scene: Any, path: str) -> tuple[Any, str]:
    """Return the data block and the path of a slider of the panel."""
    return scene, f"fit_flare.{path}"


def _count_solos(scene: Any, node: Any, flare_indices: Sequence[int]) -> tuple[Any, str]:
    """Drive a property of the node by the number of solo flares; return its data block and path.

    flare_indices: indices of the flares that have layers. The sum is a property of its own, since an expression,
    limited to 255 characters, could not name all flares.
    """
    node[SOLOS] = 0.0
    driver = node.driver_add(f'["{SOLOS}"]').driver
    driver.type = "SUM"
    for index in flare_indices:
        _add_variable(driver, f"s{index}", *_slider(scene, f"lights[{index}].solo"))
    path = f'nodes["{GROUP}"]["{SOLOS}"]'
    return (node.id_data, path) if GROUPS_ARE_TREES else (scene, f"node_tree.{path}")  # the scene owns its tree


def _drive(node: Any, name: str, index: int, expression: str, variables: dict[str, tuple[Any, str]]) -> None:
    """Drive an input of the node by an expression.

    index: channel of a colour, -1 for a number. variables: data block and path of the property that each one reads.
    """
    if name not in node.inputs:  # it was renamed
        return
    driver = node.inputs[name].driver_add("default_value", index).driver
    driver.type = "SCRIPTED"
    for variable, (block, path) in variables.items():
        _add_variable(driver, variable, block, path)
    driver.expression = expression  # a simple expression, which needs no permission to run


def _add_variable(driver: Any, name: str, block: Any, path: str) -> None:
    """Add a variable to a driver that reads `path` of a data block."""
    variable = driver.variables.new()
    variable.name, variable.type = name, "SINGLE_PROP"
    target = variable.targets[0]
    target.id_type, target.id, target.data_path = block.id_type, block, path
