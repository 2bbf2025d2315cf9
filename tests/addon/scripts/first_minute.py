# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: an artist's first minutes with the library, without a capture and without an engine. Arguments: the
zip, a .flare with one light, one with two, a folder to write."""
from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from quads import drawn_levels
from start import empty, install, leave, object_in, part, refusal, scene_with, select

package, flare, two, out = sys.argv[1:5]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
looks, library, panels, core_look = (
    part(name) for name in ("flare_addon.looks", "flare_addon.library", "flare_addon.panels", "core.look"))
facts: dict[str, object] = {}
names = [item[1] for item in library.menu_items()]
path_of = {item[1]: item[0] for item in library.menu_items()}


def rows(scene):
    return [[item.name, item.source, item.target.name if item.target else ""] for item in scene.fit_flare.lights]


def brightness(scene):
    """The sum of the flare over a small picture, as numpy draws it."""
    gaussians = looks.evaluate_flares(scene, bpy.context.evaluated_depsgraph_get(), scene.camera)
    k = np.array([[48.0, 0, 24], [0, 48.0, 13.5], [0, 0, 1]])
    return float(core_look.draw(gaussians.values(), k, 48, 27).sum())


# ---- add flare ------------------------------------------------------------------------------------------
facts["in the box"] = len(names)
scene, (near, far) = scene_with((0.4, 8, 0.3), (3, 8, 1))
facts["added"] = list(ops.add_library_flare())
facts["added rows"] = rows(scene)
facts["is lit"] = brightness(scene) > 0.01
ops.add_library_flare()
ops.add_library_flare()
facts["added again"] = rows(scene)
select(scene, far)
ops.add_library_flare()
facts["added at another"] = rows(scene)

scene, _ = scene_with((0, -8, 0), (60, 8, 0))  # behind the camera, and far outside of the frame
ops.add_library_flare(look=path_of["Anamorphic Blue"])
facts["none in view"] = [rows(scene)[0][2], Path(scene.fit_flare.flare).stem, brightness(scene) > 0.01]

scene, (lamp,) = scene_with((0.5, 8, 0.4))
cube = object_in(scene, "Cube", bpy.data.meshes.new("Cube"), (0, 5, 0))
select(scene, cube)
ops.add_library_flare()
facts["beside a selected mesh"] = rows(scene)
ops.add_library_flare(light="new")
facts["a new one"] = [row[2] for row in rows(scene)]

scene = empty()
ops.add_library_flare()
facts["without a camera"] = [scene.camera is not None, [row[2] for row in rows(scene)], brightness(scene) > 0.01]
layout = MagicMock()
bpy.types.VIEW3D_MT_light_add.draw(SimpleNamespace(layout=layout), bpy.context)
facts["in the menu"] = [function.__name__ for function in bpy.types.VIEW3D_MT_light_add._dyn_ui_initialize()
                        if "fit_flare" in function.__module__]

# ---- another look ---------------------------------------------------------------------------------------
scene, (near, far) = scene_with((0.4, 8, 0.3), (3, 8, 1))
select(scene, near)
ops.apply_flare(filepath=two)
facts["two lights, one lamp"] = rows(scene)
ops.apply_flare(filepath=two)
facts["applied twice"] = rows(scene)
select(scene, near, far)
ops.open_flare(filepath=two)
ops.open_flare(filepath=two)
facts["opened twice"] = rows(scene)
state = scene.fit_flare
state.lights[0].intensity, state.lights[1].rotation, state.master.tint = 0.25, 0.5, (1, 0.5, 0.25)
state.lights[0].elements[0].scale = 2.0
element = state.lights[0].elements[0].name
ops.apply_flare(filepath=flare)
facts["another look"] = [rows(scene), state.lights[0].intensity, round(state.lights[1].rotation, 5),
                         [round(value, 5) for value in state.master.tint]]
cube = object_in(scene, "Cube", bpy.data.meshes.new("Cube"), (0, 5, 0))
select(scene, cube)
ops.apply_flare(filepath=path_of["Clean Prime"], add=False)
ops.apply_flare(filepath=two, add=False)
facts["back again"] = [rows(scene), state.lights[0].intensity, round(state.lights[1].rotation, 5),
                       next(entry.scale for entry in state.lights[0].elements if entry.name == element)]

# ---- the library keeps edits ----------------------------------------------------------------------------
scene, (near, far) = scene_with((0.4, 8, 0.3), (3, 8, 1))
select(scene, near, far)
ops.open_flare(filepath=two)
state = scene.fit_flare
state.master.intensity, state.lights[0].spread, state.lights[1].mute = 2.0, 1.5, True
state.lights[0].elements[0].tint, state.lights[0].elements[-1].mute = (1, 0.5, 0.25), True
state.lights[0].rotation = 0.5
edited = looks.edits_of(state)
lit = brightness(scene)
ops.save_flare(name="Mine")
(saved,) = library.user_files()
scene, (near, far) = scene_with((0.4, 8, 0.3), (3, 8, 1))
select(scene, near, far)
ops.apply_flare(filepath=str(saved))
state = scene.fit_flare
facts["edits"] = [sorted(edited.texts()) == sorted(looks.edits_of(state).texts()), len(edited.texts()),
                  brightness(scene) / lit]
state.master.intensity = 3.0  # chosen by the artist
state.lights[1].mute = False
ops.apply_flare(filepath=str(saved))
facts["chosen"] = [state.master.intensity, state.lights[1].mute, state.lights[0].spread]
ops.apply_flare(filepath=two)
facts["as fitted"] = [state.master.intensity, state.lights[0].spread, state.lights[0].elements[0].tint[1]]
neutral = library.draw_thumbnail(core_look.read_look(two))
facts["thumbnail differs"] = float(np.abs(library.draw_thumbnail(core_look.read_look(saved)) - neutral).max()) > 0.01

# ---- the asset browser ----------------------------------------------------------------------------------
browser = part("flare_addon.asset_browser")
facts["reports drops"] = hasattr(bpy.app.handlers, "blend_import_post")
if facts["reports drops"]:
    before = len(bpy.data.objects)
    facts["not listed by itself"] = browser.library_entry() is None
    ops.list_assets()
    ops.list_assets()
    entries = bpy.context.preferences.filepaths.asset_libraries
    assets = browser.folder() / browser.ASSETS
    with bpy.data.libraries.load(str(assets), assets_only=True) as (inside, _):
        offered = list(inside.objects)
    facts["offered as assets"] = [sorted(offered) == sorted(item[1] for item in library.menu_items()),
                                  sum(entry.name == "Fit Flare" for entry in entries),
                                  len(bpy.data.objects) - before, (browser.folder() / browser.CATALOGS).is_file()]
    scene, _ = scene_with()
    for name in ("Torch", "Torch"):
        bpy.ops.wm.append(directory=f"{assets}/Object/", filename=name)
        browser.add_dropped()
    dropped = scene.objects["Torch"]
    facts["dropped"] = [Path(scene.fit_flare.flare).stem, rows(scene), dropped.asset_data is None]
    ops.unlist_assets()
    facts["taken out"] = browser.library_entry() is None

# ---- bake without an engine -----------------------------------------------------------------------------
def rendered(scene):
    """Render the current frame; return the picture (h, w, 3), scene-linear, row 0 on top."""
    files = {}
    render_settings.render_frames(scene, [scene.frame_current],
                                  lambda _number, suffix: files.setdefault(suffix, Path(out) / f"rendered{suffix}"))
    image = bpy.data.images.load(str(files[".exr"]))
    pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(pixels)
    width, height = image.size
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)[::-1, :, :3]


def small(scene):
    scene.render.resolution_x, scene.render.resolution_y = 64, 36
    scene.render.engine = "BLENDER_WORKBENCH"
    scene.render.film_transparent = True
    scene.render.image_settings.color_mode = "RGB"


def drawn(scene):
    """The flare over the scene's picture, scene-linear, by the definition."""
    gaussians = looks.evaluate_flares(scene, bpy.context.evaluated_depsgraph_get(), scene.camera)
    camera = scene.camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
    core = part("flare_addon.cameras").core_camera(camera.data, camera.matrix_world, scene.render)
    look = looks.look_of(scene)
    return core_look.draw(gaussians.values(), core.intrinsics, 64, 36, look.blend, look.pixel_grid)


render_settings, flare_node, shots, baking, engine = (
    part(f"flare_addon.{name}") for name in ("render_settings", "compositor.flare_node", "shots", "baking", "engine"))
facts["no engine"] = engine.find_engine() is None
scene, (lamp,) = scene_with((0.5, 8, 0.4))
small(scene)
ops.add_library_flare(look=path_of["Anamorphic Blue"])
lamp.keyframe_insert("location", frame=1)
lamp.location.x = -1
lamp.keyframe_insert("location", frame=7)
scene.frame_start, scene.frame_end, scene.frame_step = 1, 7, 3
scene.frame_set(4)
scene.fit_flare.lights[0].scale = 1.5
facts["baked"] = list(ops.bake())
folder = shots.layers_folder(scene)
facts["in the user's folder"] = Path(bpy.utils.user_resource("DATAFILES")) in folder.parents
facts["frames"] = [sorted(path.name for path in folder.glob("*.exr")), scene.frame_current]
facts["set up by itself"] = flare_node.find_node(scene) is not None
job = part("flare_addon.jobs").find_job(folder)
facts["warnings after the bake"] = list(job.warnings)
errors = []
for number in (1, 4):
    scene.frame_set(number)
    exact = drawn(scene)
    errors.append(float(np.abs(rendered(scene) - exact).max() / exact.max()))
    facts["is seen"] = float(exact.max()) > 0.1
facts["first render"] = errors
scene.fit_flare.lights[0].intensity = 0.5
scene.frame_set(1)
exact = drawn(scene)
facts["live"] = float(np.abs(rendered(scene) - exact).max() / exact.max())
written = [path.stat().st_mtime_ns for path in sorted(folder.glob("*.exr"))]
ops.bake()
facts["kept"] = written == [path.stat().st_mtime_ns for path in sorted(folder.glob("*.exr"))]
scene.fit_flare.bake_scene = True
facts["scene of a fit"] = refusal(ops.bake)
scene.fit_flare.bake_scene, scene.fit_flare.bake_composite = False, False
ops.remove_compositor()
ops.bake()
facts["left alone"] = flare_node.find_node(scene) is None
state = scene.fit_flare
state.bake_range, state.bake_first, state.bake_last = "custom", 2, 6
facts["custom frames"] = shots.frames_to_bake(scene)
scene.frame_end, state.bake_composite, state.bake_range = 10, True, "scene"
scene.fit_flare.bake_first, scene.fit_flare.bake_last, state.bake_range = 4, 4, "custom"
ops.bake()
facts["custom frame of a longer scene"] = part("flare_addon.jobs").find_job(folder).warnings
ops.remove_compositor()

# ---- a stack of effects ---------------------------------------------------------------------------------
def effect(scene, name, factor):
    """Add a compositor effect that multiplies the picture by a factor; return it."""
    tree = bpy.data.node_groups.new(name, "CompositorNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Image", in_out=direction, socket_type="NodeSocketColor")
    begin, end, mix = (tree.nodes.new(kind) for kind in ("NodeGroupInput", "NodeGroupOutput", "ShaderNodeMix"))
    mix.data_type, mix.blend_type, mix.inputs["Factor"].default_value = "RGBA", "MULTIPLY", 1.0
    colours = [socket for socket in mix.inputs if socket.type == "RGBA"]
    colours[1].default_value = (factor, factor, factor, 1)
    tree.links.new(begin.outputs[0], colours[0])
    tree.links.new(next(socket for socket in mix.outputs if socket.type == "RGBA"), end.inputs[0])
    made = scene.compositor_effects.new(name=name)
    made.node_group = tree
    return made


facts["has effects"] = part("flare_addon.compositor.trees").HAS_EFFECTS
if facts["has effects"]:
    setup = part("flare_addon.compositor.setup")
    layers_folder = str(folder)
    scene.fit_flare.lights[0].intensity = 1.0
    scene.frame_set(1)
    ops.set_up_baked()
    alone = [effect.name for effect in scene.compositor_effects]
    flare_light = drawn(scene)
    only = float(np.abs(rendered(scene) - flare_light).max() / flare_light.max())
    ops.remove_compositor()
    facts["one effect"] = [alone, only, len(scene.compositor_effects)]
    cube = object_in(scene, "Bright", bpy.data.meshes.new("Bright"), (0, 0, 0))
    cube.data.from_pydata([(-9, 9, -9), (9, 9, -9), (9, 9, 9), (-9, 9, 9)], [], [(0, 1, 2, 3)])
    cube.color = (0.5, 0.5, 0.5, 1)
    scene.display.shading.light, scene.display.shading.color_type = "FLAT", "OBJECT"
    scene.fit_flare.occlusion = False
    under = rendered(scene)
    first, second = effect(scene, "half", 0.5), effect(scene, "double", 2.0)
    first.is_active = True
    ops.set_up_baked()
    stacked = float(np.abs(rendered(scene) - under - flare_light).max() / flare_light.max())
    second.is_active = True
    ops.set_up_baked()  # the flare is there once, whichever effect is active
    again = float(np.abs(rendered(scene) - under - flare_light).max() / flare_light.max())
    part("flare_addon.compositor.trees").effect_of(scene).enable_for_render = False
    operator = MagicMock()
    part("flare_addon.operators.bake").set_up_compositor(operator, scene, layers_folder, keep_image=True, plate=False)
    said = [call.args[1] for call in operator.report.mock_calls if call.args[0] == {"WARNING"}]
    second.enable_for_render = True
    ops.remove_compositor()
    facts["beside others"] = [stacked, again, [item.name for item in scene.compositor_effects],
                              any("effect with the flare is switched off" in text for text in said),
                              float(np.abs(rendered(scene) - under).max())]

# ---- reading a scene in steps ---------------------------------------------------------------------------
reading = shots.ShotReading(scene, [], range(1, 4))
reading.step()
facts["read one"] = [reading.done, reading.total, scene.frame_current]
reading.restore()
facts["restored"] = scene.frame_current
lens, scene.camera = scene.camera, None
try:
    reading.step()
except part("core.errors").FitFlareError as problem:
    facts["camera deleted while it reads"] = str(problem)
scene.camera = lens
def prepare():
    """Begin a bake of the frames 2, 5 and 8 as with a window."""
    scene.frame_set(4)
    baking._preparation = baking.Preparation(shots.ShotReading(scene, [], range(2, 9, 3)), False, folder)
    baking._last_error, baking._last_scene = "", scene.name


started, start_process, turns = [], baking._start_process, part("flare_addon.turns")
turn_s, turns.TURN_S = turns.TURN_S, 0.0
baking._start_process = lambda _folder, count: started.append(count)
prepare()
shot_before = (folder / shots.SHOT_FILE).read_text()
calls = [[baking._read_scene(), baking.preparation().reading.done, scene.frame_current] for _ in range(3)]
facts["a frame in each call"] = [calls, baking.INTERVAL_S, baking.preparation().fraction_done]
facts["cancelled"] = [list(ops.cancel_bake()), scene.frame_current, baking.preparation() is None,
                      baking.last_error(scene), baking._read_scene(), len(started)]
prepare()
for _ in range(4):
    baking._read_scene()
scene.frame_set(6)  # by the artist, after the frames are read
part("core.look.shot").FRAMES_PER_STEP, frames_per_step = 1, part("core.look.shot").FRAMES_PER_STEP
baking._read_scene()
writing = [path.name for path in folder.iterdir() if "partial" in path.name]
ops.cancel_bake()
part("core.look.shot").FRAMES_PER_STEP = frames_per_step
facts["cancelled while the shot is written"] = [
    scene.frame_current, len(started), (folder / shots.SHOT_FILE).read_text() == shot_before, len(writing),
    [path.name for path in folder.iterdir() if "partial" in path.name]]
prepare()
ends = 0
while baking._read_scene() is not None:
    ends += 1
facts["read to the end"] = [ends < 20, scene.frame_current, baking.last_error(scene), started,
                            (folder / shots.SHOT_FILE).read_text() != shot_before]
prepare()
baking._read_scene()
lens, scene.camera = scene.camera, None
facts["camera deleted between calls"] = [baking._read_scene(), baking.preparation() is None, scene.frame_current,
                                         "was deleted while" in baking.last_error(scene)]
scene.camera, baking._start_process, turns.TURN_S = lens, start_process, turn_s
baking._preparation = baking.Preparation(reading, False, folder)
during = refusal(ops.bake)
bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
facts["another file is opened"] = [during, baking.preparation() is None]

# ---- lights that are areas ------------------------------------------------------------------------------
scene, (lamp,) = scene_with((0, 8, 0))
lamp.data.type, lamp.data.shape = "AREA", "RECTANGLE"
lamp.data.size, lamp.data.size_y = 2.0, 1.0
lamp.rotation_euler = (-np.pi / 2, 0, 0)  # its -Z looks at the camera
select(scene, lamp)
ops.apply_flare(filepath=flare)
item = scene.fit_flare.lights[0]
wall = object_in(scene, "Wall", bpy.data.meshes.new("Wall"), (0, 0, 0))
wall.data.from_pydata([(-9, 6, -9), (0, 6, -9), (0, 6, 9), (-9, 6, 9)], [], [(0, 1, 2, 3)])
bpy.context.view_layer.update()


def placed():
    bpy.context.view_layer.update()
    _, (light,) = looks.place_lights(scene, bpy.context.evaluated_depsgraph_get(), scene.camera)
    return light


half = placed()
core_light = half.extent.sampled(half.xyz, np.linalg.inv(
    part("flare_addon.cameras").camera_to_world(scene.camera.matrix_world)))
facts["area"] = [half.extent.shape, np.ptp(core_light.points, axis=0).round(1).tolist(), float(core_light.emission),
                 round(float(np.mean(half.shares)), 2)]
hidden = brightness(scene)
wall.hide_render = True
whole = brightness(scene)
facts["half hidden"] = round(hidden / whole, 2)

def codes(light):
    """Display codes of scene-linear light over a dark grey."""
    light = np.clip(light + 0.05, 0, 1)
    return 255 * np.where(light > 0.0031308, 1.055 * light ** (1 / 2.4) - 0.055, 12.92 * light)


small(scene)
fence = object_in(scene, "Fence", bpy.data.meshes.new("Fence"), (0, 5, 0))
fence.data.from_pydata([(0.4 * plank + x, 0, z) for plank in range(-6, 7) for x, z in ((0, -2), (0.2, -2), (0.2, 2),
                                                                                       (0, 2))],
                       [], [tuple(range(4 * plank, 4 * plank + 4)) for plank in range(13)])
for number, x in ((1, 0.0), (3, 0.2)):
    fence.location.x = x
    fence.keyframe_insert("location", frame=number)
scene.frame_start, scene.frame_end = 1, 3
ops.bake()
overlay, cameras = part("flare_addon.overlay"), part("flare_addon.cameras")


def camera_view(scene):
    """The flare as the overlay draws it."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    camera = scene.camera.evaluated_get(depsgraph)
    window = overlay.drawn_region(overlay.CameraFrame(0, 0, 64, 36), (64, 36), cameras.core_camera(
        camera.data, camera.matrix_world, scene.render))
    gaussians = overlay.concatenate(list(looks.evaluate_flares(scene, depsgraph, scene.camera).values()))
    return drawn_levels(overlay, gaussians, window, looks.look_of(scene))


fenced = []
for number in (1, 2, 3):
    scene.frame_set(number)
    with_flare, item.intensity = rendered(scene), 0.0
    baked, item.intensity = with_flare - rendered(scene), 1.0
    visible = camera_view(scene)
    fenced.append([float(np.abs(codes(visible) - codes(baked)).max()), float(baked.sum() / visible.sum()),
                   float(codes(baked).max()), brightness(scene) / whole])
item.extent = "point"
bpy.context.view_layer.update()
facts["a point"] = float(np.abs(codes(camera_view(scene)) - codes(drawn(scene))).max())
item.extent = "auto"
facts["behind a fence"] = fenced
ops.remove_compositor()
bpy.data.objects.remove(fence)
lamp.rotation_euler = (np.pi / 2, 0, 0)
bpy.context.view_layer.update()
facts["from behind"] = brightness(scene)
lamp.rotation_euler = (-np.pi / 2, 0, 0)
item.extent = "point"
facts["as a point"] = placed().extent is None
item.extent = "shape"
lamp.data.type, lamp.data.shadow_soft_size = "POINT", 0.5
facts["as a sphere"] = [placed().extent.shape, placed().extent.radius]
sign = object_in(scene, "Sign", bpy.data.meshes.new("Sign"), (0, 8, 0))
sign.data.from_pydata([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], [], [(0, 1, 2, 3)])
item.target, sign.scale = sign, (2, 1, 0.5)
bpy.context.view_layer.update()
facts["as a mesh"] = [placed().extent.shape, np.ptp(placed().extent.points, axis=0).round(0).tolist()]
item.target = object_in(scene, "Nothing", bpy.data.meshes.new("Nothing"), (0, 8, 0))
bpy.context.view_layer.update()
try:
    placed()
except part("core.errors").FitFlareError as problem:
    facts["an area of nothing"] = str(problem)

# ---- a single picture -----------------------------------------------------------------------------------
photo = bpy.data.images.new("photo", 64, 36, float_buffer=False)
photo.filepath_raw, photo.file_format = str(Path(out) / "photo.png"), "PNG"
photo.pixels.foreach_set(np.tile(np.float32([0.25, 0.5, 0.75, 1]), 64 * 36))
photo.save()
bpy.data.images.remove(photo)
scene = empty()
scene.view_settings.view_transform = "AgX"
ops.shot_from_picture(filepath=str(Path(out) / "photo.png"))
facts["picture"] = [scene.frame_start, scene.frame_end, scene.view_settings.view_transform, scene.fit_flare.over,
                    scene.render.resolution_x]
if hasattr(scene.render, "compositor_device"):
    scene.render.compositor_device = "CPU"
plain = rendered(scene)
facts["picture is rendered"] = plain[18, 32].tolist()
ops.remove_compositor()
facts["picture alone removed"] = flare_node.tree_of(scene) is None
ops.shot_from_picture(filepath=str(Path(out) / "photo.png"))
ops.add_library_flare(look=path_of["Vintage Ring"])
ops.bake()
facts["picture with its flare"] = float(np.abs(rendered(scene) - plain - drawn(scene)).max() / drawn(scene).max())
scene.fit_flare.native = False
for x in (0.75, 0.25):
    ops.pick_light(x=x, y=0.5)
bpy.context.view_layer.update()
facts["picked"] = [[item.target.name, item.target.location.x > 0] for item in scene.fit_flare.lights]
ops.remove_compositor()
facts["picture removed"] = flare_node.tree_of(scene) is None

# ---- deleted lamps --------------------------------------------------------------------------------------
scene, lamps = scene_with((0.4, 8, 0.3), (3, 8, 1), (-2, 8, 0), (1, 8, 1))
select(scene, *lamps)
ops.apply_flare(filepath=flare)
state = scene.fit_flare
state.lights[2].intensity = 0.5
for lamp in (lamps[0], lamps[1], lamps[3]):
    scene.collection.objects.unlink(lamp)
layout = MagicMock()
panels.FITFLARE_PT_look.draw(SimpleNamespace(layout=layout), bpy.context)
facts["offered"] = [call.kwargs["text"] for call in layout.mock_calls
                    if call[0] == "operator" and "remove_lost" in call.args[0]]
ops.remove_lost_flares()
facts["left"] = [rows(scene), state.lights[0].intensity]
facts["none is lost"] = refusal(ops.remove_lost_flares)

leave(facts)
