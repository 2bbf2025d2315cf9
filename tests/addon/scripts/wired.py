# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: the compositor driven by the panel, rendered, and removed. Arguments: zip, .flare, layers,
those of many flares, folder."""
from __future__ import annotations

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from start import NAME, artists_tree, empty, install, leave, part

package, flare, layers, many, out = sys.argv[1:6]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
flare_node = part("flare_addon.compositor.flare_node")
facts: dict[str, object] = {}
GROUPS = bpy.app.version >= (5, 0, 0)


def dump(scene):
    """Return everything of a file in which the extension could leave a trace: nodes, links, groups, images,
    properties."""
    tree = scene.compositing_node_group if GROUPS else scene.node_tree
    whole = {"use_nodes": True if GROUPS else scene.use_nodes, "actions": len(bpy.data.actions),
             "groups": sorted(one.name for one in bpy.data.node_groups),
             "images": sorted(one.name for one in bpy.data.images), "own": sorted(dict(scene.items()))}
    if tree is None or not whole["use_nodes"]:
        return whole
    nodes = sorted((node.name, node.bl_idname, tuple(node.location)) for node in tree.nodes)
    links = sorted((link.from_node.name, link.from_socket.identifier, link.to_node.name, link.to_socket.identifier)
                   for link in tree.links)
    return {**whole, "nodes": nodes, "links": links, "animated": tree.animation_data is not None,
            "sockets": [item.name for item in tree.interface.items_tree]}


def bare(_scene):
    """No compositor at all."""


def grey(scene):
    """Build an artist's compositor: an animated colour through a blur to the output."""
    tree = artists_tree(scene)
    colour = tree.nodes.new("CompositorNodeRGB")
    colour.outputs[0].default_value = (0.25, 0.5, 0.75, 1)
    colour.outputs[0].keyframe_insert("default_value", frame=1)
    end = tree.nodes.new("NodeGroupOutput" if GROUPS else "CompositorNodeComposite")
    blur = tree.nodes.new("CompositorNodeBlur")
    tree.links.new(colour.outputs[0], blur.inputs[0])
    tree.links.new(blur.outputs[0], end.inputs[0])


def unused(scene):
    """A tree without an output."""
    artists_tree(scene).nodes.new("CompositorNodeRGB")


for make in (bare, grey, unused):
    for over in ("present", "scene"):
        scene = empty()
        make(scene)
        ops.open_flare(filepath=flare)
        scene.fit_flare.layers, scene.fit_flare.over = layers, over
        before = dump(scene)
        bpy.ops.ed.undo_push(message="before")
        assert ops.set_up_baked() == {"FINISHED"}
        ops.set_up_baked()  # twice is once
        changed = dump(scene) != before
        assert ops.remove_compositor() == {"FINISHED"}
        after = dump(scene)
        facts[f"{make.__name__}, {over}"] = [changed, after == before, "" if after == before else f"{before} {after}"]

# ---- driven: the panel's sliders, animated too, in rendered pixels --------------------------------
def shot():
    """Make a scene with a camera and the flare, whose render has as many pixels as the layers; return it."""
    scene = empty()
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    ops.open_flare(filepath=flare)
    scene.fit_flare.over = "scene"
    scene.render.resolution_x, scene.render.resolution_y = 16, 8
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR", "32"
    if hasattr(scene.render, "compositor_device"):
        scene.render.compositor_device = "CPU"
    return scene


def rendered(name):
    scene.render.filepath = str(Path(out) / f"{name}.exr")
    bpy.ops.render.render(write_still=True)
    return scene.render.filepath


scene = shot()
state = scene.fit_flare
state.layers = layers
ops.set_up_baked()
scene.frame_set(1)
files = {"plain": rendered("plain")}
state.master.intensity, state.master.tint = 2.0, (1, 0.5, 0.25)
state.lights[0].intensity = 1.5
files["graded"] = rendered("graded")
state.lights[0].mute = True
files["muted"] = rendered("muted")
state.lights[0].mute = False
state.master.intensity = 0.0
state.master.keyframe_insert("intensity", frame=1)
state.master.intensity = 4.0
state.master.keyframe_insert("intensity", frame=5)
for curve_owner in (scene,):
    action = curve_owner.animation_data.action
    curves = getattr(action, "fcurves", None) or [curve for layer in action.layers for strip in layer.strips
                                                  for bag in strip.channelbags for curve in bag.fcurves]
    for curve in curves:
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"
scene.frame_set(3)
files["animated"] = rendered("animated")
facts["files"] = files
facts["valid"] = all(curve.driver.is_valid for curve in flare_node.tree_of(scene).animation_data.drivers)

# ---- as many flares as a driver's expression could not name ---------------------------------------
scene = shot()
state = scene.fit_flare
for number in range(1, 60):
    item = state.lights.add()
    item.name, item.source = f"lamp{number}", "lamp"
state.layers = many
ops.set_up_baked()
files["many"] = rendered("many")
state.lights[1].solo = state.lights[59].solo = True
state.lights[1].intensity = 3
files["many, two solo"] = rendered("many, two solo")
bpy.ops.scene.new(type="FULL_COPY")
scene = bpy.context.scene
scene.fit_flare.lights[59].solo = False
bpy.ops.wm.save_as_mainfile(filepath=str(Path(out) / "many.blend"))
bpy.ops.wm.open_mainfile(filepath=str(Path(out) / "many.blend"))
scene = bpy.context.scene
files["many, one solo in a copy"] = rendered("many, one solo in a copy")
scene.fit_flare.lights[1].solo = False
ops.set_up_baked()
files["many, none solo"] = rendered("many, none solo")

# ---- rendered where the extension is not, after a save --------------------------------------------
scene = shot()
scene.fit_flare.layers = layers
ops.set_up_baked()
scene.fit_flare.lights[0].intensity, scene.fit_flare.master.tint = 3.0, (1, 0.5, 0.25)
facts["complete"] = [part("flare_addon.compositor.drivers").is_complete(scene)]
node = flare_node.find_node(scene)
node.inputs["Tint"].driver_remove("default_value", 0)  # an artist's own in its place
own = node.inputs["Tint"].driver_add("default_value", 0).driver
own.type = "SUM"
moved = own.variables.new()
moved.type, moved.targets[0].id, moved.targets[0].transform_type = "TRANSFORMS", scene.camera, "SCALE_X"
bpy.ops.wm.save_as_mainfile(filepath=str(Path(out) / "worker.blend"))
facts["complete"].append(part("flare_addon.compositor.drivers").is_complete(scene))
scene.fit_flare.lights.clear()
facts["complete"].append(part("flare_addon.compositor.drivers").is_complete(scene))
bpy.ops.preferences.addon_disable(module=NAME)
bpy.ops.wm.open_mainfile(filepath=str(Path(out) / "worker.blend"))
scene = bpy.context.scene
scene.frame_set(2)
files["on a worker"] = rendered("on a worker")
leave(facts)
