# SPDX-License-Identifier: GPL-3.0-or-later
"""Baked layers put together in a scene's compositor, by the node "Fit Flare" (flare_node.py).

What was there before is noted on the scene, so that it can all be taken away again. Written for the compositors of 4.2
to 5.2: up to 4.5 the tree ends in a Composite node, from 5.0 in a Group Output.
"""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy

from ...core.bake.folder import LayerFolder
from ...core.colour.ocio import CONFIGURED_NAMES
from ...core.errors import FrameError
from ...core.images.exr import exr_space
from .. import fcurves
from ..images import loaded
from ..paths import absolute
from . import drivers
from .flare_node import GROUP, GROUPS_ARE_TREES, find_node, layer_of, new_node, node_group, of_render_size, tree_of

LAYERS = "Fit Flare Layers"
PLATE = "Fit Flare Footage"
VIEWER = "Fit Flare Viewer"
RENDER = "Fit Flare Render"
SIZE = "Fit Flare Size"
_OURS = (GROUP, LAYERS, PLATE, SIZE, VIEWER, RENDER)
NOTE = "fit_flare_compositor"  # a property of the scene: what was there before
_TO_THE_END = 1048574  # frames, the most that Blender has; those without a file are without flare
_POINTING = ("image", "frame_start", "frame_offset", "frame_duration", "use_auto_refresh")
_END = "NodeGroupOutput" if GROUPS_ARE_TREES else "CompositorNodeComposite"


def set_up(scene: Any, layers: LayerFolder, *, keep_image: bool = False, plate: Any = None) -> Any:
    """Build the graph that puts `layers` together, or point the one that is there at them.

    keep_image: the scene is what fed the output until now (a render, a plate), and the flare goes over
    it; otherwise it is the baked scene. plate: (image, frame_start, frame_offset, frame_duration) of footage
    that is the scene instead. Other nodes stay as they are. Returns the "Fit Flare" node.
    Raises FrameError where the files hold no flare layers, and for a scene that renders a cropped region.
    """
    if scene.render.use_border and scene.render.use_crop_to_border:
        raise FrameError(f"The scene {scene.name!r} renders a region cut out of the frame, where layers of whole "
                         "frames do not fit; switch Crop to Render Region off in its output properties.")
    had = tree_of(scene)
    there = _own_tree(scene)
    if NOTE in scene and (there is None or not any(name in there.nodes for name in _OURS)):
        del scene[NOTE]  # our nodes were deleted by hand: what was noted is of another compositor
    note = _note(scene)
    tree = there or _new_tree(scene, keep_image)
    source = tree.nodes.get(LAYERS)
    pointed = None if source is None else {name: getattr(source, name) for name in _POINTING}
    if source is None:
        source = _named(new_node(tree, "CompositorNodeImage", -4, 0), LAYERS)
    _point_at(source, layers)
    # The node keeps those that are linked of the files that it showed before.
    sockets = {socket.name: socket for socket in source.outputs if not socket.is_unavailable}
    names = [name for name in sockets if name.startswith("flare_")] or [name for name in sockets if name == "flare"]
    if not names or "scene" not in sockets:
        _take_back(scene, tree, source, pointed, note)
        if had is not None and tree != had:  # it was copied for this
            scene.compositing_node_group = had
            bpy.data.node_groups.remove(tree)
        raise FrameError(f"{layers.files[layers.first]} holds no scene and flare layers; choose a folder of a bake.")
    if NOTE not in scene:
        scene[NOTE] = {**note, **_before(tree)}
    node = tree.nodes.get(GROUP)
    if node is None:
        node = _named(new_node(tree, "CompositorNodeGroup", -2, 0), GROUP)
    drivers.cut(scene)
    numbered = [socket.name for socket in node.inputs]
    sliders = {name: (_value(node, name), _source(node.inputs[name])) for name in numbered
               if name in ("Intensity", "Tint") or layer_of(name)}
    node.node_tree = node_group(names)
    numbers = {socket.name: number for number, socket in enumerate(node.inputs)}
    fcurves.renumber(tree, f'nodes["{GROUP}"].inputs',
                    lambda number: numbers.get(numbered[number]) if number < len(numbered) else number)
    for link in [link for socket in node.inputs for link in socket.links if socket.name != "Scene"]:
        tree.links.remove(link)  # by its number it may lead to another slider now
    for name, (value, fed) in sliders.items():
        if name in node.inputs:
            node.inputs[name].default_value = value
            if fed is not None:
                tree.links.new(fed, node.inputs[name])
    for name in names:
        tree.links.new(sockets[name], node.inputs[name])
    end = _output(tree)
    before = _source(end)
    inside = before is not None and _is_behind(before.node, node)  # set up earlier, perhaps with other nodes behind it
    if inside or before is None or before.node.name in _OURS:
        before = _under(tree, node, scene[NOTE])
    if before is not None:
        scene[NOTE].update({"from": before.node.name, "socket": before.identifier})
    scene_socket = sockets["scene"]
    if plate is not None:
        scene_socket = _footage(tree, plate).outputs["Image"]
    elif keep_image:
        scene_socket = before or _render(tree).outputs["Image"]
    if (size := tree.nodes.get(SIZE)) is not None:
        tree.nodes.remove(size)
    if scene_socket is not None and scene_socket.node.name in (LAYERS, PLATE):
        scene_socket = _named(of_render_size(tree, scene_socket, -3, 1), SIZE).outputs[0]
    tree.links.new(scene_socket, node.inputs["Scene"])
    if not inside or end.links[0].from_node == node:
        tree.links.new(node.outputs["Image"], end)
    if not any(other.bl_idname == "CompositorNodeViewer" for other in tree.nodes):
        viewer = _named(new_node(tree, "CompositorNodeViewer", 1, -1), VIEWER)  # what the backdrop shows
        tree.links.new(node.outputs["Image"], viewer.inputs["Image"])
    return node


def _own_tree(scene: Any) -> Any:
    """The scene's compositor tree, None where it has none. One that another scene has as well is copied first: what is
    done to it would be done to the other scene's. So is one that is linked, to which nothing can be done."""
    tree = tree_of(scene)
    if GROUPS_ARE_TREES and tree is not None and (tree.library is not None or any(
            other != scene and tree_of(other) == tree for other in bpy.data.scenes)):
        tree = scene.compositing_node_group = tree.copy()
    return tree


def footage_nodes(scene: Any) -> list[Any]:
    """The node that lays footage under the flare, if there is one."""
    tree = tree_of(scene)
    node = tree.nodes.get(PLATE) if tree is not None else None
    return [node] if getattr(node, "image", None) is not None else []


def plate_of(scene: Any) -> tuple[Any, int, int, int]:
    """The footage behind the scene's camera, as `set_up` takes it. Raises FrameError where there is none."""
    camera = scene.camera
    for back in camera.data.background_images if camera is not None and camera.type == "CAMERA" else ():
        if back.source == "IMAGE" and back.image is not None:
            user = back.image_user
            return back.image, user.frame_start, user.frame_offset, user.frame_duration
    raise FrameError("The camera has no footage behind it; lay the flare over the present image instead.")


def _source(socket: Any) -> Any:
    """The output socket that feeds an input, None where nothing does."""
    return socket.links[0].from_socket if socket is not None and socket.is_linked else None


def _is_behind(one: Any, node: Any) -> bool:
    """Whether a node is `node`, or shows something of it."""
    seen: set[str] = set()
    left = [one]
    while left:
        here = left.pop()
        if here == node:
            return True
        if here.name not in seen:
            seen.add(here.name)
            left += [link.from_node for socket in here.inputs for link in socket.links]
    return False


def _under(tree: Any, node: Any, note: Any) -> Any:
    """The output socket of what someone has under the flare: what feeds our node, or fed the output before it. None
    where that is nothing, or is behind the flare, from where it would make a cycle."""
    had = tree.nodes.get(note["from"])
    noted = next((one for one in had.outputs if one.identifier == note["socket"]), None) if had else None
    for socket in (_source(node.inputs.get("Scene")), noted):
        if socket is not None and socket.node.name not in _OURS and not _is_behind(socket.node, node):
            return socket
    return None


def _take_back(scene: Any, tree: Any, source: Any, pointed: dict[str, Any] | None, note: dict[str, Any]) -> None:
    """Leave no trace of layers that turned out to be none: `pointed` is where their node pointed before, if it was
    there, `note` what the scene had."""
    image = source.image
    if pointed is not None:
        for name, value in pointed.items():
            setattr(source, name, value)
    else:
        tree.nodes.remove(source)
        if not note["tree"]:
            _discard_tree(scene, tree, bool(note["use_nodes"]))
        elif not GROUPS_ARE_TREES:
            scene.use_nodes = bool(note["use_nodes"])
    _drop([image], note)


def _render(tree: Any) -> Any:
    """A Render Layers node, the first there is."""
    found = next((node for node in tree.nodes if node.bl_idname == "CompositorNodeRLayers"), None)
    return found or _named(new_node(tree, "CompositorNodeRLayers", -4, 1), RENDER)


def _footage(tree: Any, plate: tuple[Any, int, int, int]) -> Any:
    node = tree.nodes.get(PLATE) or _named(new_node(tree, "CompositorNodeImage", -4, 2.5), PLATE)
    image, start, offset, duration = plate
    node.image = image
    if image.source == "SEQUENCE":
        node.frame_start, node.frame_offset, node.frame_duration = start, offset, duration
        node.use_auto_refresh = True
    return node


# ---- and away again -------------------------------------------------------------------------------


def _note(scene: Any) -> dict[str, Any]:
    """What the scene and the file had before any of this."""
    viewer = any(image.type == "COMPOSITING" for image in bpy.data.images)  # Blender makes it for a Viewer node
    if GROUPS_ARE_TREES:
        return {"tree": scene.compositing_node_group is not None, "use_nodes": True, "viewer": viewer}
    return {"tree": scene.node_tree is not None, "use_nodes": bool(scene.use_nodes), "viewer": viewer}


def _before(tree: Any) -> dict[str, Any]:
    """The names of a tree's nodes, and what fed its output."""
    end = _output(tree, make=False)
    fed = _source(end)
    return {"nodes": "\n".join(node.name for node in tree.nodes if node.name not in (GROUP, LAYERS)),
            "drivers": tree.animation_data is not None,
            "from": fed.node.name if fed else "", "socket": fed.identifier if fed else ""}


def remove(scene: Any) -> None:
    """Take the graph away: what was there before `set_up` is there again, and nothing else.

    Raises FrameError where it is not set up.
    """
    if find_node(scene) is None:
        raise FrameError(f"The scene {scene.name!r} has no compositor of Fit Flare to remove.")
    tree = _own_tree(scene)
    node = tree.nodes[GROUP]
    note = dict(scene[NOTE]) if NOTE in scene else {**_note(scene), **_before(tree), "nodes": None}
    group, images = node.node_tree, [tree.nodes[name].image for name in (LAYERS, PLATE) if tree.nodes.get(name)]
    below = _under(tree, node, note)
    if below is None and not note["tree"]:
        below = _render(tree).outputs["Image"]
    for fed in [link.to_socket for link in tree.links if link.from_node == node
                and (link.from_socket.name == "Image" or link.to_node.bl_idname == _END)]:
        if below is not None:
            tree.links.new(below, fed)
    drivers.cut(scene)
    if not note.get("drivers", True) and tree.animation_data is not None and not tree.animation_data.drivers:
        tree.animation_data_clear()
    for name in _OURS:
        ours = tree.nodes.get(name)
        if ours is not None and not (name == RENDER and any(one.is_linked for one in ours.outputs)):
            tree.nodes.remove(ours)
    if not note["tree"] and all(one.bl_idname in (_END, "CompositorNodeViewer") or one.name == RENDER
                                for one in tree.nodes):
        _discard_tree(scene, tree, bool(note["use_nodes"]))
    elif note["tree"]:
        if note.get("nodes") is not None:
            known = note["nodes"].split("\n")
            for extra in [one for one in tree.nodes if one.name not in known and one.bl_idname == _END]:
                if not any(socket.is_linked for socket in extra.inputs):
                    tree.nodes.remove(extra)
        if not GROUPS_ARE_TREES:
            scene.use_nodes = bool(note["use_nodes"])
    if NOTE in scene:
        del scene[NOTE]
    if group is not None and not group.users:
        bpy.data.node_groups.remove(group)
    _drop(images, note)


def _drop(images: Sequence[Any], note: dict[str, Any]) -> None:
    """Remove images that nothing uses any more, and the viewer's where there was none before."""
    viewers = [image for image in bpy.data.images if image.type == "COMPOSITING" and not note.get("viewer", True)]
    for image in (*images, *viewers):
        if image is not None and (not image.users or image.type == "COMPOSITING"):  # that one counts itself
            bpy.data.images.remove(image)


def _discard_tree(scene: Any, tree: Any, use_nodes: bool) -> None:
    if GROUPS_ARE_TREES:
        scene.compositing_node_group = None
        if not tree.users:
            bpy.data.node_groups.remove(tree)
    else:
        tree.nodes.clear()
        scene.use_nodes = use_nodes


def _value(node: Any, name: str) -> Any:
    value = node.inputs[name].default_value
    return value if isinstance(value, float) else tuple(value)


def _named(node: Any, name: str) -> Any:
    node.name = node.label = name
    return node


def _new_tree(scene: Any, keep_image: bool) -> Any:
    """A compositor for a scene without one: with the render feeding the output, or empty.

    A Render Layers node makes Blender render the 3D scene, used or not, so there is none without need.
    """
    fresh = GROUPS_ARE_TREES or scene.node_tree is None
    if GROUPS_ARE_TREES:
        tree = scene.compositing_node_group = bpy.data.node_groups.new("Compositor", "CompositorNodeTree")
    else:
        scene.use_nodes = True
        tree = scene.node_tree
    if fresh:
        tree.nodes.clear()
        if keep_image:
            render = _named(new_node(tree, "CompositorNodeRLayers", -4, 1), RENDER)
            tree.links.new(render.outputs["Image"], _output(tree))
    return tree


def _output(tree: Any, make: bool = True) -> Any:
    """The input socket that the final picture goes into; where there is none it is made, or None."""
    found = sorted((node for node in tree.nodes if node.bl_idname == _END), key=lambda node: not _counts(tree, node))
    if not make:
        return found[0].inputs[0] if found and len(found[0].inputs) else None
    if GROUPS_ARE_TREES and not any(getattr(item, "in_out", "") == "OUTPUT" for item in tree.interface.items_tree):
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    node = found[0] if found else new_node(tree, _END, 1, 0)
    return node.inputs[0]


def _counts(tree: Any, end: Any) -> bool:
    """Whether an output is the one of several that Blender goes by. 4.x does not say so, but makes it the one that is
    clicked on; once another node is, it is the one that shows our node, which was put there while it was known."""
    if hasattr(end, "is_active_output"):
        return bool(end.is_active_output)
    if tree.nodes.active is not None and tree.nodes.active.bl_idname == _END:
        return bool(end == tree.nodes.active)
    return GROUP in tree.nodes and _is_behind(end, tree.nodes[GROUP])


def _point_at(node: Any, layers: LayerFolder) -> None:
    """Make an Image node show the file of each frame's number, gaps and a frame 0 included."""
    image = loaded(layers.files[layers.first], "SEQUENCE")
    node.image = image
    if space := _space_of(image):  # a configuration may take EXRs for another
        image.colorspace_settings.name = space
    node.frame_start, node.frame_offset = layers.first, layers.first - 1
    node.frame_duration = _TO_THE_END  # of the layers' own range the last one would be shown ever after
    node.use_auto_refresh = True


def over_render(scene: Any) -> bool:
    """Whether the flare lies over what the scene renders."""
    node = find_node(scene)
    return node is not None and any(_is_behind(node, one) for one in tree_of(scene).nodes
                                    if one.bl_idname == "CompositorNodeRLayers")


def misread(scene: Any) -> str:
    """A sentence where the colour configuration has no space for the light of the layers, "" where it has."""
    image = tree_of(scene).nodes[LAYERS].image
    if _space_of(image):
        return ""
    space = exr_space(absolute(image.filepath)).replace("linear", "linear Rec. 709")
    return (f"The colour configuration has no space of {space or 'these chromaticities'}, which the layers are in; "
            f"they are read as {image.colorspace_settings.name}, and their colours are wrong.")


def _space_of(image: Any) -> str:
    """What the colour configuration calls the space that an EXR's light is in; "" where it has none."""
    known = {item.identifier for item in image.colorspace_settings.bl_rna.properties["name"].enum_items}
    return next((one for one in CONFIGURED_NAMES.get(exr_space(absolute(image.filepath)), ()) if one in known), "")
