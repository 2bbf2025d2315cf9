# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: build, rebuild, render. Arguments: folders of layers, of layers of fewer lights, of a picture without
layers, of wide pixels in ACEScg, of overscan, and the folder to write."""
from __future__ import annotations

import importlib.util
import json
import os
import sys
from pathlib import Path

import bpy

ROOT = Path(__file__).resolve().parents[3]
spec = importlib.util.spec_from_file_location("run", ROOT / "headless" / "run.py")
run = importlib.util.module_from_spec(spec)
spec.loader.exec_module(run)
run.register_package()

from fit_flare.core.bake.folder import LayerFolder  # noqa: E402
from fit_flare.core.errors import FrameError  # noqa: E402
from fit_flare.core.system.progress import Progress  # noqa: E402
from fit_flare.flare_addon import render_settings  # noqa: E402
from fit_flare.flare_addon.compositor import flare_node, layer_nodes, setup  # noqa: E402
from fit_flare.headless.commands import compose  # noqa: E402

INTENSITY, TINT = 1.7, (1.0, 0.5, 0.25, 1.0)

folder, fewer, none, aces, overscan, out = map(Path, sys.argv[1:7])
layers = LayerFolder.open(folder)


def empty() -> bpy.types.Scene:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.frame_set(layers.last + 1)
    render_settings.match_scene(scene, layers, layers.size())
    render_settings.set_plain_output(scene)
    return scene


def render(scene: bpy.types.Scene, name: str, frames: list[int]) -> None:
    render_settings.render_frames(scene, frames, lambda number, suffix: out / name / f"{number}{suffix}")


facts: dict[str, object] = {"version": bpy.app.version_string}

# ---- the graph as it comes, rendered and saved ----------------------------------------------------
scene = empty()
facts["stands at"] = scene.frame_current
node = setup.set_up_nodes(scene, layers)
facts["inputs"] = [socket.name for socket in node.inputs]
facts["outputs"] = [socket.name for socket in node.outputs]
render(scene, "plain", sorted(layers.files))

# ---- with the sliders moved -----------------------------------------------------------------------
node.inputs["Intensity"].default_value = INTENSITY
node.inputs["Tint"].default_value = TINT
render(scene, "changed", sorted(layers.files))
render_settings.save_blend(out / "scene" / "compositor.blend")

# ---- set up again: nothing doubles, the sliders stay ----------------------------------------------
count = len(flare_node.tree_of(scene).nodes), len(bpy.data.node_groups)
again = setup.set_up_nodes(scene, layers)
facts["doubled"] = [count, (len(flare_node.tree_of(scene).nodes), len(bpy.data.node_groups))]
facts["sliders"] = [again.inputs["Intensity"].default_value, list(again.inputs["Tint"].default_value)]

# ---- the flare alone ------------------------------------------------------------------------------
flare_node.tree_of(scene).links.new(again.outputs["Flare"], setup._final_input(flare_node.tree_of(scene)))
render(scene, "flare", sorted(layers.files)[:1])

# ---- over what is there: a plain colour in place of the baked scene, twice ------------------------
scene = empty()
tree = setup._new_tree(scene, keep_image=False)
plate = tree.nodes.new("CompositorNodeRGB")
plate.outputs[0].default_value = (0.25, 0.5, 0.75, 1.0)
tree.links.new(plate.outputs[0], setup._final_input(tree))
for _ in range(2):
    setup.set_up_nodes(scene, layers, keep_image=True)
facts["plate stays"] = plate.name in tree.nodes
render(scene, "over", sorted(layers.files)[:1])

# ---- at other percentages of the size than it was baked for ---------------------------------------
for percentage in (50, 200):
    scene.render.resolution_percentage = percentage
    render(scene, f"over at {percentage}", sorted(layers.files)[:1])
scene = empty()
setup.set_up_nodes(scene, layers)
scene.render.resolution_percentage = 50
render(scene, "plain at 50", sorted(layers.files)[:1])

# ---- pointed at layers of fewer lights ------------------------------------------------------------
scene = empty()
setup.set_up_nodes(scene, layers)
node = setup.set_up_nodes(scene, LayerFolder.open(fewer))
try:
    setup.set_up_nodes(scene, LayerFolder.open(none))
except FrameError as problem:
    facts["no layers"] = str(problem)
facts["fewer"] = [socket.name for socket in node.inputs if socket.is_linked]
render(scene, "fewer", [layers.first])

# ---- two scenes of one tree -----------------------------------------------------------------------
if flare_node.GROUPS_ARE_TREES:
    scene = empty()
    setup.set_up_nodes(scene, layers)
    second = bpy.data.scenes.new("Second")
    second.compositing_node_group = scene.compositing_node_group
    setup.set_up_nodes(second, LayerFolder.open(fewer))
    shown = flare_node.tree_of(scene).nodes[setup.LAYERS].image.filepath
    setup.remove_nodes(second)
    third = bpy.data.scenes.new("Third")
    third.compositing_node_group = scene.compositing_node_group
    setup.remove_nodes(third)
    fourth = bpy.data.scenes.new("Fourth")
    fourth.compositing_node_group = scene.compositing_node_group
    trees = len(bpy.data.node_groups)
    try:
        setup.set_up_nodes(fourth, LayerFolder.open(none))
    except FrameError:
        facts["refused of one tree"] = [fourth.compositing_node_group == scene.compositing_node_group,
                                        len(bpy.data.node_groups) - trees]
    facts["two scenes of one tree"] = [str(folder) in bpy.path.abspath(shown),
                                       flare_node.find_node(second) is None, flare_node.find_node(third) is None]
    render(scene, "of one tree", sorted(layers.files)[:1])

# ---- wide pixels stay; a region that is cut out is refused, and leaves nothing --------------------
scene = empty()
scene.render.pixel_aspect_x = 2
render_settings.match_scene(scene, layers, layers.size())
facts["pixel aspect"] = scene.render.pixel_aspect_x
scene.render.use_border = scene.render.use_crop_to_border = True
try:
    setup.set_up_nodes(scene, layers)
except FrameError as problem:
    facts["cropped"] = [str(problem), flare_node.find_node(scene) is None]

# ---- the command, of layers of wide pixels in ACEScg ----------------------------------------------
compose.compose_frames(LayerFolder.open(aces), out / "aces", Progress())
scene = bpy.context.scene
facts["aces"] = [layer_nodes.colour_space_warning(scene), scene.render.pixel_aspect_x, scene.render.pixel_aspect_y]

# ---- overscan, in the command and beside an artist's nodes ------------------------------------------
compose.compose_frames(LayerFolder.open(overscan), out / "overscan", Progress())
scene = bpy.context.scene
setup.set_up_nodes(scene, LayerFolder.open(overscan))
facts["crops"] = sorted(node.name for node in flare_node.tree_of(scene).nodes if node.name.startswith(setup.CROP))
setup.set_up_nodes(scene, layers)
facts["crops after"] = [node.name for node in flare_node.tree_of(scene).nodes if node.name.startswith(setup.CROP)]
setup.set_up_nodes(scene, LayerFolder.open(overscan))
setup.remove_nodes(scene)
tree = flare_node.tree_of(scene)
facts["crops removed"] = [node.name for node in tree.nodes if node.name.startswith("Fit Flare")] if tree else []

# ---- a disk that fills up -------------------------------------------------------------------------
if sys.platform == "linux":
    import resource
    import signal

    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    scene = empty()
    setup.set_up_nodes(scene, layers)
    full, before = out / "full", resource.getrlimit(resource.RLIMIT_FSIZE)
    refused = []
    for write in (lambda: render(scene, "full", sorted(layers.files)[:1]),
                  lambda: render_settings.save_blend(full / "compositor.blend")):
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
        try:
            write()
        except FrameError as problem:
            refused.append(str(problem))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    facts["full"] = [refused, [path.name for path in full.iterdir()]]

print(json.dumps(facts))
sys.stdout.flush()
os._exit(0)
