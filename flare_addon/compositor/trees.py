# SPDX-License-Identifier: GPL-3.0-or-later
"""The compositor tree of a scene: its own tree until 4.5, a node group from 5.0, one of a stack of effects from 5.3.

The effects of a stack follow each other. The Group Input of an effect's tree is the picture of the effects before it,
that of the first is the render. The flare belongs into the last effect, so that it lies over the whole picture.
The last functions follow the links between the nodes of any tree.
"""
from __future__ import annotations

from typing import Any

import bpy

GROUPS_ARE_TREES = bpy.app.version >= (5, 0, 0)
"""From Blender 5.0 a scene's compositor is a node group; before, it is the scene's own tree, switched by use_nodes."""
HAS_EFFECTS = "compositor_effects" in bpy.types.Scene.bl_rna.properties
OUTPUT_TYPE = "NodeGroupOutput" if GROUPS_ARE_TREES else "CompositorNodeComposite"
NODE = "Fit Flare"
"""Name of our node, and of the effect that holds it where the scene has none."""


def tree_of(scene: Any) -> Any:
    """Return the compositor tree of the scene; None where it has none.

    In a stack of effects it is the tree with our node, else the tree of the last effect.
    """
    if HAS_EFFECTS:
        effect = effect_of(scene)
        return effect.node_group if effect is not None else None
    if GROUPS_ARE_TREES:
        return scene.compositing_node_group
    return scene.node_tree if scene.use_nodes else None


def effect_of(scene: Any) -> Any:
    """Return the effect with our node, else the last one that has a tree; None without any, and before 5.3."""
    if not HAS_EFFECTS:
        return None
    effects = [effect for effect in scene.compositor_effects if effect.node_group is not None]
    ours = (effect for effect in effects if NODE in effect.node_group.nodes)
    return next(ours, effects[-1] if effects else None)


def uses_tree(scene: Any, tree: Any) -> bool:
    """Return whether a scene composites with this tree."""
    if HAS_EFFECTS:
        return any(effect.node_group == tree for effect in scene.compositor_effects)
    return bool(tree_of(scene) == tree)


def replace_tree(scene: Any, tree: Any) -> Any:
    """Make the scene use `tree` in place of its present tree, or in a new effect; return it. For Blender 5.0 or
    later."""
    if not HAS_EFFECTS:
        scene.compositing_node_group = tree
        return tree
    effect = effect_of(scene)
    if effect is None:
        effect = scene.compositor_effects.new(name=NODE)
    effect.node_group = tree
    return tree


def new_tree(scene: Any) -> Any:
    """Give a scene without a compositor tree an empty one; return it.

    Until Blender 4.5, a tree that was switched off is switched on and keeps its nodes.
    """
    if GROUPS_ARE_TREES:
        return replace_tree(scene, bpy.data.node_groups.new("Compositor", "CompositorNodeTree"))
    is_new = scene.node_tree is None
    scene.use_nodes = True
    if is_new:
        scene.node_tree.nodes.clear()
    return scene.node_tree


def discard_tree(scene: Any, tree: Any, use_nodes: bool) -> None:
    """Remove the compositor tree of the scene, with its effect.

    Until Blender 4.5 the tree cannot be removed: it is emptied, and `use_nodes` is set back to this earlier value.
    """
    if not GROUPS_ARE_TREES:
        tree.nodes.clear()
        scene.use_nodes = use_nodes
        return
    if HAS_EFFECTS:
        for effect in [effect for effect in scene.compositor_effects if effect.node_group == tree]:
            scene.compositor_effects.remove(effect)
    else:
        scene.compositing_node_group = None
    if not tree.users:
        bpy.data.node_groups.remove(tree)


def has_tree(scene: Any) -> bool:
    """Return whether the scene has a compositor tree, also one that is switched off."""
    return tree_of(scene) is not None if GROUPS_ARE_TREES else scene.node_tree is not None


def is_off_in_renders(scene: Any) -> bool:
    """Return whether the effect with our node is switched off for renders."""
    effect = effect_of(scene)
    return effect is not None and NODE in effect.node_group.nodes and not effect.enable_for_render


def is_off_in_preview(scene: Any) -> bool:
    """Return whether the effect with our node is switched off for viewports that composite."""
    effect = effect_of(scene)
    return effect is not None and NODE in effect.node_group.nodes and not effect.enable_for_preview


def forget_composited_frames(scene: Any) -> None:
    """Make the interactive compositor show new files: composite again, without the frames that Blender 5.3 keeps."""
    tree = tree_of(scene)
    if tree is None:
        return
    tree.update_tag()
    if getattr(scene.render, "use_compositor_frames_cache", False):
        scene.render.use_compositor_frames_cache = False  # frees the frames
        scene.render.use_compositor_frames_cache = True


def input_sockets(tree: Any) -> list[Any]:
    """Return the inputs in the interface of a tree; [] before 5.0."""
    return [item for item in tree.interface.items_tree if getattr(item, "in_out", "") == "INPUT"] \
        if GROUPS_ARE_TREES else []


def incoming_picture(tree: Any, name: str) -> Any:
    """Return the output socket of an effect tree's Group Input node, which has the picture of the effects before it.

    None before Blender 5.3. The tree's input and the node are added where they are missing; name: of an added node.
    """
    if not HAS_EFFECTS:
        return None
    if not input_sockets(tree):
        tree.interface.new_socket("Image", in_out="INPUT", socket_type="NodeSocketColor")
    node = next((node for node in tree.nodes if node.bl_idname == "NodeGroupInput"), None)
    if node is None:
        node = tree.nodes.new("NodeGroupInput")
        node.name, node.location = name, (-880, 220)
    return node.outputs[0]


def remove_incoming(tree: Any, count: int) -> None:
    """Remove the inputs of a tree beyond the first `count`, if no node uses the inputs."""
    if HAS_EFFECTS and not any(node.bl_idname == "NodeGroupInput" for node in tree.nodes):
        for item in input_sockets(tree)[count:]:
            tree.interface.remove(item)


def feeding_socket(socket: Any) -> Any:
    """Return the output socket that feeds an input; None where nothing does."""
    return socket.links[0].from_socket if socket is not None and socket.is_linked else None


def depends_on(candidate: Any, node: Any) -> bool:
    """Return whether a node is `node`, or uses its output directly or through others."""
    visited: set[str] = set()
    remaining = [candidate]
    while remaining:
        current = remaining.pop()
        if current == node:
            return True
        if current.name not in visited:
            visited.add(current.name)
            remaining += [link.from_node for socket in current.inputs for link in socket.links]
    return False


def is_active_output(tree: Any, end: Any) -> bool:
    """Return whether an output node is the one that Blender uses, where there are several.

    Blender 4.x stores no active output: it uses the output that was selected last. Where another node is selected now,
    that is the output that shows our node, since our node was linked to the active one.
    """
    if hasattr(end, "is_active_output"):
        return bool(end.is_active_output)
    if tree.nodes.active is not None and tree.nodes.active.bl_idname == OUTPUT_TYPE:
        return bool(end == tree.nodes.active)
    return NODE in tree.nodes and depends_on(end, tree.nodes[NODE])
