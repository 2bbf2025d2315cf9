# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: flares renamed, removed and animated while the compositor shows their layers. Arguments: the zip, a
.flare, a folder of layers and live.json, one of a layer more, a folder to write."""
from __future__ import annotations

import math
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from start import NAME, empty, install, leave, part, refusal

package, flare, layers, more, out = sys.argv[1:6]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
setup, flare_node, drivers, render_settings, looks, shots, bake, panels, fcurves = (
    part(f"flare_addon.{name}") for name in ("compositor.setup", "compositor.flare_node", "compositor.drivers",
                                             "render_settings", "looks", "shots",
                                             "operators.bake", "panels", "fcurves"))
facts: dict[str, object] = {}


def shot(lamps, *, over="scene"):
    """Make a scene with a flare at each of these lamps and their baked layers; return it. over: what flares lie
    over."""
    scene = empty()
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(scene.camera)
    scene.render.resolution_x, scene.render.resolution_y = 16, 8
    if hasattr(scene.render, "compositor_device"):
        scene.render.compositor_device = "CPU"
    render_settings.set_plain_output(scene)
    for name in lamps:
        lamp = bpy.data.objects.new(name, None)
        scene.collection.objects.link(lamp)
        lamp.fit_flare.is_light, lamp.fit_flare.light = True, name
    ops.open_flare(filepath=flare)
    for name in lamps[1:]:
        looks.add_flare(scene, scene.objects[name], "lamp")
    scene.fit_flare.layers, scene.fit_flare.over = layers, over
    return scene


def shown(scene, frame=1):
    """The middle of the picture."""
    scene.frame_set(frame)
    render_settings.render_frames(scene, [frame], lambda _number, suffix: Path(out) / f"shown{suffix}")
    image = bpy.data.images.load(str(Path(out) / "shown.exr"))
    value = float(image.pixels[0])
    bpy.data.images.remove(image)
    return value


def said(scene):
    """What the panel says of the compositor."""
    layout = MagicMock()
    panels.FITFLARE_PT_bake._draw_compositor(None, layout, scene)
    return " ".join(call.kwargs["text"] for call in layout.mock_calls if call[0].endswith(".label"))


def set_up_warnings(scene):
    """Return the warnings of Set Up Compositor."""
    operator = MagicMock()
    bake.set_up_compositor(operator, scene, layers, keep_image=True, plate=False)
    return [call.args[1] for call in operator.report.mock_calls if call.args[0] == {"WARNING"}]


def work(scene):
    return all(curve.driver.is_valid for curve in drivers.node_drivers(scene))


# ---- renamed ----------------------------------------------------------------------------------------
scene = shot(["lamp", "key"])
state = scene.fit_flare
live = Path(layers) / shots.LIVE_FILE
old = live.read_text()
ops.set_up_baked()
facts["both"] = shown(scene)
state.lights[0].name = "sun"
state.lights[0].intensity = 2
facts["renamed"] = [shown(scene), work(scene)]
state.lights[0].name = "lamp"
part("core.system.files").write_json(live, shots.live_record(state, ["lamp", "key"]))  # as a bake writes it
state.lights[0].name = "sun"
ops.set_up_baked()
facts["renamed, set up again"] = [shown(scene), work(scene), "act on it." in said(scene)]
live.write_text(old)

# A slider that an earlier version left at what it was last driven to, its flare having another name.
node = flare_node.find_node(scene)
state.lights[0].mute = True
muted = shown(scene)
state.lights[0].name, state.lights[0].identity = "moon", ""
ops.set_up_baked()
facts["unknown now"] = [muted, shown(scene)]

# ---- removed ----------------------------------------------------------------------------------------
scene = shot(["lamp", "key"])
state = scene.fit_flare
ops.set_up_baked()
state.lights[1].intensity = 3
state.light = 0
ops.remove_flare()
facts["removed"] = [shown(scene), work(scene)]
state.lights[0].intensity = 1
facts["removed"].append(shown(scene))

# ---- drivers of an earlier version ------------------------------------------------------------------
scene = shot(["lamp", "key"])
state = scene.fit_flare
ops.set_up_baked()
for curve in drivers.node_drivers(scene):
    for variable in curve.driver.variables:
        target = variable.targets[0]
        for number, name in enumerate(("lamp", "key")):
            target.data_path = target.data_path.replace(f"lights[{number}]", f'lights["{name}"]')
bpy.ops.wm.save_as_mainfile(filepath=str(Path(out) / "before.blend"))
bpy.ops.wm.open_mainfile(filepath=str(Path(out) / "before.blend"))
scene = bpy.context.scene
state = scene.fit_flare
state.lights[0].name = "sun"
state.lights[0].intensity = 2
facts["of an earlier version"] = [shown(scene), work(scene)]
ops.set_up_baked()
facts["of an earlier version"] += [shown(scene), work(scene)]

# ---- dead drivers give a warning --------------------------------------------------------------------------
for curve in drivers.node_drivers(scene):
    for variable in curve.driver.variables:
        variable.targets[0].data_path = "fit_flare.nothing"
    curve.driver.expression = curve.driver.expression  # compiled again
scene.frame_set(2)
shown(scene)
facts["dead"] = said(scene)

# ---- keyed ------------------------------------------------------------------------------------------
scene = shot(["lamp", "key", "rim"])
state = scene.fit_flare
rim = state.lights[2]
for frame, value in ((1, 1.0), (3, 5.0)):
    rim.intensity = value
    rim.keyframe_insert("intensity", frame=frame)
    state.lights[1].keyframe_insert("intensity", frame=frame)
rim.driver_add("scale").driver.expression = "2"
state.light = 1
ops.remove_flare()
scene.frame_set(3)
facts["keyed"] = [[item.name, item.intensity, item.scale] for item in state.lights]
looks.add_flare(scene, scene.objects["key"], "lamp")
scene.frame_set(1)
scene.frame_set(3)
facts["keyed"].append([state.lights[2].intensity, state.lights[2].scale])

# The node's own sliders, when a layer more comes before them.
live.rename(live.with_suffix(".away"))
scene = shot(["lamp"])
ops.set_up_baked()
tree, node = flare_node.tree_of(scene), flare_node.find_node(scene)
for frame, value in ((1, 1.0), (3, 4.0)):
    node.inputs["Intensity"].default_value = value
    node.inputs["Intensity"].keyframe_insert("default_value", frame=frame)
colour = tree.nodes.new("CompositorNodeRGB")
colour.outputs[0].default_value = (0.5, 0.5, 0.5, 1)
tree.links.new(colour.outputs[0], node.inputs["Tint"])
facts["keyed node"] = [shown(scene, 3)]
scene.fit_flare.layers = more
ops.set_up_baked()
facts["keyed node"] += [shown(scene, 3), shown(scene, 1)]
live.with_suffix(".away").rename(live)

# ---- warnings about frames without layers and animated sliders ----------------------------------
scene = shot(["lamp"])
setup._new_tree(scene, keep_image=False)
colour = flare_node.tree_of(scene).nodes.new("CompositorNodeRGB")
colour.outputs[0].default_value = (0.5, 0.5, 0.5, 1)
flare_node.tree_of(scene).links.new(colour.outputs[0], setup._final_input(flare_node.tree_of(scene)))
scene.frame_start, scene.frame_end = 1, 3
facts["all frames"] = set_up_warnings(scene)
scene.frame_start, scene.frame_end = 0, 6
facts["too few"] = set_up_warnings(scene)
facts["missing is magenta"] = bpy.app.version < (4, 4, 0)
facts["after the last"] = [shown(scene, frame) for frame in (3, 4, 6)]
scene.frame_start, scene.frame_end = 1, 3
scene.fit_flare.lights[0].keyframe_insert("scale", frame=1)
facts["scale keyed"] = set_up_warnings(scene)
scene.fit_flare.lights[0].keyframe_insert("intensity", frame=1)
facts["intensity keyed"] = set_up_warnings(scene)

# ---- warnings about renders that would not show the composite as it is ------------------------------
scene = shot(["lamp"])
scene.frame_start, scene.frame_end = 1, 3
scene.render.use_compositing = False
facts["switched off"] = set_up_warnings(scene)
scene.render.use_compositing = True
editor = scene.sequence_editor_create()
strips = editor.strips if hasattr(editor, "strips") else editor.sequences
ends = "length" if "length" in strips.bl_rna.functions["new_effect"].parameters else "frame_end"
strip = strips.new_effect(name="title", type="COLOR", channel=1, frame_start=1, **{ends: 4})
facts["sequenced"] = set_up_warnings(scene)
strip.mute = True
facts["muted"] = set_up_warnings(scene)
scene.render.resolution_x = scene.render.resolution_y
facts["square"] = set_up_warnings(scene)
scene.render.resolution_x, scene.render.resolution_y = 32, 16
scene.render.film_transparent = True
scene.render.image_settings.color_mode = "RGBA"
facts["transparent"] = set_up_warnings(scene)
scene.render.image_settings.color_mode = "RGB"
facts["no alpha"] = set_up_warnings(scene)
scene.render.use_multiview = True
facts["stereo"] = set_up_warnings(scene)
scene.render.use_multiview = False

# ---- a layer that an artist looks at as a still -----------------------------------------------------
scene = shot(["lamp"])
still = bpy.data.images.load(str(Path(layers) / "layers.0001.exr"))
still.use_fake_user = True
ops.set_up_baked()
facts["still"] = [still.source, flare_node.tree_of(scene).nodes[setup.LAYERS].image.source]

# ---- a frame that is shown is baked again -----------------------------------------------------------
scene = shot(["lamp"])
ops.set_up_baked()
first = Path(layers) / "layers.0001.exr"
facts["baked again"] = [shown(scene)]
if hasattr(scene.render, "use_compositor_frames_cache"):
    scene.render.use_compositor_frames_cache = True
kept = first.read_bytes()
first.write_bytes((Path(out) / "again.exr").read_bytes())
part("flare_addon.jobs").ON_FINISHED["bake"](SimpleNamespace(folder=Path(layers), state="done"))
facts["baked again"].append(shown(scene))
facts["keeps frames"] = getattr(scene.render, "use_compositor_frames_cache", True)
first.write_bytes(kept)


class RecordedRender:
    """Render settings that record what is assigned to the switch of the cache of composited frames (5.3)."""

    def __init__(self, is_on):
        vars(self).update(assigned=[], use_compositor_frames_cache=is_on)

    def __setattr__(self, name, value):
        self.assigned.append([name, value])
        vars(self)[name] = value


class RecordedScene:
    """The scene with recorded render settings."""

    def __init__(self, is_on):
        self.render = RecordedRender(is_on)

    def __getattr__(self, name):
        return getattr(scene, name)


forgotten = []
for recorded in (RecordedScene(True), RecordedScene(False)):
    part("flare_addon.compositor.trees").forget_composited_frames(recorded)
    forgotten.append(recorded.render.assigned)
baking, reset = part("flare_addon.baking"), []
forget, baking.forget_composited_frames = baking.forget_composited_frames, lambda scene: reset.append(scene.name)
baking._on_finished(SimpleNamespace(folder=Path(layers), state="failed"))
baking.forget_composited_frames = forget
facts["frames are forgotten"] = [forgotten, reset == [scene.name]]

# ---- a row is touched -----------------------------------------------------------------------------------
scene = shot(["lamp", "second"])
scene.camera.rotation_euler = (math.pi / 2, 0, 0)
for x, name in enumerate(("lamp", "second")):
    scene.objects[name].location = (x, 8, 0.5)
bpy.context.view_layer.update()
highlight, state = part("flare_addon.highlight"), scene.fit_flare
facts["nothing touched"] = highlight.current_highlight(scene)
state.lights[1].elements[0].mute = True
state.lights[1].element = 0
chosen, edits = highlight.current_highlight(scene), looks.edits_of(state)
elements = {item.name: [entry.name for entry in item.elements] for item in state.lights}


def light_of(edits):
    """The drawn light of each flare, and of the touched element within its own."""
    gaussians = looks.evaluate_flares(scene, bpy.context.evaluated_depsgraph_get(), scene.camera, edits)
    return {name: float((each.opacities[:, None] * each.colours).sum()) for name, each in gaussians.items()}


plain, dimmed, by_itself = (light_of(each) for each in (
    edits, highlight.emphasise(edits, chosen, elements), highlight.isolate(chosen, edits)))
names = list(elements)
facts["touched"] = [chosen.flare == names[1], dimmed[names[0]] / plain[names[0]],
                    dimmed[names[1]] / (by_itself[names[1]] + highlight.DIMMED * plain[names[1]]), list(by_itself)]
facts["sliders stay"] = looks.edits_of(state) == edits
parts = looks.evaluate_flares(scene, bpy.context.evaluated_depsgraph_get(), scene.camera,
                              highlight.isolate(chosen, edits))[names[1]]
left, top, right, bottom = highlight.outline_box(parts, parts.means, parts.covariances)
facts["outlined"] = [left < float(parts.means[:, 0].mean()) < right, top < float(parts.means[:, 1].mean()) < bottom]
# ---- an element is picked -------------------------------------------------------------------------------
picking, core_look = part("flare_addon.operators.pick_element"), part("core.look")
state.lights[1].elements[0].mute = False
state.lights[0].mute = False
width, height = 192, 108
intrinsics = np.array([[160.0, 0, 96], [0, 160.0, 54], [0, 0, 1]])
depsgraph = bpy.context.evaluated_depsgraph_get()
pictures = {}
for item in state.lights:
    for entry in item.elements:
        element = highlight.Highlight(scene.name, item.name, entry.name, 0.0)
        by_itself = highlight.isolate(element, looks.edits_of(state))
        flares = looks.evaluate_flares(scene, depsgraph, scene.camera, by_itself)
        pictures[item.name, entry.name] = core_look.draw(flares.values(), intrinsics, width, height).sum(-1)
picked = []
for name, picture in pictures.items():
    others = np.max([other for key, other in pictures.items() if key != name], axis=0)
    y, x = np.unravel_index(np.argmax(picture - others), picture.shape)
    if (picture - others)[y, x] > 0.1 * picture[y, x]:
        state.lights[0].show_elements = state.lights[1].show_elements = False
        is_picked = picking.choose_element(scene, depsgraph, scene.camera, intrinsics, (x + 0.5, y + 0.5))
        item = state.lights[state.light]
        shown = highlight.current_highlight(scene)
        picked.append(is_picked and item.show_elements
                      and (item.name, item.elements[item.element].name) == name == (shown.flare, shown.element))
facts["picked"] = picked
before = state.light, state.lights[state.light].element
facts["picked in the dark"] = [picking.choose_element(scene, depsgraph, scene.camera, intrinsics, (1e7, 0)),
                               before == (state.light, state.lights[state.light].element)]
unplaced = state.lights.add()
unplaced.name, unplaced.source = state.lights[0].name, "of another look"
at_first = next(name for name in pictures if name[0] == unplaced.name)
y, x = np.unravel_index(np.argmax(pictures[at_first]), pictures[at_first].shape)
facts["picked beside an unplaced namesake"] = [
    picking.choose_element(scene, depsgraph, scene.camera, intrinsics, (x + 0.5, y + 0.5)), state.light < 2]
looks.remove_flare(scene, 2)


def place_on_screen(kind, x, y, width, height):
    return SimpleNamespace(type=kind, x=x, y=y, width=width, height=height)


def view(perspective, *regions):
    return SimpleNamespace(type="VIEW_3D", regions=regions, spaces=SimpleNamespace(
        active=SimpleNamespace(region_3d=SimpleNamespace(view_perspective=perspective))))


main = place_on_screen("WINDOW", 0, 0, 800, 600)
screen = SimpleNamespace(areas=[SimpleNamespace(type="OUTLINER"),
                                view("PERSP", place_on_screen("WINDOW", 800, 0, 90, 90)),
                                view("CAMERA", main, place_on_screen("UI", 600, 0, 200, 600))])
facts["view at a place"] = [found is not None and found[1] is main for found in (
    picking.view_at(screen, 100, 100), picking.view_at(screen, 700, 100), picking.view_at(screen, 850, 50),
    picking.view_at(screen, 100, 601))]
facts["picking without a window"] = refusal(lambda: ops.pick_element("INVOKE_DEFAULT"))
window_calls = MagicMock()
event = SimpleNamespace(type="ESC", value="PRESS", mouse_x=0, mouse_y=0)
operator = picking.FITFLARE_OT_pick_element
waiting = SimpleNamespace(cancel=lambda context: operator.cancel(None, context), report=MagicMock())
facts["picking ends"] = [sorted(operator.modal(waiting, window_calls, SimpleNamespace(**{**vars(event), **change})))
                         for change in ({"type": "MIDDLEMOUSE"}, {"type": "A"}, {"type": "LEFTMOUSE"}, {})]
facts["picking leaves"] = [call[0] for call in window_calls.mock_calls if "cursor" in call[0] or "status" in call[0]]

# ---- panels of other editors ------------------------------------------------------------------------
editors = part("flare_addon.editor_panels")
scene = shot(["lamp"])


def drawn(name, space):
    """Return the operators that a panel draws beside a scene with a flare; [] where the panel is not shown."""
    cls, layout = getattr(editors, f"FITFLARE_PT_{name}"), MagicMock()
    context = SimpleNamespace(scene=scene, space_data=space)
    if not cls.poll(context):
        return []
    panel = SimpleNamespace(layout=layout)
    panel._draw_compositor = lambda *words: cls._draw_compositor(panel, *words)
    cls.draw(panel, context)
    return [call.args[0] for call in layout.mock_calls if call[0].endswith("operator")]


nodes = SimpleNamespace(type="NODE_EDITOR", tree_type="CompositorNodeTree")
pictures = SimpleNamespace(type="IMAGE_EDITOR", image=SimpleNamespace(source="FILE", filepath="//photo.png"))
facts["other editors"] = ["fit_flare.reset_look" in drawn("node_look", nodes), "fit_flare.bake" in drawn(
    "node_bake", nodes), drawn("node_look", SimpleNamespace(tree_type="ShaderNodeTree")),
    "fit_flare.reset_look" in drawn("image_look", pictures), "fit_flare.bake" in drawn("image_bake", pictures),
    drawn("image_picture", pictures), drawn("image_picture", SimpleNamespace(image=None))]
scene.fit_flare.flare = ""
facts["other editors without a flare"] = [drawn("image_look", pictures), drawn("image_bake", pictures)]

# ---- a viewport render ------------------------------------------------------------------------------
viewport_render, errors = part("flare_addon.viewport_render"), part("core.errors")
render = scene.render
render.filepath, render.resolution_percentage = str(Path(out) / "view_####"), 50
pixels = np.zeros((4, 8, 4), np.float32)
pixels[..., :3], pixels[0, 0, :3] = 0.2140411, 2.0
scene.render.image_settings.file_format = "PNG"
path = viewport_render.output_path(scene, 7)
viewport_render.save_picture(scene, pixels, path)
image = bpy.data.images.load(str(path))
facts["viewport render"] = [path.name, list(viewport_render.picture_size(scene)), list(image.size),
                            [round(255 * image.pixels[index]) for index in (0, 4, 4 * 31)]]


def set_output(medium, file_format, filepath):
    """Set format and path of the scene's output. medium: since Blender 5.0."""
    if hasattr(render.image_settings, "media_type"):
        render.image_settings.media_type = medium
    render.image_settings.file_format, render.filepath = file_format, str(Path(out) / filepath)


def output_settings():
    names = "media_type", "file_format", "color_mode", "color_depth"
    return [*(getattr(render.image_settings, name, "") for name in names), render.filepath, render.use_file_extension]


saved = []
for medium, file_format, filepath in (("VIDEO", "FFMPEG", "play.mp4"), ("VIDEO", "FFMPEG", "shot_"),
                                      ("MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER", "layers_")):
    set_output(medium, file_format, filepath)
    render.image_settings.color_mode = "BW" if file_format == "FFMPEG" else "RGBA"
    render.use_file_extension = filepath != "shot_"
    before = output_settings()
    path = viewport_render.output_path(scene, 7)
    viewport_render.save_picture(scene, pixels, path)
    image = bpy.data.images.load(str(path))
    saved.append([path.name, image.file_format, list(image.size), output_settings() == before])
facts["viewport render of a video"] = saved
render.use_file_extension = True
menu = MagicMock()
ours_in_menu_view = [function for function in bpy.types.VIEW3D_MT_view._dyn_ui_initialize()
                     if function.__module__.startswith(NAME)]
for function in ours_in_menu_view:
    function(SimpleNamespace(layout=menu), bpy.context)
facts["entries of the menu View"] = [[*call.args, call.kwargs["text"]] for call in menu.operator.call_args_list]
set_output("VIDEO", "FFMPEG", "play.mp4")
camera, scene.camera = scene.camera, None
try:
    viewport_render.check_scene(scene)
except errors.SettingsError as problem:
    facts["viewport render refused"] = [str(problem), refusal(ops.viewport_render)]
scene.camera = camera
renders = part("flare_addon.operators.viewport_render")
kind, largest_view = renders.FITFLARE_OT_viewport_render, renders.largest_view
renders.largest_view = lambda _context: None  # as after the view was closed
reports: list[str] = []
operator = type("Operator", (), {name: getattr(kind, name) for name in (
    "execute", "_prepare_frames", "_render_frames", "_restore_frame", "_report_result")})()
operator.animation, operator.report = True, lambda _kind, text: reports.append(text)
scene.frame_start, scene.frame_end = 1, 3
scene.frame_set(7, subframe=0.5)
status = operator.execute(bpy.context)
renders.largest_view = largest_view
facts["viewport render failed"] = [sorted(status), scene.frame_current, scene.frame_subframe, *reports]
reports.clear()
operator._frame_count = 3
operator._report_result(bpy.context)
facts["viewport render reported"] = reports

leave(facts)
