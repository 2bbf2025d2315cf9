# SPDX-License-Identifier: GPL-3.0-or-later
"""The wires from the panel's sliders to those of the node "Fit Flare": drivers, which go by the numbers of the flares.

They act on what the layers were baked without: intensity, tint, mute and solo of all lights and of each.
"""
from __future__ import annotations

import re
from typing import Any

import bpy

from . import curves
from .flare_node import GROUP, find_node, gain_of, layer_of, tree_of

_OF_AN_INPUT = re.compile(rf'nodes\["{GROUP}"\]\.inputs\[(\d+)\]\.default_value')
_LIVE = re.compile(r"fit_flare\.(master|lights\[\d+\])\.(intensity|tint|mute|solo)$")
_OF_A_LIGHT = re.compile(r'fit_flare\.lights\[(?:(\d+)|"(.*)")\]\.intensity')


def wire(scene: Any, gains: dict[str, int]) -> None:
    """Drive the node's sliders from the panel's: gains by layer, the number of the flare whose sliders they are.

    Intensity, Tint, Mute and Solo of all lights and of each are live then; the layers must hold none of them. A layer
    without a flare shows as it was baked.
    """
    node = find_node(scene)
    cut(scene)
    _drive(scene, node, "Intensity", -1, "i*(1-m)", {"i": "master.intensity", "m": "master.mute"})
    for channel in range(3):
        _drive(scene, node, "Tint", channel, "t", {"t": f"master.tint[{channel}]"})
    solos = {f"s{number}": f"lights[{number}].solo" for number in sorted(set(gains.values()))}
    for layer, number in gains.items():
        path, own = f"lights[{number}]", f"s{number}"
        most = f"max({','.join(solos)})" if len(solos) > 1 else own
        for channel in range(3):
            _drive(scene, node, gain_of(layer), channel, f"i*t*(1-m)*({own} if {most} else 1)",
                   {"i": f"{path}.intensity", "t": f"{path}.tint[{channel}]", "m": f"{path}.mute", **solos})


def wired(scene: Any) -> dict[str, int]:
    """By layer, the number of the flare whose sliders drive its Gain."""
    node, found = find_node(scene), {}
    names = [item.name for item in scene.fit_flare.lights]
    for curve in drivers(scene):
        socket, variable = _driven(node, curve), curve.driver.variables.get("i")
        target = variable.targets[0] if variable else None
        match = _OF_A_LIGHT.fullmatch(target.data_path) if target and target.id == scene else None
        layer = layer_of(socket.name) if socket is not None else ""
        if match is None or not layer:
            continue
        name = bpy.utils.unescape_identifier(match[2] or "")
        if match[1] or name in names:
            found[layer] = int(match[1]) if match[1] else names.index(name)
    return found


def go_by_numbers(scene: Any) -> None:
    """Have drivers of an earlier version, which went by the names of the flares, go by their numbers: a flare that was
    renamed lost its own."""
    tree = tree_of(scene)
    if tree is None or tree.library is not None or scene.library is not None:
        return
    if any(target.id == scene and 'lights["' in target.data_path for curve in drivers(scene)
           for variable in curve.driver.variables for target in variable.targets):
        for item in scene.fit_flare.lights:
            item.identity = item.identity or item.name  # as the layers of that version have it
        wire(scene, wired(scene))


def is_animated(scene: Any) -> bool:
    """Whether keys or drivers move sliders of the panel that drive the node's."""
    own = scene.animation_data.drivers if scene.animation_data is not None else ()
    return any(_LIVE.match(curve.data_path) for some in (*curves.of(scene), own) for curve in some)


def drivers(scene: Any) -> list[Any]:
    """The drivers of the node's sliders."""
    tree = tree_of(scene)
    if tree is None or tree.animation_data is None:
        return []
    return [curve for curve in tree.animation_data.drivers if curve.data_path.startswith(f'nodes["{GROUP}"]')]


def cut(scene: Any) -> None:
    """Take the drivers of the node's sliders out, and put back what they drove: a slider would keep what it was last
    driven to, a flare that was muted or has lost its driver be gone for good."""
    node = find_node(scene)
    for curve in drivers(scene):
        socket, channel = _driven(node, curve), curve.array_index
        tree_of(scene).animation_data.drivers.remove(curve)
        if socket is not None and isinstance(socket.default_value, float):
            socket.default_value = 1.0
        elif socket is not None:
            socket.default_value[channel] = 1.0


def _driven(node: Any, curve: Any) -> Any:
    """The input that a driver drives, None where there is no such."""
    match = _OF_AN_INPUT.fullmatch(curve.data_path)
    return node.inputs[int(match[1])] if node and match and int(match[1]) < len(node.inputs) else None


def _drive(scene: Any, node: Any, name: str, index: int, expression: str, variables: dict[str, str]) -> None:
    if name not in node.inputs:  # someone has renamed it
        return
    curve = node.inputs[name].driver_add("default_value", index)
    driver = curve.driver
    driver.type = "SCRIPTED"
    for short, path in variables.items():
        variable = driver.variables.new()
        variable.name, variable.type = short, "SINGLE_PROP"
        target = variable.targets[0]
        target.id_type, target.id, target.data_path = "SCENE", scene, f"fit_flare.{path}"
    driver.expression = expression  # of the plain kind that needs no permission to run
