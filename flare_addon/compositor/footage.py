# SPDX-License-Identifier: GPL-3.0-or-later
"""The nodes of the picture under the flare: footage, and in front of it the render, if the film is transparent.

`setup` connects them.
"""
from __future__ import annotations

from typing import Any

from ...core.errors import FrameError
from .flare_node import alpha_over, new_node, scale_to_render_size, set_name
from .trees import depends_on, incoming_picture, tree_of

PLATE = "Fit Flare Footage"
SIZE = "Fit Flare Size"
RENDER = "Fit Flare Render"
OBJECTS = "Fit Flare Objects"
"""Name of the node that composites the render over footage."""
_RENDER_LAYERS = "CompositorNodeRLayers"
_RENDER_SOURCES = (_RENDER_LAYERS, "NodeGroupInput")
"""Types of the nodes that give a tree the render; in a stack of effects it comes from the effects before."""


def footage_nodes(scene: Any) -> list[Any]:
    """Return the node that shows footage under the flare, as a list; [] without one."""
    tree = tree_of(scene)
    node = tree.nodes.get(PLATE) if tree is not None else None
    return [node] if getattr(node, "image", None) is not None else []


def footage_behind_camera(scene: Any) -> tuple[Any, int, int, int]:
    """Return the footage behind the scene's camera: image, frame_start, frame_offset, frame_duration.

    Raises FrameError where there is none.
    """
    camera = scene.camera
    for background in camera.data.background_images if camera is not None and camera.type == "CAMERA" else ():
        if background.source == "IMAGE" and background.image is not None:
            user = background.image_user
            return background.image, user.frame_start, user.frame_offset, user.frame_duration
    raise FrameError("The camera has no footage behind it; choose Render under Over instead.")


def footage_node(tree: Any, plate: tuple[Any, int, int, int]) -> Any:
    """Return the node that shows footage. plate: image, frame_start, frame_offset, frame_duration."""
    node = tree.nodes.get(PLATE) or set_name(new_node(tree, "CompositorNodeImage", -4, 2.5), PLATE)
    image, start, offset, duration = plate
    node.image = image
    if image.source == "SEQUENCE":
        node.frame_start, node.frame_offset, node.frame_duration = start, offset, duration
        node.use_auto_refresh = True
    return node


def render_picture(tree: Any) -> Any:
    """Return the socket of the render; a node for it is added where there is none.

    In a stack of effects it is the picture that comes into the effect.
    """
    render = next((node for node in tree.nodes if node.bl_idname == _RENDER_LAYERS), None)
    if render is None and (incoming := incoming_picture(tree, RENDER)) is not None:
        return incoming
    return (render or set_name(new_node(tree, _RENDER_LAYERS, -4, 1), RENDER)).outputs["Image"]


def remove_unused_render(tree: Any) -> None:
    """Remove our node of the render if nothing uses its output; Blender renders the scene for it all the same."""
    render = tree.nodes.get(RENDER)
    if render is not None and not any(output.is_linked for output in render.outputs):
        tree.nodes.remove(render)


def picture_at_size(tree: Any, socket: Any, with_objects: bool) -> Any:
    """Add nodes that scale a picture of a file to the size of the render; return their output socket.

    socket: output socket of the picture. with_objects: whether to composite the render over it.
    """
    picture = set_name(scale_to_render_size(tree, socket, -3, 1), SIZE).outputs[0]
    if with_objects:
        picture = set_name(alpha_over(tree, picture, render_picture(tree), -2.5, 2), OBJECTS).outputs[0]
    return picture


def is_artists_picture(node: Any) -> bool:
    """Return whether a node below the flare has a picture other than the render; None is no node.

    Such a picture stays as the artist built it: the render is not composited over footage in its place.
    """
    return node is not None and node.bl_idname != _RENDER_LAYERS


def shows_render(tree: Any, node: Any) -> bool:
    """Return whether a node of the tree uses the render."""
    return any(depends_on(node, source) for source in tree.nodes if source.bl_idname in _RENDER_SOURCES)
