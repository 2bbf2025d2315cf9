# SPDX-License-Identifier: GPL-3.0-or-later
"""The nodes that show baked layers: one Image node, or in a stereo scene one for each rendered view.

In a stereo scene, a Switch View node for each layer selects the layers of the view that Blender renders. Blender's own
stereo settings of an image would need fewer nodes, but they work only for files without layers. `setup` adds and
removes these nodes.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import bpy

from ...core.bake.folder import LayerFolder
from ...core.colour.ocio import CONFIGURED_NAMES
from ...core.errors import FrameError
from ...core.images.exr import channel_names, exr_colour_space
from ..images import load_image
from ..paths import absolute
from .flare_node import new_node, set_name
from .trees import tree_of

LAYERS = "Fit Flare Layers"
"""Name of the node that shows the layers, in a stereo scene those of the first view."""
_VIEW_LAYERS_PREFIX = f"{LAYERS} of "
"""Start of the names of the nodes that show the layers of the other views."""
_SWITCH_PREFIX = "Fit Flare View "
"""Start of the names of the nodes that choose the view, one for each layer."""
_MAX_FRAMES = 1048574  # the limit of Blender; frames without a file have no flare


def show_layers(node: Any, layers: LayerFolder) -> None:
    """Make an Image node show the file with the number of each frame; gaps and a frame 0 are possible."""
    image = load_image(layers.files[layers.first], "SEQUENCE")
    node.image = image
    if space := _configured_space(image):  # a configuration may assign another space to EXRs
        image.colorspace_settings.name = space
    node.frame_start, node.frame_offset = layers.first, layers.first - 1
    node.frame_duration = _MAX_FRAMES  # with the range of the layers the last one would be repeated after it
    node.use_auto_refresh = True


def check_views(views: Mapping[str, LayerFolder]) -> None:
    """Raise FrameError where the views of a stereo scene differ in their layers or sizes. views: by name."""
    first, *others = views.values()
    for other in others:
        names, other_names = (set(channel_names(layers.files[layers.first])) for layers in (first, other))
        if names != other_names or first.window() != other.window():
            raise FrameError(f"{first.folder} and {other.folder} hold different layers, or layers of different sizes; "
                             "bake the views of this scene together.")


def switch_views(scene: Any, tree: Any, views: Mapping[str, LayerFolder], names: Iterable[str]) -> dict[str, Any]:
    """Add the nodes that show the layers of each view; return the output socket of each layer, by its name.

    tree: the scene's, with the node of the first view. views: by the name of Blender's view, the first one first.
    names: of the layers.
    """
    sources = [tree.nodes[LAYERS]]
    for row, (view, layers) in enumerate(list(views.items())[1:], 1):
        sources.append(set_name(new_node(tree, "CompositorNodeImage", -4, -1.5 * row), f"{_VIEW_LAYERS_PREFIX}{view}"))
        show_layers(sources[-1], layers)
    sockets = {}
    for row, name in enumerate(names):
        with bpy.context.temp_override(scene=scene):  # the node has the views of the scene in the context
            switch = set_name(new_node(tree, "CompositorNodeSwitchView", -3.2, -0.7 * row), f"{_SWITCH_PREFIX}{name}")
        for view, source in zip(views, sources, strict=True):
            tree.links.new(source.outputs[name], switch.inputs[view])
        sockets[name] = switch.outputs[0]
    return sockets


def is_view_node(node: Any) -> bool:
    """Return whether a node was added by `switch_views`."""
    return bool(node.name.startswith((_VIEW_LAYERS_PREFIX, _SWITCH_PREFIX)))


def composited_views(scene: Any) -> set[str]:
    """Return the names of the views whose own layers the compositor of a scene shows; none without stereo."""
    tree = tree_of(scene)
    switches = [node for node in tree.nodes if node.name.startswith(_SWITCH_PREFIX)] if tree is not None else []
    return {socket.name for switch in switches for socket in switch.inputs if socket.is_linked}


def view_images(tree: Any) -> list[Any]:
    """Return the images of the nodes that show the layers of the views after the first one."""
    return [node.image for node in tree.nodes if node.name.startswith(_VIEW_LAYERS_PREFIX)]


def remove_view_nodes(tree: Any) -> None:
    """Remove the nodes that `switch_views` added."""
    for node in [node for node in tree.nodes if is_view_node(node)]:
        tree.nodes.remove(node)


def colour_space_warning(scene: Any) -> str:
    """Return a warning where the colour configuration has no space for the layers, "" where it has."""
    image = tree_of(scene).nodes[LAYERS].image
    if _configured_space(image):
        return ""
    space = exr_colour_space(absolute(image.filepath)).replace("linear", "linear Rec. 709")
    return (f"The colour configuration has no space for {space or 'these chromaticities'}, which the layers are in; "
            f"they are read as {image.colorspace_settings.name}, and their colours are wrong.")


def _configured_space(image: Any) -> str:
    """Return the name of an EXR's colour space in the colour configuration; "" where it has none of the known names."""
    known = {item.identifier for item in image.colorspace_settings.bl_rna.properties["name"].enum_items}
    names = CONFIGURED_NAMES.get(exr_colour_space(absolute(image.filepath)), ())
    return next((name for name in names if name in known), "")
