# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: lamps drive their flares, in the camera view, in bakes and in transfers. Arguments: the zip, a .flare
with one light, a folder to write."""
from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from quads import drawn_levels
from start import install, leave, object_in, part, scene_with, select

package, flare = sys.argv[1:3]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
looks, panels, shots, lamp_drive, core_look = (
    part(name) for name in ("flare_addon.looks", "flare_addon.panels", "flare_addon.shots", "flare_addon.lamp_drive",
                            "core.look"))
facts: dict[str, object] = {}


def brightness(scene):
    """The sum of the flare over a small picture, as numpy draws it."""
    gaussians = looks.evaluate_flares(scene, bpy.context.evaluated_depsgraph_get(), scene.camera)
    k = np.array([[48.0, 0, 24], [0, 48.0, 13.5], [0, 0, 1]])
    return float(core_look.draw(gaussians.values(), k, 48, 27).sum())


# ---- lamps drive their flares ---------------------------------------------------------------------------
def placed_light(scene):
    """The first light, as a shot has it."""
    bpy.context.view_layer.update()
    return looks.place_lights(scene, bpy.context.evaluated_depsgraph_get(), scene.camera)[1][0]


def factor(scene, frame=None):
    """The factor of the first flare, as a shot has it."""
    if frame is not None:
        scene.frame_set(frame)
    return [round(value, 4) for value in placed_light(scene).factor]


scene, (lamp,) = scene_with((0.5, 8, 0.4))
lamp.data.energy, scene.frame_end = 100, 9
select(scene, lamp)
ops.apply_flare(filepath=flare)
item = scene.fit_flare.lights[0]
bright = brightness(scene)
lamp.data.energy, lamp.data.color = 50, (1, 0.5, 1)
facts["dimmed by hand"] = factor(scene)
lamp.data.color = (1, 1, 1)
bpy.context.view_layer.update()
facts["half as bright"] = brightness(scene) / bright
item.follow_power = False
facts["not following"] = factor(scene)
item.follow_power = True
for frame, energy in ((1, 20), (9, 60)):
    lamp.data.energy = energy
    lamp.data.keyframe_insert("energy", frame=frame)
facts["keyed"] = [factor(scene, 1), factor(scene, 9)]
shot = shots.read_scene_shot(scene, [], [1, 9], Path(flare), None)
facts["keyed, in a bake"] = [round(frame.lights[0].factor[0], 4) for frame in shot.frames]
lamp.data.animation_data_clear()
driver = lamp.data.driver_add("energy").driver
driver.type, driver.expression = "SCRIPTED", "10 * frame"
scene.frame_set(4)
ops.apply_flare(filepath=flare)
scene.fit_flare.lights[0].target = lamp
lamp_drive.measure_references(scene, scene.fit_flare.lights[0])
facts["driven"] = [scene.frame_current, factor(scene, 1), factor(scene, 4)]
lamp.data.driver_remove("energy")
blend_shot = part("flare_addon.capture.blend_shot")
for frame, energy in ((1, 20), (9, 60)):
    lamp.data.energy = energy
    lamp.data.keyframe_insert("energy", frame=frame)
read = blend_shot.read_shot(scene, Path(flare), [], [1, 9])
facts["keyed, in a transfer"] = [round(frame.lights[0].factor[1], 4) for frame in read.frames]

# ---- lamps switch their flares --------------------------------------------------------------------------
SWITCHES = ("follow_power", "follow_visibility", "follow_direction", "follow_distance")


def baked(scene, numbers):
    """Return the sum of the flare in each of these frames, computed as a bake of the scene does."""
    look, sums = looks.look_of(scene), []
    k = np.array([[48.0, 0, 24], [0, 48.0, 13.5], [0, 0, 1]])
    for frame in shots.read_scene_shot(scene, [], numbers, look.path, None).frames:
        gaussians = look.evaluate_lights(frame.camera.world_to_camera, frame.lights, looks.edits_of(scene.fit_flare),
                                         looks.query_of(scene.fit_flare))
        sums.append(float(core_look.draw(gaussians.values(), k, 48, 27).sum()) if gaussians else 0.0)
    return sums


def keyed(item, path, *keys):
    """Key a property: (frame, value), ..."""
    for frame, value in keys:
        setattr(item, path, value)
        item.keyframe_insert(path, frame=frame)


def over(scene, numbers):
    """Return two lists, from the camera view and from a bake: the sum of the flare in each frame, relative to the
    first."""
    seen = []
    for number in numbers:
        scene.frame_set(number)
        seen.append(brightness(scene))
    scene.frame_set(numbers[0])
    both = [seen, baked(scene, numbers)]
    return [[round(value / max(values[0], 1e-9), 3) for value in values] for values in both]


def lit_scene(place=(0.4, 8, 0.3), kind="POINT"):
    scene, (lamp,) = scene_with(place)
    lamp.data.type, scene.frame_end = kind, 9
    select(scene, lamp)
    ops.apply_flare(filepath=flare)
    return scene, lamp, scene.fit_flare.lights[0]


scene, lamp, item = lit_scene()
facts["switches"] = [[getattr(item, name) for name in SWITCHES], round(item.reference_distance, 3)]
marked = object_in(scene, "Marked", bpy.data.lights.new("Marked", "POINT"), (0, 8, 0))
marked.fit_flare.is_light = True
item.target = marked
facts["switches of a capture"] = [getattr(item, name) for name in SWITCHES]
item.target = lamp
facts["switches again"] = [getattr(item, name) for name in SWITCHES]
for path in ("hide_render", "hide_viewport"):
    scene, lamp, item = lit_scene()
    keyed(lamp, path, (1, False), (5, True), (9, False))
    facts[f"keyed {path}"] = over(scene, [1, 5, 9])
    if path == "hide_render":
        read = blend_shot.read_shot(scene, Path(flare), [], [1, 5, 9])
        facts["hidden, in a transfer"] = [frame.lights[0].factor[0] for frame in read.frames]
        scene.frame_set(5)
        facts["hidden, not followed"] = [brightness(scene) > 0, setattr(item, "follow_visibility", False),
                                         brightness(scene) > 0]
        read = blend_shot.read_shot(scene, Path(flare), [], [1, 5, 9])
        facts["hidden, not followed in a transfer"] = [frame.lights[0].factor[0] for frame in read.frames]
        item.follow_visibility = True
        scene.frame_set(5)
        layout = MagicMock()
        panels.FITFLARE_PT_look.draw(SimpleNamespace(layout=layout), bpy.context)
        facts["hidden, in the panel"] = " ".join(
            str(call.kwargs.get("text", "")) for call in layout.mock_calls if call[0].rpartition(".")[2] == "label")
scene, lamp, item = lit_scene()
lamp.driver_add("hide_render").driver.expression = "frame == 5"
facts["driven hide_render"] = over(scene, [1, 5, 9])
scene, lamp, item = lit_scene()
wall = object_in(scene, "Wall", bpy.data.meshes.new("Wall"), (0, 0, 0))
wall.data.from_pydata([(-9, 6, -9), (9, 6, -9), (9, 6, 9), (-9, 6, 9)], [], [(0, 1, 2, 3)])
lamp.hide_render = True
bpy.context.view_layer.update()
facts["hidden behind a wall"] = placed_light(scene).visibility
lamp.hide_viewport = True
lamp.keyframe_insert("location", frame=1)
bpy.context.view_layer.update()
facts["disabled and animated"] = list(placed_light(scene).factor)
scene, lamp, item = lit_scene()
group = bpy.data.collections.new("Lamps")
scene.collection.children.link(group)
group.objects.link(lamp)
scene.collection.objects.unlink(lamp)
bpy.context.view_layer.update()
in_group = brightness(scene) > 0
group.hide_render = True
facts["in a hidden collection"] = [in_group, brightness(scene) > 0]

scene, lamp, item = lit_scene((0, 8, 0), "SPOT")
lamp.data.spot_size, lamp.data.spot_blend = np.radians(60), 0.0
keyed(lamp, "rotation_euler", (1, (-np.pi / 2, 0, 0)), (2, (-np.pi / 2, 0, np.radians(29))),
      (3, (-np.pi / 2, 0, np.radians(31))))
facts["hard spot"] = over(scene, [1, 2, 3])
read = blend_shot.read_shot(scene, Path(flare), [], [1, 3])
facts["spot, in a transfer"] = [frame.lights[0].factor[0] for frame in read.frames]
scene.frame_set(3)
facts["spot, in the panel"] = lamp_drive.dark_reason(scene, bpy.context.view_layer.depsgraph, item)
operator = MagicMock()
lamp_drive.report_dark(operator, scene)
facts["spot, reported"] = operator.report.call_args.args[1] == facts["spot, in the panel"]
item.follow_direction = False
facts["spot, not followed"] = brightness(scene) > 0
item.follow_direction = True
lamp.animation_data_clear()
lamp.rotation_euler = (-np.pi / 2, 0, np.radians(20))
lamp.data.spot_blend = 1.0
bpy.context.view_layer.update()
share = (np.cos(np.radians(20)) - np.cos(np.radians(30))) / (1 - np.cos(np.radians(30)))
facts["soft spot"] = [factor(scene)[0], round(float(share * share * (3 - 2 * share)), 4)]
keyed(lamp.data, "spot_size", (1, np.radians(60)), (5, np.radians(10)))
facts["keyed cone"] = [factor(scene, 1)[0] > 0.1, factor(scene, 5)[0]]
scene, lamp, item = lit_scene((0, 8, 0), "AREA")
item.extent = "point"
lamp.rotation_euler = (-np.pi / 2, 0, np.pi / 3)
bpy.context.view_layer.update()
facts["area as a point"] = factor(scene)[0]
item.extent = "auto"
sides = []
for scale in ((1, 1, 1), (-1, 1, 1)):
    for turn in (-np.pi / 2, np.pi / 2):
        lamp.scale, lamp.rotation_euler = scale, (turn, 0, 0)
        sides.append(brightness(scene) > 0)
facts["sides of a mirrored lamp"] = sides
lamp.scale, lamp.data.size = (1, 1, 1), 2.0
scene.fit_flare.occlusion = True
wall = object_in(scene, "Wall", bpy.data.meshes.new("Wall"), (0, 0, 0))
wall.data.from_pydata([(0, 4, -9), (9, 4, -9), (9, 4, 9), (0, 4, 9)], [], [(0, 1, 2, 3)])
root = object_in(scene, "Root", None, (0, 0, 0))
scene.fit_flare.root = root
halves = []
for scale in ((1, 1, 1), (-1, 1, 1), (2, 2, -2)):
    root.scale, lamp.rotation_euler = scale, (-np.pi / 2, 0, 0)
    placed = placed_light(scene)
    pose = part("flare_addon.cameras").pose_in_capture(
        scene.camera.matrix_world, root, bpy.context.evaluated_depsgraph_get())
    sampled = placed.extent.sampled(placed.xyz, pose)
    visible = [centre[0] * scale[0] for centre, share in zip(sampled.centres, placed.shares, strict=True) if share > 0]
    halves.append([sampled.emission > 0.9, round(float(np.mean(placed.shares)), 1), bool(max(visible) < 0)])
facts["half a lamp in a mirrored capture"] = halves

scene, lamp, item = lit_scene()
keyed(lamp, "location", (1, (0.4, 8, 0.3)), (9, (0.8, 16, 0.6)))
facts["twice as far"] = over(scene, [1, 9])
read = blend_shot.read_shot(scene, Path(flare), [], [1, 9])
facts["distance, in a transfer"] = [round(frame.lights[0].reference_distance, 3) for frame in read.frames]
item.follow_distance = False
facts["twice as far, not followed"] = over(scene, [1, 9])
scene, lamp, item = lit_scene()
root = object_in(scene, "Root", None, (0, 0, 0))
root.scale, scene.fit_flare.root = (2, 2, 2), root
bpy.context.view_layer.update()
followed, item.follow_distance = brightness(scene), False
facts["in a scaled capture"] = round(followed / brightness(scene), 4)
scene, sun, item = lit_scene((0, 0, 9), "SUN")
facts["a sun has no distance"] = [item.reference_distance, placed_light(scene).reference_distance]


# ---- lamps that are driven later, and other keys of their power -----------------------------------------
overlay, baking = part("flare_addon.overlay"), part("flare_addon.baking")
core_shot = part("core.look.shot")


def red_green(shot):
    """The first light's factors on red and green in each frame of a shot."""
    return [[round(value, 4) for value in frame.lights[0].factor[:2]] for frame in shot.frames]


def factors_by_route(change):
    """Light a scene whose lamp `change` animates after it got its flare; return the factors on red and green in frames
    1 and 9, in a camera view, in a bake and in a transfer, each of a new scene at frame 4."""
    routes = {}
    for route in ("view", "bake", "transfer"):
        scene, lamp, _ = lit_scene()
        scene.fit_flare.lights[0].reference_distance = 5.0
        scene.frame_set(4)
        change(lamp.data)
        if route == "view":
            scene.frame_set(1)
            draw_once(scene)
            routes[route] = [factor(scene, number)[:2] for number in (1, 9)]
        elif route == "bake":
            ops.bake()
            shot = core_shot.Shot.read(shots.layers_folder(scene) / shots.SHOT_FILE)
            routes[route] = [red_green(shot)[0], red_green(shot)[-1]]
        else:
            routes[route] = red_green(blend_shot.read_shot(scene, Path(flare), [], [1, 9]))
        assert scene.fit_flare.lights[0].reference_distance == 5.0, "the artist chose it"
    return routes


def draw_once(scene):
    """Call the handler of a camera view's drawing, then the timer that it started; the drawing itself changes nothing.
    """
    bpy.context.view_layer.update()
    space = SimpleNamespace(overlay=SimpleNamespace(show_overlays=True), shading=SimpleNamespace(type="SOLID"),
                            use_local_camera=False, stereo_3d_camera="LEFT", stereo_3d_eye="LEFT")
    context = SimpleNamespace(scene=scene, space_data=space, window=None, view_layer=bpy.context.view_layer,
                              region_data=SimpleNamespace(view_perspective="CAMERA"))
    before = list(scene.fit_flare.lights[0].reference_light)
    overlay.bpy = SimpleNamespace(context=context, app=bpy.app)
    overlay._draw_in_camera_view(lambda *_words: None)
    overlay.bpy = bpy
    assert list(scene.fit_flare.lights[0].reference_light) == before
    if bpy.app.timers.is_registered(lamp_drive.measure_in_windows):
        bpy.app.timers.unregister(lamp_drive.measure_in_windows)
        changes = part("flare_addon.scene_changes").change_count()
        frame = scene.frame_current
        assert lamp_drive.measure_in_windows() is None and scene.frame_current == frame
        bpy.context.view_layer.update()
        assert part("flare_addon.scene_changes").change_count() > changes, "the view is drawn anew"


def drive(data, path, expression, index=-1):
    driver = data.driver_add(path, index) if index >= 0 else data.driver_add(path)
    driver.driver.type, driver.driver.expression = "SCRIPTED", expression


def key_colour(data):
    keyed(data, "color", (1, (1.0, 0.5, 1.0)), (9, (0.5, 1.0, 1.0)))


def key_and_drive(data):
    key_colour(data)
    drive(data, "energy", "10 * (frame + 1)")


baking._start_process = lambda _folder, _count: None
animations = {"driven power": lambda data: drive(data, "energy", "10 * (frame + 1)"),
              "driven green": lambda data: drive(data, "color", "frame / 9", 1),
              "keyed colour": key_colour, "keyed colour, driven power": key_and_drive}
if "exposure" in bpy.types.Light.bl_rna.properties:
    animations["keyed exposure"] = lambda data: keyed(data, "exposure", (1, 0.0), (9, 2.0))
    animations["driven exposure"] = lambda data: drive(data, "exposure", "(frame - 1) / 4")
facts["animated later"] = {name: factors_by_route(change) for name, change in animations.items()}

scene, lamp, item = lit_scene()
posed = object_in(scene, "Posed", None, (0, 0, 0))
keyed(posed, "location", (1, (0, 0, 0)), (9, (1, 0, 0)))
scene.frame_set(4)
drive(lamp.data, "energy", "10 * (frame + 1)")
posed.location = 7, 8, 9  # and no key yet


def power_notes():
    """The labels about the lamp's power that the panel shows."""
    layout = MagicMock()
    panels.FITFLARE_PT_look.draw(SimpleNamespace(layout=layout), bpy.context)
    text = " ".join(str(call.kwargs.get("text", "")) for call in layout.mock_calls
                    if call[0].rpartition(".")[2] == "label")
    return "reference in frame 1" in text


draw_once(scene)
lamp_drive.measure_in_windows()  # as if the timeline had moved on before the timer
facts["posed by hand"] = [list(posed.location), item.reference_is_driven, power_notes()]
scene.frame_set(1)
draw_once(scene)
facts["posed, first frame"] = [item.reference_is_driven, list(item.reference_light), power_notes()]

# ---- many lamps among walls -----------------------------------------------------------------------------
occlusion = part("flare_addon.occlusion")
scene, lamp, item = lit_scene()
wall = bpy.data.meshes.new("Wall")
wall.from_pydata([(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)], [], [(0, 1, 2, 3)])
collection = bpy.data.collections.new("Walls")
collection.objects.link(bpy.data.objects.new("Part", wall))
walls = object_in(scene, "Instance", None, (-2, 5, 0.3))
walls.instance_type, walls.instance_collection = "COLLECTION", collection
turned = object_in(scene, "Turned", wall, (1.2, 3, 0))
turned.rotation_euler, turned.scale = (0.3, 0.2, 0.8), (0.5, 1, 0.7)
compared = []
for x in np.linspace(-5, 5, 41):
    lamp.location = x, 8, 0.2
    bpy.context.view_layer.update()
    depsgraph, eye = bpy.context.evaluated_depsgraph_get(), scene.camera.matrix_world.translation
    boxes = occlusion.Occluders(depsgraph)
    compared.append([occlusion.visibility(scene, depsgraph, eye, item), boxes.may_hide(eye, lamp.location, 0.2),
                     occlusion.visibility(scene, depsgraph, eye, item, boxes)])
facts["among walls"] = compared

# ---- a camera view that is drawn again ------------------------------------------------------------------
cameras = part("flare_addon.cameras")
scene, lamp, item = lit_scene()
wall = object_in(scene, "Wall", bpy.data.meshes.new("Wall"), (50, 0, 0))
state, rendered = scene.fit_flare, []


def render_levels(gaussians, _window, _look, view):
    view.content = None
    rendered.append(float((gaussians.opacities @ gaussians.colours).sum()))
    return rendered[-1:]


def render_twice():
    """Draw the camera view twice; return how often it was rendered, and whether both drawings are the same."""
    bpy.context.view_layer.update()
    before, camera = len(rendered), scene.camera
    core = cameras.core_camera(camera.data, camera.matrix_world, scene.render)
    window = overlay.drawn_region(overlay.CameraFrame(0, 0, 96, 54), (96, 54), core)
    first, second = (overlay._render_region(bpy.context, scene, camera, window, looks.look_of(scene)) for _ in range(2))
    return [len(rendered) - before, first == second]


overlay.render_levels = render_levels
facts["drawn again"] = {"at first": render_twice(), "unchanged": render_twice()}
for name, owner, attribute, value in (
        ("camera", scene.camera, "location", (0.1, 0, 0)), ("lamp", lamp, "location", (0.4, 8, 0.5)),
        ("power", lamp.data, "energy", 33.0), ("wall", wall, "location", (0, 4, 0)),
        ("lens", scene.camera.data, "lens", 40),
        ("master", state.master, "intensity", 2.0), ("tint", item, "tint", (1, 0.5, 0.2)), ("mute", item, "mute", True),
        ("mute again", item, "mute", False), ("size", scene.render, "resolution_x", 1000),
        ("occlusion", state, "occlusion", False), ("exposure", scene.camera.fit_flare, "exposure", 2.0)):
    setattr(owner, attribute, value)
    facts["drawn again"][name] = render_twice()
overlay.working_space = lambda: 2 * np.eye(3)
facts["drawn again"]["working space"] = render_twice()
state.lights.add().name = "Second"
state.lights[1].source, state.lights[1].target = item.source, lamp
facts["drawn again"]["added"] = render_twice()
before, state.lights[1].source = len(rendered), "none"
facts["drawn again"]["source"] = render_twice()
state.lights[1].source = item.source
render_twice()
looks.remove_flare(scene, 1)
facts["drawn again"]["removed"] = render_twice()
facts["sums of a flare more and less"] = [round(value / rendered[before - 2], 3) for value in rendered[before - 2:]]
scene.frame_set(5)
facts["drawn again"]["frame"] = render_twice()


def renderings(*views):
    """How often drawings of these (region, eye) one after the other render."""
    before, core = len(rendered), cameras.core_camera(scene.camera.data, scene.camera.matrix_world, scene.render)
    window = overlay.drawn_region(overlay.CameraFrame(0, 0, 96, 54), (96, 54), core)
    for number, eye in views:
        region = SimpleNamespace(as_pointer=lambda number=number: number)
        context = SimpleNamespace(view_layer=bpy.context.view_layer, region=region)
        overlay._render_region(context, scene, scene.camera, window, looks.look_of(scene), eye)
    return len(rendered) - before


buffers, freed = part("flare_addon.overlay_buffers"), []
buffers.open_regions = lambda: set(range(1, 6))
facts["in turns"] = {"two regions": renderings(*[(1, ""), (2, "")] * 3),
                     "two eyes": renderings(*[(3, "left"), (3, "right")] * 3)}
buffers.create_offscreen = lambda *key: SimpleNamespace(key=key, free=lambda: freed.append(key))
by_canvas = buffers.BuffersByCanvas()
sizes = [by_canvas.of((number, "")).offscreen(4, 101, 50).key for number in (1, 1, 2, 3, 4, 1, 5)]
facts["buffers"] = {"sizes": list(map(list, set(sizes))), "freed": len(freed)}
remaining = [number for number in range(1, 6) if (number, "") in by_canvas._canvases]
by_canvas.of((1, "")).offscreen(4, 99, 50)
facts["buffers"] |= {"kept": remaining, "another size": len(freed)}
by_canvas.free()
facts["buffers"]["all"] = len(freed)
for number in (0, 1, 2, 3):
    by_canvas.of((number, "")).offscreen(4, 101, 50)
buffers.open_regions = lambda: {2}
count = len(freed)
by_canvas.of((3, ""))  # a region that Blender draws is open, wherever it is
facts["buffers"]["of closed regions"] = [len(freed) - count, [number for number, _ in by_canvas._canvases]]

# ---- the part of a region that the sum is drawn in ------------------------------------------------------
scene, lamp, item = lit_scene()
core = cameras.core_camera(scene.camera.data, scene.camera.matrix_world, scene.render)
window = overlay.drawn_region(overlay.CameraFrame(0, 0, 333, 187), (333, 187), core)
whole = overlay.concatenate(list(looks.evaluate_flares(scene, bpy.context.evaluated_depsgraph_get(), scene.camera)
                                 .values()))
facts["parts"] = []
for shrink, shift in ((1.0, 0.0), (0.1, 0.1), (0.05, -0.1), (0.02, 0.2), (0.1, 9.0)):
    gaussians = replace(whole, means=(shrink * whole.means + shift).astype(np.float32),
                        covariances=(shrink**2 * whole.covariances).astype(np.float32),
                        arcs=(shrink * whole.arcs).astype(np.float32))
    left, bottom, right, top = buffers.part_of_quads(overlay.quads_by_level(gaussians, window, looks.look_of(scene)),
                                                     window)
    picture = drawn_levels(overlay, gaussians, window, looks.look_of(scene)).sum(-1)
    rows = slice(round((1 - top) * 187), round((1 - bottom) * 187))
    inside = float(picture[rows, round(left * 333):round(right * 333)].sum()) if right > left and top > bottom else 0.0
    area = max(right - left, 0) * max(top - bottom, 0)
    facts["parts"].append([round(area, 3), inside, float(picture.sum())])

leave(facts)
