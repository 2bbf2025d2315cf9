# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: the compositor among an artist's own nodes. Arguments: the layers' folder, a folder to write."""
from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from start import artists_tree, leave

sys.path.remove(str(Path(__file__).parent))
ROOT = Path(__file__).resolve().parents[3]
spec = importlib.util.spec_from_file_location("run", ROOT / "headless" / "run.py")
run = importlib.util.module_from_spec(spec)
spec.loader.exec_module(run)
run.register_package()

from fit_flare.core.bake.folder import LayerFolder  # noqa: E402
from fit_flare.flare_addon import render_settings  # noqa: E402
from fit_flare.flare_addon.compositor import flare_node, setup  # noqa: E402
from fit_flare.flare_addon.panels import FITFLARE_PT_bake  # noqa: E402

GROUPS = bpy.app.version >= (5, 0, 0)
END = "NodeGroupOutput" if GROUPS else "CompositorNodeComposite"
folder, out = map(Path, sys.argv[1:3])
layers = LayerFolder.open(folder)
facts: dict[str, object] = {}


def empty() -> bpy.types.Scene:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    render_settings.match_scene(scene, layers, layers.size())
    render_settings.set_plain_output(scene)
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(scene.camera)
    return scene


def plate(scene: bpy.types.Scene) -> tuple[bpy.types.NodeTree, bpy.types.Node]:
    """An artist's compositor: a plain colour to the output."""
    tree = artists_tree(scene)
    node = tree.nodes.new("CompositorNodeRGB")
    node.name = "Plate"
    node.outputs[0].default_value = (0.5, 0.5, 0.5, 1)
    tree.links.new(node.outputs[0], tree.nodes.new(END).inputs[0])
    return tree, node


def grade(tree: bpy.types.NodeTree, name: str = "Grade") -> bpy.types.Node:
    """Insert an exposure node of one stop before the compositor's output; return the node."""
    node = tree.nodes.new("CompositorNodeExposure")
    node.name = name
    node.inputs["Exposure"].default_value = 1
    end = setup._final_input(tree)
    tree.links.new(end.links[0].from_socket, node.inputs[0])
    tree.links.new(node.outputs[0], end)
    return node


def shown(scene: bpy.types.Scene) -> float | None:
    """Render and return the red of the first pixel; None if the tree has a cycle, of which Blender may crash."""
    tree = flare_node.tree_of(scene)
    if tree is None or not all(link.is_valid for link in tree.links):
        return None
    render_settings.render_frames(scene, [layers.first], lambda _number, suffix: out / f"shown{suffix}")
    image = bpy.data.images.load(str(out / "shown.exr"))
    value = float(image.pixels[0])
    bpy.data.images.remove(image)
    return value


def names(scene: bpy.types.Scene) -> list[str]:
    tree = flare_node.tree_of(scene)
    return [] if tree is None else sorted(node.name for node in tree.nodes if node.bl_idname != END)


# ---- taken away from a composite that an artist has built round it ----------------------------------
scene = empty()
setup.set_up_nodes(scene, layers)
tree = flare_node.tree_of(scene)
fed = tree.nodes.new("CompositorNodeRGB")
fed.name = "Sky"
fed.outputs[0].default_value = (0.5, 0.5, 0.5, 1)
tree.links.new(fed.outputs[0], flare_node.find_node(scene).inputs["Scene"])
grade(tree)
facts["with our own tree"] = shown(scene)
setup.remove_nodes(scene)
facts["our own tree, removed"] = [shown(scene), names(scene)]

# A render that the artist's nodes go on from stays.
scene = empty()
setup.set_up_nodes(scene, layers, keep_image=True)
grade(flare_node.tree_of(scene))
setup.remove_nodes(scene)
tree = flare_node.tree_of(scene)
facts["render goes on"] = tree is not None and tree.nodes["Grade"].inputs[0].is_linked

# Nodes of ours that were deleted by hand, and a composite made since.
scene = empty()
setup.set_up_nodes(scene, layers, keep_image=True)
if GROUPS:
    bpy.data.node_groups.remove(flare_node.tree_of(scene))
plate(scene)
setup.set_up_nodes(scene, layers, keep_image=True)
setup.remove_nodes(scene)
facts["made since"] = [shown(scene), names(scene)]

# Our group alone deleted by hand: what was there before it is still known.
scene = empty()
tree, _ = plate(scene)
setup.set_up_nodes(scene, layers)
tree.nodes.remove(flare_node.find_node(scene))
setup.set_up_nodes(scene, layers)
setup.remove_nodes(scene)
facts["set up again"] = [shown(scene), names(scene)]

# ---- nodes behind the flare -------------------------------------------------------------------------
for over, keep in (("present", True), ("scene", False)):
    scene = empty()
    tree, _ = plate(scene)
    setup.set_up_nodes(scene, layers, keep_image=keep)
    grade(tree)
    before = shown(scene)
    setup.set_up_nodes(scene, layers, keep_image=keep)
    facts[f"graded, {over}"] = [before, shown(scene)]
    setup.remove_nodes(scene)
    facts[f"graded, {over}, removed"] = [shown(scene), names(scene)]

# A file in which that has made a cycle is put right.
scene = empty()
tree, colour = plate(scene)
node = setup.set_up_nodes(scene, layers, keep_image=True)
after = grade(tree)
tree.links.new(node.outputs["Image"], setup._final_input(tree))
tree.links.new(after.outputs[0], node.inputs["Scene"])
facts["a cycle"] = shown(scene)
setup.set_up_nodes(scene, layers, keep_image=True)
facts["no cycle"] = shown(scene)

# ---- over the baked scene, and back -----------------------------------------------------------------
scene = empty()
tree, _ = plate(scene)
node = setup.set_up_nodes(scene, layers, keep_image=True)
before = node.inputs["Scene"].links[0].from_socket
stop = tree.nodes.new("CompositorNodeExposure")
stop.name, stop.inputs["Exposure"].default_value = "Stop", 1
tree.links.new(before, stop.inputs[0])
tree.links.new(stop.outputs[0], node.inputs["Scene"])
facts["over"] = [shown(scene)]
for keep in (False, True):
    setup.set_up_nodes(scene, layers, keep_image=keep)
    facts["over"].append(shown(scene))
setup.set_up_nodes(scene, layers)
setup.remove_nodes(scene)
facts["over"].append(shown(scene))

# ---- two outputs, of which the second counts --------------------------------------------------------
scene = empty()
tree, colour = plate(scene)
second = tree.nodes.new(END)
tree.links.new(colour.outputs[0], second.inputs[0])
if GROUPS:
    second.is_active_output = True
else:
    tree.nodes.active = second  # as a click does, which makes it the one that counts, too
facts["two outputs"] = []
for _ in range(2):
    setup.set_up_nodes(scene, layers, keep_image=True)
    facts["two outputs"] += [shown(scene), [node.inputs[0].links[0].from_node.name for node in tree.nodes
                                            if node.bl_idname == END]]
    tree.nodes.active = colour  # 4.x goes by the second none the less, and tells nobody
setup.remove_nodes(scene)
facts["two outputs"].append(shown(scene))

# ---- a slider of the group that has another name ----------------------------------------------------
scene = empty()
plate(scene)
node = setup.set_up_nodes(scene, layers, keep_image=True)
for item in node.node_tree.interface.items_tree:
    if item.name in ("Intensity", "Scene"):
        item.name = f"My {item.name}"
layout = MagicMock()
FITFLARE_PT_bake._draw_compositor(None, layout, SimpleNamespace(
    fit_flare=SimpleNamespace(over="present"), render=scene.render,
    **({"compositor_effects": scene.compositor_effects} if hasattr(scene, "compositor_effects") else
                       {"compositing_node_group": scene.compositing_node_group} if GROUPS else
                       {"node_tree": scene.node_tree, "use_nodes": True})))
facts["renamed in the panel"] = [call.kwargs["text"] for call in layout.mock_calls if call[0].endswith(".prop")
                                 and "text" in call.kwargs]
setup.remove_nodes(scene)
facts["renamed sockets"] = [shown(scene), names(scene)]

# ---- a compositor that is linked from another file (up to 4.5 it is its scene's) --------------------
scene = empty()
tree, _ = plate(scene)
if GROUPS:
    bpy.data.libraries.write(str(out / "studio.blend"), {tree}, fake_user=True)
    scene = empty()
    with bpy.data.libraries.load(str(out / "studio.blend"), link=True) as (there, linked):
        linked.node_groups = there.node_groups
    scene.compositing_node_group = linked.node_groups[0]
setup.set_up_nodes(scene, layers, keep_image=True)
bpy.ops.wm.save_as_mainfile(filepath=str(out / "shot.blend"))
bpy.ops.wm.open_mainfile(filepath=str(out / "shot.blend"))
scene = bpy.context.scene
facts["linked"] = [shown(scene), "Plate" in names(scene)]
setup.remove_nodes(scene)
facts["linked, removed"] = [shown(scene), names(scene)]

leave(facts)
