# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group "Fit Flare", and its node in the compositor of a scene, whose inputs are the sliders.

    Flare = Intensity * Tint * (sum of the flare layers, each times its Gain),   Image = Scene + Flare

in scene-linear light, so the picture is the bake's composite at Intensity 1 with white Tint and Gains. `setup` adds the
node. It works with the compositors of 4.2 to 5.3, see `trees`; from 5.0 on the mix and math nodes are of other types.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import bpy

from ...core.images.window import DataWindow
from .trees import GROUPS_ARE_TREES, NODE, tree_of

GROUP = NODE
MISSING_IS_MAGENTA = bpy.app.version < (4, 4, 0)
"""Whether the compositor shows missing pictures in magenta instead of black."""
_GAIN = " Gain"
_MIX, _MATH = (("ShaderNodeMix", "ShaderNodeMath") if GROUPS_ARE_TREES
               else ("CompositorNodeMixRGB", "CompositorNodeMath"))


def find_node(scene: Any) -> Any:
    """Return the "Fit Flare" node of the scene; None where it is not set up."""
    tree = tree_of(scene)
    return tree.nodes.get(GROUP) if tree else None


def node_group(layers: Sequence[str]) -> Any:
    """Return a node group with a colour input for each flare layer; one with these inputs is reused.

    layers: names of the inputs, such as "flare_lamp".
    """
    input_names = ["Scene", *layers, "Intensity", "Tint", *(gain_input(layer) for layer in layers)]
    for group in bpy.data.node_groups:
        # Blender numbers groups of the same name: "Fit Flare.001".
        if group.bl_idname == "CompositorNodeTree" and group.name.split(".")[0] == GROUP:
            inputs = [item.name for item in group.interface.items_tree if getattr(item, "in_out", "") == "INPUT"]
            if inputs == input_names:
                return group
    group = bpy.data.node_groups.new(GROUP, "CompositorNodeTree")
    _add_sockets(group, input_names)
    _add_nodes(group, layers)
    return group


def gain_input(layer: str) -> str:
    """Return the name of the input for a layer's factors on linear R, G, B."""
    return f"{layer}{_GAIN}"


def layer_of_gain(name: str) -> str:
    """Return the layer that a Gain input belongs to; "" for any other input."""
    return name.removesuffix(_GAIN) if name.endswith(_GAIN) else ""


def _add_sockets(group: Any, inputs: Iterable[str]) -> None:
    """Add the outputs and these inputs to the interface of the group."""
    for name in ("Image", "Flare"):
        group.interface.new_socket(name, in_out="OUTPUT", socket_type="NodeSocketColor")
    for name in inputs:
        kind = "NodeSocketFloat" if name == "Intensity" else "NodeSocketColor"
        socket = group.interface.new_socket(name, in_out="INPUT", socket_type=kind)
        if name == "Intensity":
            socket.default_value, socket.min_value, socket.max_value = 1.0, 0.0, 1000.0
        else:
            grey = 1.0 if name == "Tint" or layer_of_gain(name) else 0.0
            socket.default_value = (grey, grey, grey, 1.0)


def _add_nodes(group: Any, layers: Sequence[str]) -> None:
    """Add the nodes that compute Flare and Image: one row for each layer, the sums in row -1 to the right of them."""
    group_input = new_node(group, "NodeGroupInput", 0, 0)
    scaled_layers = [scale_to_render_size(group, group_input.outputs[name], 1, -row)
                     for row, name in enumerate(layers, 1)]
    gained_layers = [_mix(group, "MULTIPLY", scaled_layer.outputs[0], group_input.outputs[gain_input(name)], 2, -row)
                     for row, (name, scaled_layer) in enumerate(zip(layers, scaled_layers, strict=True), 1)]
    sum_of_layers = gained_layers[0]
    for column, layer in enumerate(gained_layers[1:], 3):
        sum_of_layers = _mix(group, "ADD", sum_of_layers, layer, column, -1)
    column = len(layers) + 2
    tinted = _mix(group, "MULTIPLY", sum_of_layers, group_input.outputs["Tint"], column, -1)
    flare = _mix(group, "MULTIPLY", tinted, group_input.outputs["Intensity"], column + 1, -1)
    image = _mix(group, "ADD", group_input.outputs["Scene"], flare, column + 2, 0)
    output = new_node(group, "NodeGroupOutput", column + 6, 0)
    group.links.new(image, output.inputs["Image"])
    group.links.new(_add_matte(group, flare, column + 2), output.inputs["Flare"])


def _add_matte(group: Any, colour: Any, column: int) -> Any:
    """Add nodes that give a colour alpha = max(R, G, B), clamped to 0..1, as in the baked layers (core/bake/layers.py).

    colour: output socket. Returns the output socket of the result.
    """
    separate = new_node(group, "CompositorNodeSeparateColor", column, -2)
    group.links.new(colour, separate.inputs[0])
    red, green, blue = separate.outputs[:3]
    alpha = _math(group, "MAXIMUM", _math(group, "MAXIMUM", red, green, column + 1), blue, column + 2, clamp=True)
    combine = new_node(group, "CompositorNodeCombineColor", column + 3, -2)
    for source, target in zip((red, green, blue, alpha), combine.inputs, strict=True):
        group.links.new(source, target)
    return combine.outputs[0]


def new_node(tree: Any, kind: str, column: float, row: float) -> Any:
    """Add a node of that type at a position on a grid; return it. Rows count upwards, as Blender's y does."""
    node = tree.nodes.new(kind)
    node.location = (220 * column, 220 * row)
    return node


def set_name(node: Any, name: str) -> Any:
    """Set name and label of a node; return it."""
    node.name = node.label = name
    return node


def scale_to_render_size(tree: Any, socket: Any, column: float, row: float) -> Any:
    """Add a node that scales a picture to the size of the render, which Blender does not do by itself; return it."""
    node = new_node(tree, "CompositorNodeScale", column, row)
    if hasattr(node, "space"):
        node.space, node.frame_method = "RENDER_SIZE", "STRETCH"
    else:
        for name, value in (("Type", "Render Size"), ("Frame Type", "Stretch"), ("Extension X", "Extend"),
                            ("Extension Y", "Extend")):
            if name in node.inputs:
                node.inputs[name].default_value = value
    tree.links.new(socket, node.inputs["Image"])
    return node


def alpha_over(tree: Any, background: Any, foreground: Any, column: float, row: float) -> Any:
    """Add a node that composites a picture of premultiplied alpha over another; return it.

    background, foreground: output sockets.
    """
    node = new_node(tree, "CompositorNodeAlphaOver", column, row)
    below, above = [socket for socket in node.inputs if socket.type == "RGBA"]
    tree.links.new(background, below)
    tree.links.new(foreground, above)
    return node


def crop_to_frame(tree: Any, socket: Any, window: DataWindow, column: float, row: float) -> Any:
    """Add a node that cuts the overscan of a picture off, since Blender ignores data windows; return it.

    socket: output socket of the picture. window: its data window.
    """
    node = new_node(tree, "CompositorNodeCrop", column, row)
    (left, top), (width, height), (_, stored_height) = window.origin, window.frame, window.size
    bottom = stored_height + top - height  # rows of overscan below the frame; Blender counts from there
    if "Width" in node.inputs:
        for name, value in (("X", -left), ("Y", bottom), ("Width", width), ("Height", height), ("Alpha Crop", False)):
            node.inputs[name].default_value = value
    else:  # until 4.4
        node.use_crop_size = True
        # Blender calls min_y Up and max_y Down.
        node.min_x, node.max_x, node.min_y, node.max_y = -left, width - left, bottom + height, bottom
    tree.links.new(socket, node.inputs["Image"])
    return node


def _mix(tree: Any, blend: str, a: Any, b: Any, column: float, row: float) -> Any:
    """Add a mix node of a and b with full factor, unclamped; return its output socket."""
    node = new_node(tree, _MIX, column, row)
    if _MIX == "ShaderNodeMix":
        node.data_type, node.clamp_factor = "RGBA", False
        sockets = {socket.identifier: socket for socket in node.inputs}
        factor, first, second = (sockets[name] for name in ("Factor_Float", "A_Color", "B_Color"))
        result = next(socket for socket in node.outputs if socket.identifier == "Result_Color")
    else:
        factor, first, second = node.inputs
        result = node.outputs[0]
    node.blend_type = blend
    factor.default_value = 1.0
    tree.links.new(a, first)
    tree.links.new(b, second)
    return result


def _math(tree: Any, operation: str, a: Any, b: Any, column: float, *, clamp: bool = False) -> Any:
    """Add a math node of a and b; return its output socket."""
    node = new_node(tree, _MATH, column, -3)
    node.operation, node.use_clamp = operation, clamp
    tree.links.new(a, node.inputs[0])
    tree.links.new(b, node.inputs[1])
    return node.outputs[0]
