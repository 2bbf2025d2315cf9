# SPDX-License-Identifier: GPL-3.0-or-later
"""The wires from the panel's sliders to those of the node "Fit Flare": drivers, which go by the numbers of the flares.

They act on what the layers were baked without: intensity, tint, mute and solo of all lights and of each.
"""
from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import bpy

from .. import fcurves
from .flare_node import GROUP, GROUPS_ARE_TREES, find_node, gain_of, layer_of, tree_of

SOLOS = "solos"  # a property of the node: how many flares are solo
_OF_AN_INPUT = re.compile(rf'nodes\["{GROUP}"\]\.inputs\[(\d+)\]\.default_value')
_OURS = re.compile(rf'fit_flare\.|(node_tree\.)?nodes\["{GROUP}"\]\["{SOLOS}"\]$')
_LIVE = re.compile(r"fit_flare\.(master|lights\[\d+\])\.(intensity|tint|mute|solo)$")
_OF_A_LIGHT = re.compile(r'fit_flare\.lights\[(?:(\d+)|"(.*)")\]\.intensity')


def wire(scene: Any, gains: dict[str, int]) -> None:
    """Drive the node's sliders from the panel's: gains by layer, the number of the flare whose sliders they are.

    Intensity, Tint, Mute and Solo of all lights and of each are live then; the layers must hold none of them. A layer
    without a flare shows as it was baked.
    """
    node = find_node(scene)
    cut(scene)
    _drive(node, "Intensity", -1, "i*(1-m)", {"i": _slider(scene, "master.intensity"),
                                              "m": _slider(scene, "master.mute")})
    for channel in range(3):
        _drive(node, "Tint", channel, "t", {"t": _slider(scene, f"master.tint[{channel}]")})
    solos = _count_solos(scene, node, sorted(set(gains.values())))
    for layer, number in gains.items():
        path = f"lights[{number}]"
        for channel in range(3):
            _drive(node, gain_of(layer), channel, "i*t*(1-m)*(s if n else 1)", {
                "i": _slider(scene, f"{path}.intensity"), "t": _slider(scene, f"{path}.tint[{channel}]"),
                "m": _slider(scene, f"{path}.mute"), "s": _slider(scene, f"{path}.solo"), "n": solos})


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
    return any(_LIVE.match(curve.data_path) for some in (*fcurves.of(scene), own) for curve in some)


def complete(scene: Any) -> bool:
    """Whether all that should drive the node's sliders does."""
    own = drivers(scene)
    return all(curve.driver.is_valid for curve in own) and None not in _standing(own).values()


def keep_standing(scene: Any) -> None:
    """Have the drivers know where the panel's sliders stand now, for a Blender that renders the file without this
    extension, where those are not."""
    own = [curve for curve in drivers(scene) if curve.id_data.library is None]
    standing = _standing(own)
    for target in _targets(own):
        if (value := standing[target.id, target.data_path]) is not None:
            target.use_fallback_value, target.fallback_value = True, value


def _targets(curves_of_drivers: Iterable[Any]) -> Iterator[Any]:
    """What our drivers read; an artist's own, on the same sliders, read something else."""
    for curve in curves_of_drivers:
        for variable in curve.driver.variables:
            yield from (target for target in variable.targets
                        if target.id is not None and _OURS.match(target.data_path))


def _standing(curves_of_drivers: Iterable[Any]) -> dict[tuple[Any, str], float | None]:
    """Where the sliders stand that our drivers read, by data block and path; None where there is no such."""
    found: dict[tuple[Any, str], float | None] = dict.fromkeys(
        (target.id, target.data_path) for target in _targets(curves_of_drivers))
    for block, path in found:
        with contextlib.suppress(ValueError):  # its flare is gone
            found[block, path] = float(block.path_resolve(path))
    return found


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
    if node is not None:
        node.pop(SOLOS, None)


def _driven(node: Any, curve: Any) -> Any:
    """The input that a driver drives, None where there is no such."""
    match = _OF_AN_INPUT.fullmatch(curve.data_path)
    return node.inputs[int(match[1])] if node and match and int(match[1]) < len(node.inputs) else None


def _slider(scene: Any, path: str) -> tuple[Any, str]:
    """The data block and the path of a slider of the panel."""
    return scene, f"fit_flare.{path}"


def _count_solos(scene: Any, node: Any, numbers: Sequence[int]) -> tuple[Any, str]:
    """Have the node count which of those flares are solo; the data block and the path of the count. Said in each Gain's
    own expression they would be cut off at 255 characters."""
    node[SOLOS] = 0.0
    driver = node.driver_add(f'["{SOLOS}"]').driver
    driver.type = "SUM"
    for number in numbers:
        _add_variable(driver, f"s{number}", *_slider(scene, f"lights[{number}].solo"))
    path = f'nodes["{GROUP}"]["{SOLOS}"]'
    return (node.id_data, path) if GROUPS_ARE_TREES else (scene, f"node_tree.{path}")  # whose tree is a part of it


def _drive(node: Any, name: str, index: int, expression: str, variables: dict[str, tuple[Any, str]]) -> None:
    if name not in node.inputs:  # someone has renamed it
        return
    driver = node.inputs[name].driver_add("default_value", index).driver
    driver.type = "SCRIPTED"
    for short, (block, path) in variables.items():
        _add_variable(driver, short, block, path)
    driver.expression = expression  # of the plain kind that needs no permission to run


def _add_variable(driver: Any, name: str, block: Any, path: str) -> None:
    """Give a driver a variable: what is at `path` of a data block."""
    variable = driver.variables.new()
    variable.name, variable.type = name, "SINGLE_PROP"
    target = variable.targets[0]
    target.id_type, target.id, target.data_path = block.id_type, block, path
