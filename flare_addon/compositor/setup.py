# SPDX-License-Identifier: GPL-3.0-or-later
"""Sets the compositor of a scene up to combine baked layers with the node "Fit Flare" (flare_node.py).

The previous state is stored on the scene, so that `remove_nodes` restores it. It works with the compositors of 4.2
to 5.3 (`trees`): up to 4.5 the tree ends in a Composite node, from 5.0 in a Group Output.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import bpy

from ...core.bake.folder import LayerFolder
from ...core.errors import FrameError
from ...core.images.window import DataWindow
from .. import fcurves
from . import drivers, trees
from .flare_node import (
    GROUP,
    crop_to_frame,
    find_node,
    layer_of_gain,
    new_node,
    node_group,
    set_name,
)
from .footage import (
    OBJECTS,
    PLATE,
    RENDER,
    SIZE,
    footage_behind_camera,
    footage_node,
    is_artists_picture,
    picture_at_size,
    remove_unused_render,
    render_picture,
    shows_render,
)
from .layer_nodes import (
    LAYERS,
    check_views,
    is_view_node,
    remove_view_nodes,
    show_layers,
    switch_views,
    view_images,
)
from .trees import GROUPS_ARE_TREES, tree_of

VIEWER = "Fit Flare Viewer"
CROP = "Fit Flare Crop"
"""Start of the names of the nodes that cut the overscan of the layers off, one for each layer."""
_OUR_NODES = (GROUP, LAYERS, PLATE, SIZE, OBJECTS, VIEWER, RENDER)
_ENDS = (trees.OUTPUT_TYPE, "NodeGroupInput", "CompositorNodeViewer")
"""Nodes of a tree without a picture of its own."""
ARTISTS_COMPOSITOR = ("The compositor has nodes of your own, so renders do not show the footage. Bake layers, choose "
                      "Footage under Over in the panel Bake, and press Set Up Compositor.")
STATE_PROPERTY = "fit_flare_compositor"  # of the scene: the state before the set-up
_IMAGE_NODE_SETTINGS = ("image", "frame_start", "frame_offset", "frame_duration", "use_auto_refresh")


def set_up_nodes(scene: Any, layers: LayerFolder, *, keep_image: bool = False, plate: Any = None,
                 views: Mapping[str, LayerFolder] | None = None) -> Any:
    """Build the nodes that combine `layers`, or make existing ones show them; return the "Fit Flare" node.

    The flare goes over the baked scene by default. keep_image: it goes over the present input of the output (a render
    or a plate). plate: it goes over footage, given as (image, frame_start, frame_offset, frame_duration). views: the
    layers of each view of a stereo render, by the view's name; `layers` are those of the first one. Inputs of an
    existing node keep values, links and animation. Other nodes are not changed. Raises FrameError where the files hold
    no flare layers, where views have different layers, and for a scene that renders a cropped region.
    """
    if scene.render.use_border and scene.render.use_crop_to_border:
        raise FrameError(f"The scene {scene.name!r} renders a cropped region, which layers of whole frames do not fit; "
                         "switch Crop to Render Region off in its output properties.")
    if views:
        check_views(views)
    original = tree_of(scene)
    own_tree = _own_tree(scene)  # the same one, or a copy of it
    if STATE_PROPERTY in scene and (own_tree is None or not any(map(_is_ours, own_tree.nodes))):
        del scene[STATE_PROPERTY]  # our nodes were deleted by hand, so the stored state is of another compositor
    state = _scene_state(scene)
    tree = own_tree or _new_tree(scene, keep_image)
    source = tree.nodes.get(LAYERS)
    node_settings = None if source is None else {name: getattr(source, name) for name in _IMAGE_NODE_SETTINGS}
    if source is None:
        source = set_name(new_node(tree, "CompositorNodeImage", -4, 0), LAYERS)
    show_layers(source, layers)
    # The node keeps linked sockets of layers that it showed before, as unavailable ones.
    sockets = {socket.name: socket for socket in source.outputs if not socket.is_unavailable}
    names = [name for name in sockets if name.startswith("flare_")] or [name for name in sockets if name == "flare"]
    if not names or "scene" not in sockets:
        _undo_set_up(scene, tree, source, node_settings, state)
        if original is not None and tree != original:  # a copy made for this set-up
            trees.replace_tree(scene, original)
            bpy.data.node_groups.remove(tree)
        raise FrameError(f"{layers.files[layers.first]} holds no scene and flare layers; choose a folder of a bake.")
    if STATE_PROPERTY not in scene:
        scene[STATE_PROPERTY] = {**state, **_tree_state(tree)}
    node = tree.nodes.get(GROUP)
    if node is None:
        node = set_name(new_node(tree, "CompositorNodeGroup", -2, 0), GROUP)
    drivers.disconnect_node(scene)
    _change_inputs(tree, node, names)
    _remove_crops(tree)
    outdated = view_images(tree) + ([] if node_settings is None else [node_settings["image"]])
    remove_view_nodes(tree)
    shown_names = names if plate is not None or keep_image else ["scene", *names]
    if views:
        sockets.update(switch_views(scene, tree, views, shown_names))
    if not (window := layers.window()).is_frame:  # the layers have overscan
        sockets.update(_crop_overscan(tree, window, {name: sockets[name] for name in shown_names}))
    for name in names:
        tree.links.new(sockets[name], node.inputs[name])
    if plate is not None:
        scene_picture = footage_node(tree, plate).outputs["Image"]
    else:
        scene_picture = None if keep_image else sockets["scene"]
    _insert_node(scene, tree, node, scene_picture, with_objects=plate is not None and scene.render.film_transparent)
    _add_viewer(tree, node)
    _remove_unused(outdated, {})
    return node


def _insert_node(scene: Any, tree: Any, node: Any, scene_picture: Any, with_objects: bool) -> None:
    """Connect our node between the picture under the flare and the output of the compositor.

    scene_picture: output socket of the picture; None for the artist's, which feeds the output now, or the render. The
    artist's picture is stored in the scene: `remove_nodes` connects the output to it again. with_objects: whether to
    composite the render over `scene_picture`; this is skipped if nodes of the artist process the render.
    """
    end = _final_input(tree)
    final_picture = trees.feeding_socket(end)
    # Whether our node was set up earlier; the artist may have added nodes after it.
    is_set_up = final_picture is not None and trees.depends_on(final_picture.node, node)
    artists_picture = final_picture
    if is_set_up or final_picture is None or _is_ours(final_picture.node):
        artists_picture = _image_under_flare(tree, node, scene[STATE_PROPERTY])
    if artists_picture is not None:
        scene[STATE_PROPERTY].update({"from": artists_picture.node.name, "socket": artists_picture.identifier})
    with_objects = with_objects and not (artists_picture is not None and is_artists_picture(artists_picture.node))
    _connect_scene_picture(tree, node, scene_picture or artists_picture or render_picture(tree), with_objects)
    if not is_set_up or end.links[0].from_node == node:  # else the artist has nodes between ours and the output
        tree.links.new(node.outputs["Image"], end)


def _add_viewer(tree: Any, node: Any) -> None:
    """Show our node in the backdrop, unless the tree has a viewer."""
    if not any(other.bl_idname == "CompositorNodeViewer" for other in tree.nodes):
        viewer = set_name(new_node(tree, "CompositorNodeViewer", 1, -1), VIEWER)
        tree.links.new(node.outputs["Image"], viewer.inputs["Image"])


def _change_inputs(tree: Any, node: Any, layer_names: Sequence[str]) -> None:
    """Give our node the inputs of these layers. Inputs that stay keep values and animation, and sliders their links."""
    old_names = [socket.name for socket in node.inputs]
    sliders = {name: (_input_value(node, name), trees.feeding_socket(node.inputs[name])) for name in old_names
               if name in ("Intensity", "Tint") or layer_of_gain(name)}
    node.node_tree = node_group(layer_names)
    new_indices = {socket.name: index for index, socket in enumerate(node.inputs)}
    # Animated inputs keep their keys, whatever their index is now; keys on inputs that are gone are removed.
    fcurves.renumber(tree, f'nodes["{GROUP}"].inputs',
                     lambda old: new_indices.get(old_names[old]) if old < len(old_names) else old)
    for link in [link for socket in node.inputs for link in socket.links if socket.name != "Scene"]:
        tree.links.remove(link)  # its index may belong to another input now
    for name, (value, feeder) in sliders.items():
        if name in node.inputs:
            node.inputs[name].default_value = value
            if feeder is not None:
                tree.links.new(feeder, node.inputs[name])


def _crop_overscan(tree: Any, window: DataWindow, sockets: dict[str, Any]) -> dict[str, Any]:
    """Add nodes that cut the overscan of layers off; return their output sockets. sockets: of the layers, by name."""
    return {name: set_name(crop_to_frame(tree, socket, window, -3.2, -0.7 * row), f"{CROP} {name}").outputs[0]
            for row, (name, socket) in enumerate(sockets.items())}


def _connect_scene_picture(tree: Any, node: Any, socket: Any, with_objects: bool) -> None:
    """Connect the picture under the flare, an output socket, to our node.

    Pictures of files are scaled to the size of the render, which the render itself has. with_objects: whether to
    composite the render, whose film is transparent, over such a picture.
    """
    for name in (SIZE, OBJECTS):
        if (previous := tree.nodes.get(name)) is not None:
            tree.nodes.remove(previous)
    if socket is not None and (
            socket.node.name in (LAYERS, PLATE) or _is_crop(socket.node) or is_view_node(socket.node)):
        socket = picture_at_size(tree, socket, with_objects)
    tree.links.new(socket, node.inputs["Scene"])
    remove_unused_render(tree)


def _is_crop(node: Any) -> bool:
    """Return whether a node is one of ours that cut overscan off."""
    return bool(node.name.startswith(CROP))


def _is_ours(node: Any) -> bool:
    """Return whether a node was added by `set_up_nodes`."""
    return node.name in _OUR_NODES or _is_crop(node) or is_view_node(node)


def _remove_crops(tree: Any) -> None:
    """Remove our nodes that cut overscan off."""
    for node in [node for node in tree.nodes if _is_crop(node)]:
        tree.nodes.remove(node)


def _own_tree(scene: Any) -> Any:
    """Return the compositor tree of the scene; None where it has none.

    A tree that another scene uses too, or that is linked, is copied first.
    """
    tree = tree_of(scene)
    if GROUPS_ARE_TREES and tree is not None and (tree.library is not None or any(
            other != scene and trees.uses_tree(other, tree) for other in bpy.data.scenes)):
        tree = trees.replace_tree(scene, tree.copy())
    return tree


def show_plate(scene: Any) -> bool:
    """Make renders show the footage behind the scene's camera, until layers are set up over it.

    If the film is transparent, the render lies over the footage. Returns whether the tree was set up. Nodes of the
    artist, and a flare over another picture, stay as they are. Raises FrameError without footage.
    """
    plate = footage_behind_camera(scene)
    tree, state = tree_of(scene), _scene_state(scene)
    # The artist's nodes: a tree that is switched off (None, but stored), or one without our node of footage.
    if state["tree"] if tree is None else PLATE not in tree.nodes:
        return False
    if tree is None:
        tree = _new_tree(scene, keep_image=False)
        scene[STATE_PROPERTY] = {**state, **_tree_state(tree)}
    footage = footage_node(tree, plate)
    with_objects = scene.render.film_transparent
    # The node of the two that ends the picture comes first.
    previous = [tree.nodes[name] for name in (OBJECTS, SIZE) if name in tree.nodes]
    is_up_to_date = bool(previous) and (previous[0].name == OBJECTS) == with_objects
    if find_node(scene) is None and not is_up_to_date:
        fed_inputs = [link.to_socket for link in previous[0].outputs[0].links] if previous else [_final_input(tree)]
        for node in previous:
            tree.nodes.remove(node)
        picture = picture_at_size(tree, footage.outputs["Image"], with_objects)
        for fed_input in fed_inputs:
            tree.links.new(picture, fed_input)
        remove_unused_render(tree)
    return True


def shows_plate_alone(scene: Any) -> bool:
    """Return whether the compositor has the nodes of `show_plate`, without layers."""
    tree = tree_of(scene)
    return tree is not None and find_node(scene) is None and PLATE in tree.nodes and STATE_PROPERTY in scene


def _image_under_flare(tree: Any, node: Any, state: Any) -> Any:
    """Return the output socket of the artist's image under the flare; None where there is none.

    It feeds our node (`node`), or fed the output before the set-up (`state`, as `set_up_nodes` stored it). A node that
    depends on the flare would make a cycle and does not count.
    """
    feeder = tree.nodes.get(state["from"])
    outputs = feeder.outputs if feeder else ()
    stored = next((output for output in outputs if output.identifier == state["socket"]), None)
    for socket in (trees.feeding_socket(node.inputs.get("Scene")), stored):
        if socket is not None and not _is_ours(socket.node) and not trees.depends_on(socket.node, node):
            return socket
    return None


def _undo_set_up(scene: Any, tree: Any, source: Any, node_settings: dict[str, Any] | None,
                 state: dict[str, Any]) -> None:
    """Restore the compositor after the files turned out to hold no flare layers.

    source: the node that shows the layers. node_settings: its previous settings, None where it is new. state: the
    compositor's state before, from `_scene_state`.
    """
    image = source.image
    if node_settings is not None:
        for name, value in node_settings.items():
            setattr(source, name, value)
    else:
        tree.nodes.remove(source)
        if not state["tree"]:  # the scene had no tree before
            trees.discard_tree(scene, tree, bool(state["use_nodes"]))
        elif not GROUPS_ARE_TREES:
            scene.use_nodes = bool(state["use_nodes"])
    _remove_unused([image], state)


# ---- removal -------------------------------------------------------------------------------


def _scene_state(scene: Any) -> dict[str, Any]:
    """Return the compositor state of the scene and the file before the set-up.

    tree: whether there is a tree, also one that is switched off. use_nodes: whether it is on. viewer: whether the file
    has the image of a Viewer node.
    """
    # "tree" is a bool, despite its name; .blend files store it under this key.
    viewer = any(image.type == "COMPOSITING" for image in bpy.data.images)  # Blender makes one for a Viewer node
    return {"tree": trees.has_tree(scene), "use_nodes": GROUPS_ARE_TREES or bool(scene.use_nodes), "viewer": viewer}


def _tree_state(tree: Any) -> dict[str, Any]:
    """Return what `remove_nodes` needs to know of a tree before the set-up.

    nodes: names of the nodes, one a line. drivers: whether it has animation data. inputs: number of its inputs. from,
    socket: node and socket that feed its output; "" for none.
    """
    end = _final_input(tree, add=False)
    feeder = trees.feeding_socket(end)
    return {"nodes": "\n".join(node.name for node in tree.nodes if node.name not in (GROUP, LAYERS)),
            "drivers": tree.animation_data is not None, "inputs": len(trees.input_sockets(tree)),
            "from": feeder.node.name if feeder else "", "socket": feeder.identifier if feeder else ""}


def remove_nodes(scene: Any) -> None:
    """Remove our nodes and restore the state before `set_up_nodes` or `show_plate`.

    Raises FrameError where the compositor has none.
    """
    if shows_plate_alone(scene):
        _remove_plate_alone(scene)
        return
    if find_node(scene) is None:
        raise FrameError(f"The compositor of the scene {scene.name!r} has no nodes of Fit Flare to remove.")
    tree = _own_tree(scene)
    node = tree.nodes[GROUP]
    state = dict(scene[STATE_PROPERTY]) if STATE_PROPERTY in scene else {**_scene_state(scene), **_tree_state(tree),
                                                                         "nodes": None}
    group, images = node.node_tree, [tree.nodes[name].image for name in (LAYERS, PLATE) if tree.nodes.get(name)]
    images += view_images(tree)
    _bypass_node(tree, node, state)
    drivers.disconnect_node(scene)
    if not state.get("drivers", True) and tree.animation_data is not None and not tree.animation_data.drivers:
        tree.animation_data_clear()
    _remove_crops(tree)
    remove_view_nodes(tree)
    for name in _OUR_NODES:
        our_node = tree.nodes.get(name)
        if our_node is not None and not (name == RENDER and any(socket.is_linked for socket in our_node.outputs)):
            tree.nodes.remove(our_node)
    _restore_tree(scene, tree, state)
    if STATE_PROPERTY in scene:
        del scene[STATE_PROPERTY]
    if group is not None and not group.users:
        bpy.data.node_groups.remove(group)
    _remove_unused(images, state)


def _remove_plate_alone(scene: Any) -> None:
    """Remove the compositor that `show_plate` made, and restore the state before."""
    tree = tree_of(scene)
    image = tree.nodes[PLATE].image
    trees.discard_tree(scene, tree, bool(scene[STATE_PROPERTY]["use_nodes"]))
    state = dict(scene[STATE_PROPERTY])
    del scene[STATE_PROPERTY]
    _remove_unused([image], state)


def _bypass_node(tree: Any, node: Any, state: dict[str, Any]) -> None:
    """Connect the picture under the flare to the inputs that our node feeds.

    It is the artist's picture, or the render in a compositor that `set_up_nodes` made. state: as `set_up_nodes` stored
    it.
    """
    picture_below = _image_under_flare(tree, node, state)
    if picture_below is None and not state["tree"]:
        picture_below = render_picture(tree)
    for fed_input in [link.to_socket for link in tree.links if link.from_node == node
                      and (link.from_socket.name == "Image" or link.to_node.bl_idname == trees.OUTPUT_TYPE)]:
        if picture_below is not None:
            tree.links.new(picture_below, fed_input)


def _restore_tree(scene: Any, tree: Any, state: dict[str, Any]) -> None:
    """Restore the compositor tree of the scene, from which our nodes were removed. state: from before the set-up.

    A tree that we made is discarded unless the artist added nodes; an artist's tree loses the output that we added.
    """
    if not state["tree"] and all(node.bl_idname in _ENDS or node.name == RENDER for node in tree.nodes):
        trees.discard_tree(scene, tree, bool(state["use_nodes"]))
    elif state["tree"]:
        if state.get("nodes") is not None:
            earlier_names = state["nodes"].split("\n")
            for extra in [node for node in tree.nodes
                          if node.name not in earlier_names and node.bl_idname == trees.OUTPUT_TYPE]:
                if not any(socket.is_linked for socket in extra.inputs):
                    tree.nodes.remove(extra)
        if not GROUPS_ARE_TREES:
            scene.use_nodes = bool(state["use_nodes"])
    if state["tree"]:
        trees.remove_incoming(tree, state.get("inputs", len(trees.input_sockets(tree))))


def _remove_unused(images: Sequence[Any], state: dict[str, Any]) -> None:
    """Remove images without users, and the viewer's image where there was none before the set-up.

    state: the compositor's before the set-up, from `_scene_state`; {} keeps the viewer's image.
    """
    viewers = [image for image in bpy.data.images if image.type == "COMPOSITING" and not state.get("viewer", True)]
    for image in (*images, *viewers):
        if image is not None and (not image.users or image.type == "COMPOSITING"):  # the viewer's image is its own user
            bpy.data.images.remove(image)


def _input_value(node: Any, name: str) -> Any:
    """Return the value of an input, a number or a tuple."""
    value = node.inputs[name].default_value
    return value if isinstance(value, float) else tuple(value)


def _new_tree(scene: Any, keep_image: bool) -> Any:
    """Return a new compositor tree, empty or, with `keep_image`, with the render as its output.

    A Render Layers node makes Blender render the 3D scene even if it is not used, so none is added without need.
    """
    tree = trees.new_tree(scene)
    if keep_image and not tree.nodes:
        tree.links.new(render_picture(tree), _final_input(tree))
    return tree


def _final_input(tree: Any, add: bool = True) -> Any:
    """Return the input socket of the tree's final picture.

    add: add it where there is none, instead of returning None.
    """
    outputs = sorted((node for node in tree.nodes if node.bl_idname == trees.OUTPUT_TYPE),
                     key=lambda node: not trees.is_active_output(tree, node))
    if not add:
        return outputs[0].inputs[0] if outputs and len(outputs[0].inputs) else None
    if GROUPS_ARE_TREES and not any(getattr(item, "in_out", "") == "OUTPUT" for item in tree.interface.items_tree):
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    node = outputs[0] if outputs else new_node(tree, trees.OUTPUT_TYPE, 1, 0)
    return node.inputs[0]


def is_over_render(scene: Any) -> bool:
    """Return whether the flare lies over the render, without footage under it."""
    node = find_node(scene)
    return node is not None and OBJECTS not in tree_of(scene).nodes and shows_render(tree_of(scene), node)
