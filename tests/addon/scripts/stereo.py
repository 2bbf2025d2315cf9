# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: stereo scenes get a flare for each view. Arguments: the zip, a .flare that is a glow at its light, a
folder to write."""
from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).parent))
from start import install, leave, object_in, part, refusal, scene_with, select

package, flare, out = sys.argv[1:4]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
shots, stereo, flare_node, layer_nodes, warnings, panels = (
    part(f"flare_addon.{name}") for name in ("shots", "stereo", "compositor.flare_node", "compositor.layer_nodes",
                                             "compositor.warnings", "panel_parts"))
facts: dict[str, object] = {}


def use_stereo(scene, width, height, samples):
    """Make a scene render stereo with Cycles, one float file for each view."""
    render, settings = scene.render, scene.render.image_settings
    render.use_multiview = True
    render.resolution_x, render.resolution_y = width, height
    render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", samples, False
    if hasattr(render, "compositor_device"):
        render.compositor_device = "CPU"
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format, settings.color_depth, settings.views_format = "OPEN_EXR", "32", "INDIVIDUAL"


def renders(scene):
    """Render the current frame; return the file of each view, by the view's name."""
    renders.count += 1
    scene.render.filepath = str(Path(out) / f"render{renders.count}")
    bpy.ops.render.render(write_still=True, scene=scene.name)
    return {view.name: f"{scene.render.filepath}{view.file_suffix}.exr"
            for view in stereo.rendered_views(scene.render)}


renders.count = 0


def projections(scene, point):
    """The place of a point in the picture of each view, px from the top left, by the view's name."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    cores = {view.name: stereo.eye_camera(view.camera.evaluated_get(depsgraph), scene.render, view.eye)
             for view in stereo.camera_views(scene, scene.camera)}
    return {name: core.project([list(point)])[0][0].tolist() for name, core in cores.items()}


# ---- the cameras of the views, against renders of a small ball ---------------------------------------------
scene, _ = scene_with()
use_stereo(scene, 200, 120, 64)
scene.cycles.max_bounces = 0
camera = scene.camera
camera.location, camera.rotation_euler, camera.scale = (1, -2, 0.5), (1.35, 0.1, 0.3), (2, 1.5, 1)
camera.data.lens, camera.data.shift_x = 35, 0.03
bpy.context.view_layer.update()
bpy.ops.mesh.primitive_uv_sphere_add(radius=0.03, segments=32, ring_count=16,
                                     location=camera.matrix_world.normalized() @ Vector((0.2, 0.1, -2)))
ball, material = bpy.context.object, bpy.data.materials.new("Light")
if bpy.app.version < (5, 0, 0):
    material.use_nodes = True
tree = material.node_tree
tree.nodes.clear()
emission, end = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
tree.links.new(emission.outputs[0], end.inputs[0])
ball.data.materials.append(material)
settings = camera.data.stereo
settings.interocular_distance, settings.convergence_distance = 0.15, 3.0
facts["cameras"] = {}


def compare(name):
    """Render the ball in each view, and note where the camera of the view has it."""
    facts["cameras"][name] = [renders(scene), projections(scene, ball.location)]


for mode, pivot, fit in (("PARALLEL", "CENTER", "AUTO"), ("OFFAXIS", "LEFT", "VERTICAL"), ("TOE", "CENTER", "AUTO"),
                         ("TOE", "RIGHT", "AUTO")):
    settings.convergence_mode, settings.pivot, camera.data.sensor_fit = mode, pivot, fit
    compare(f"{mode} {pivot} {fit}")
scene.render.views_format, camera.name = "MULTIVIEW", "Cam_L"
partner = object_in(scene, "Cam_R", bpy.data.cameras.new("Partner"), (1.2, -2, 0.5))
partner.rotation_euler = (1.3, 0.1, 0.35)
scene.camera = partner
bpy.context.view_layer.update()
compare("MULTIVIEW")
facts["pair"] = [[view.name, view.camera.name, view.label] for view in stereo.camera_views(scene, camera)]
camera.name = "Alone"
facts["no partner"] = [[view.name, view.camera.name, view.label] for view in stereo.camera_views(scene, camera)]

# ---- a bake and its render --------------------------------------------------------------------------------
scene, (lamp,) = scene_with((0.5, 6, 0.4))
use_stereo(scene, 96, 54, 1)
settings = scene.camera.data.stereo
settings.interocular_distance, settings.convergence_distance, settings.convergence_mode = 0.5, 12.0, "OFFAXIS"
settings.pivot = "CENTER"
for frame, x in ((1, 0.5), (3, -0.5)):
    lamp.location.x = x
    lamp.keyframe_insert("location", frame=frame)
scene.frame_start, scene.frame_end, scene.frame_step = 1, 3, 2
select(scene, lamp)
ops.open_flare(filepath=flare)
scene.fit_flare.lights[0].target = lamp
scene.fit_flare.over, scene.fit_flare.layers = "present", str(Path(out) / "layers")
facts["baked"] = refusal(ops.bake)
folder = shots.layers_folder(scene)
facts["files"] = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.exr"))
facts["frames"] = []
for frame in (1, 3):
    scene.frame_set(frame)
    facts["frames"].append([renders(scene), projections(scene, lamp.matrix_world.translation)])


def stereo_warnings():
    return list(warnings.stereo_warnings(scene))


def note():
    layout = MagicMock()
    panels.draw_stereo_note(layout, scene)
    return " ".join(call.kwargs["text"] for call in layout.mock_calls if "text" in call.kwargs)


facts["warnings"] = stereo_warnings()
facts["note"] = note()
written = [path.stat().st_mtime_ns for path in sorted(folder.rglob("*.exr"))]
ops.bake()
facts["kept"] = written == [path.stat().st_mtime_ns for path in sorted(folder.rglob("*.exr"))]
scene.camera.name = "Renamed"
facts["renamed"] = [refusal(ops.set_up_baked), sorted(layer_nodes.composited_views(scene))]
scene.camera.name = "Camera"
settings.use_spherical_stereo = True
facts["spherical"] = stereo_warnings()
settings.use_spherical_stereo = False

# ---- the present mode of the scene is another than that of the layers -----------------------------------------
scene.render.use_multiview = False
facts["no stereo now"] = [stereo_warnings(), note(), refusal(ops.set_up_baked)]
scene.fit_flare.layers = str(Path(out) / "mono")
ops.bake(composite=True)
facts["mono"] = [stereo_warnings(), sorted(layer_nodes.composited_views(scene)), [
    node.name for node in flare_node.tree_of(scene).nodes if layer_nodes.is_view_node(node)]]
scene.render.use_multiview = True
facts["mono layers"] = [refusal(ops.set_up_baked), stereo_warnings()]
scene.fit_flare.layers = str(Path(out) / "layers")
facts["stereo layers"] = [refusal(ops.set_up_baked), stereo_warnings()]
ops.remove_compositor()
facts["removed"] = [flare_node.find_node(scene) is None, [
    image.name for image in bpy.data.images if image.source == "SEQUENCE"]]

# ---- one view alone, equal suffixes, and selected cameras --------------------------------------------------------
second = object_in(scene, "Second", scene.camera.data, (0.1, 0, 0))


def names(cameras):
    """The names of a shot of these cameras."""
    shot = shots.read_scene_shot(scene, cameras, [1, 3], Path(flare), None)
    return list(shot.folders)


scene.render.views["left"].use = False
facts["right alone"] = names([])
scene.render.views["left"].use = True
scene.render.views["right"].file_suffix = "_L"
facts["equal suffixes"] = names([])
scene.render.views["right"].file_suffix = "_R"
facts["selected"] = names([scene.camera, second])
scene.render.views_format, scene.camera.name, second.name = "MULTIVIEW", "Cam_L", "Cam_R"
facts["selected pair"] = names([scene.camera, second])
scene.render.views_format = "STEREO_3D"

# ---- stereo settings that change while a bake reads the scene -----------------------------------------------
facts["changed meanwhile"] = []
for name, changed, before in (("use_multiview", False, True), ("views_format", "MULTIVIEW", "STEREO_3D")):
    reading = shots.ShotReading(scene, [], [1, 3])
    reading.step()
    setattr(scene.render, name, changed)
    try:
        reading.step()
    except part("core.errors").CaptureError as problem:
        facts["changed meanwhile"].append(str(problem))
    reading.restore()
    setattr(scene.render, name, before)

# ---- the view that a 3D view shows ----------------------------------------------------------------------------------
depsgraph = bpy.context.evaluated_depsgraph_get()
facts["shown"] = []
for name in ("", "left", "right"):
    viewed, eye = stereo.view_camera(scene, scene.camera, name)
    matrix = stereo.eye_matrix(viewed.evaluated_get(depsgraph), eye).inverted()
    region = SimpleNamespace(view_matrix=matrix)
    context = SimpleNamespace(scene=scene, view_layer=bpy.context.view_layer, region_data=region)
    facts["shown"].append([name, stereo.displayed_view(context, scene.camera)])
leave(facts)
