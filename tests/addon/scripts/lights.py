# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: lights that are disabled, parented, found, moved by a fit. Arguments: the zip, a capture, a .flare of
it, a folder."""
from __future__ import annotations

import contextlib
import json
import shutil
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from start import empty, install, leave, part, refusal

package, capture, flare, out = sys.argv[1], *map(Path, sys.argv[2:5])
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
fits, lights, looks, shots = (part(f"flare_addon.{name}") for name in ("fits", "lights", "looks", "shots"))
depsgraph_of = part("flare_addon.objects").depsgraph_of
read_lights, errors = part("core.capture").read_lights, part("core.errors")
engine_jobs = part("flare_addon.jobs")
facts: dict[str, object] = {}


def linked(name: str, data: object = None) -> object:
    made = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(made)
    return made


def places(frames: list[int]) -> list[list[float]]:
    """Where the only flare's light is in a shot."""
    shot = shots.read_scene_shot(scene, [], frames, flare, None)
    return [np.round(frame.lights[0].xyz, 3).tolist() for frame in shot.frames]


# ---- switched off in the viewport -------------------------------------------------------------------
for how in ("visible", "disabled", "excluded"):
    scene = empty()
    scene.camera = linked("Camera", bpy.data.cameras.new("Camera"))
    car, lamp = linked("Car"), bpy.data.objects.new("Headlamp", None)
    inner = bpy.data.collections.new("Lamps")
    scene.collection.children.link(inner)
    inner.objects.link(lamp)
    lamp.parent, lamp.location = car, (0, 1, 0)
    car.keyframe_insert("location", frame=1)
    car.location.x = 10
    car.keyframe_insert("location", frame=11)
    ops.open_flare(filepath=str(flare))
    scene.fit_flare.lights[0].target = lamp
    lamp.hide_viewport = how == "disabled"
    bpy.context.view_layer.layer_collection.children["Lamps"].exclude = how == "excluded"
    facts[f"on a car, {how}"] = places([1, 11])
    scene.frame_set(11)
    lamp.fit_flare.is_light = True
    lights.write_to_capture(scene, out)
    facts[f"written, {how}"] = read_lights(out / "lights.json")[0].xyz.round(3).tolist()
lamp.keyframe_insert("hide_render", frame=1)
lamp["share"] = 1.0
lamp.driver_add('["share"]').driver.expression = "frame"
facts["blinking"] = places([1, 11])
lamp.keyframe_insert("location", frame=1)
try:
    places([1])
except errors.FitFlareError as problem:
    facts["moved by itself"] = str(problem)

# ---- the whole capture switched off, and the file opened again --------------------------------------
learned = part("core.look").read_look(flare).lights[0].xyz
for how in ("excluded", "disabled"):
    scene = empty()
    ops.import_capture(directory=str(capture), up="-Y", scale=2.0)
    scene.camera = linked("Camera", bpy.data.cameras.new("Camera"))
    layer = bpy.context.view_layer.layer_collection.children[capture.name]
    layer.exclude, layer.collection.hide_viewport = how == "excluded", how == "disabled"
    ops.add_light(name="added")
    bpy.ops.wm.save_as_mainfile(filepath=str(out / "off.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(out / "off.blend"))
    scene = bpy.context.scene
    ops.open_flare(filepath=str(flare))
    lights.write_to_capture(scene, out)
    placed = looks.place_lights(scene, depsgraph_of(scene), scene.camera)[1][0]
    written = {light.name: light.xyz.round(3).tolist() for light in read_lights(out / "lights.json")}
    facts[f"capture {how}"] = [written["lamp"], learned.round(3).tolist(), written["added"],
                               placed.xyz.round(3).tolist(), scene.fit_flare.native]

# ---- parented where it stood ------------------------------------------------------------------------
scene = empty()
ops.import_capture(directory=str(capture), up="-Y", scale=2.0)
root, bulb = scene.fit_flare.root, linked("Bulb")
bulb.location = (1, 2, 3)
bpy.context.view_layer.update()
bulb.parent, bulb.matrix_parent_inverse = root, root.matrix_world.inverted()
lights.mark_as_lights([bulb], {"lamp"})
bpy.context.view_layer.update()
before = bulb.matrix_world.translation.copy()
lights.write_to_capture(scene, capture)
written = {light.name: light.xyz for light in read_lights(capture / "lights.json")}
lights.move_to_fit(scene, {lights.light_name(bulb): written[lights.light_name(bulb)] + 1}, capture)
lights.move_to_fit(scene, written, capture)
moved = (bulb.matrix_world.translation - before).length
lights._move_to(bulb, written[lights.light_name(bulb)])
bpy.context.view_layer.update()
facts["parented, brought back"] = [moved > 0.1, (bulb.matrix_world.translation - before).length < 1e-4,
                                   bool(np.allclose(before, (1, 2, 3), atol=1e-4))]

# ---- an empty of one's own ---------------------------------------------------------------------------
ops.remove_light(object="Bulb")
ops.add_light(name="made")
ops.remove_light(object="made")
facts["left by X"] = ["Bulb" in scene.objects, "made" in bpy.data.objects]

# ---- lamps that are not rendered --------------------------------------------------------------------
scene = empty()
for name in ("On", "Off", "Excluded"):
    group = bpy.data.collections.new(name)
    scene.collection.children.link(group)
    group.objects.link(bpy.data.objects.new(f"Lamp {name}", bpy.data.lights.new(name, "POINT")))
bpy.data.collections["Off"].hide_render = True
bpy.context.view_layer.layer_collection.children["Excluded"].exclude = True
facts["lamps"] = [thing.name for thing in part("flare_addon.capture.blend_shot")._light_objects(scene, ())]

# ---- an empty as the camera, and another file -------------------------------------------------------
ops.open_flare(filepath=str(flare))
scene.fit_flare.lights[0].target = scene.objects["Lamp On"]
scene.camera = linked("No Camera")
facts["no camera"] = ops.pick_light.poll()
try:
    shots.read_scene_shot(scene, [], [1], flare, None)
except errors.FitFlareError as problem:
    facts["an empty"] = str(problem)
overlay, points = part("flare_addon.overlay"), part("flare_addon.points")
overlay.last_error, points._clouds["Points", 3] = "That is wrong.", None
empty()
facts["another file"] = [overlay.last_error, len(points._clouds)]

# ---- lamps of a linked asset ------------------------------------------------------------------------
scene = empty()
asset = bpy.data.collections.new("Asset")
scene.collection.children.link(asset)
asset.objects.link(bpy.data.objects.new("Streetlamp", None))
bpy.ops.wm.save_as_mainfile(filepath=str(out / "asset.blend"))
facts["linked"] = {}
for how in ("linked", "overridden"):
    scene = empty()
    with bpy.data.libraries.load(str(out / "asset.blend"), link=True) as (_, wanted):
        wanted.collections = ["Asset"]
    scene.collection.children.link(wanted.collections[0])
    if how == "overridden":
        wanted.collections[0].override_hierarchy_create(scene, bpy.context.view_layer)
    bpy.context.view_layer.update()
    for thing in scene.objects:
        thing.select_set((thing.override_library is not None) == (how == "overridden"))
    possible = ops.lights_from_selected.poll()
    if possible:
        ops.lights_from_selected()
    bpy.ops.wm.save_as_mainfile(filepath=str(out / f"{how}.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(out / f"{how}.blend"))
    facts["linked"][how] = [possible, [lights.light_name(item) for item in lights.scene_lights(bpy.context.scene)]]

# ---- a click in the picture -------------------------------------------------------------------------
bpy.context.scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
library = part("flare_addon.operators.library")
frame_in, library.overlay.camera_frame = overlay.camera_frame, lambda *_words: overlay.CameraFrame(100, 50, 200, 100)
view, panel = (SimpleNamespace(type=kind, x=left, y=0, width=width, height=300)
               for kind, left, width in (("WINDOW", 10, 500), ("UI", 260, 250)))
area = SimpleNamespace(as_pointer=lambda: 7, regions=[view, panel],
                       spaces=SimpleNamespace(active=SimpleNamespace(type="VIEW_3D", region_3d=None)))
left: list[object] = []
context = SimpleNamespace(screen=SimpleNamespace(areas=[area]), scene=bpy.context.scene,
                          temp_override=lambda **_words: contextlib.nullcontext(),
                          window=SimpleNamespace(cursor_modal_restore=lambda: left.append("cursor")),
                          workspace=SimpleNamespace(status_text_set=left.append))
facts["clicks"] = {}
for how, x, y in (("beside the picture", 50, 100), ("below the view", 150, -5), ("on the panel", 300, 100),
                  ("on the light", 160, 75), ("the camera is gone", 160, 75), ("the view is gone", 160, 75)):
    kind = library.FITFLARE_OT_pick_light
    operator = SimpleNamespace(_area=7, view="", execute=lambda _context: {"FINISHED"},
                               why_not=lambda _context, how=how: "No" if how == "the camera is gone" else "")
    operator._store_position, operator.cancel = partial(kind._store_position, operator), partial(kind.cancel, operator)
    if how == "the view is gone":
        context.screen.areas.clear()
    left.clear()
    result = kind.modal(operator, context, SimpleNamespace(type="LEFTMOUSE", value="PRESS", mouse_x=x, mouse_y=y))
    facts["clicks"][how] = [list(result), left == ["cursor", None]]
    if how == "on the light":
        facts["clicked"] = [operator.x, operator.y]
overlay.camera_frame = frame_in

# ---- a fit that has ended while the .blend was closed -----------------------------------------------
run = out / "run"
run.mkdir()
shutil.copy(flare, run / fits.FLARE)
(run / "config.toml").write_text("")
(run / "capture.txt").write_text(f"{capture}\n")
for how in ("open", "closed"):
    scene = empty()
    ops.import_capture(directory=str(capture))
    lamp = scene.objects["lamp"]
    lamp.location = [learned[0] + 0.5, *learned[1:]]
    bpy.context.view_layer.update()
    lights.write_to_capture(scene, capture)
    scene.fit_flare.run = str(run)
    if how == "open":
        job = engine_jobs.Job("fit", run, engine_jobs.Origin(0))
        job.state = "done"
        fits.on_fit_finished(job)
    else:
        assert ops.use_result() == {"FINISHED"}
    place = lights.capture_position(lamp, scene.fit_flare.root, depsgraph_of(scene))
    facts[f"fitted, {how}"] = [bool(np.allclose(place, learned, atol=1e-4)), scene.fit_flare.native]

# ---- lights that were found while the .blend was closed ---------------------------------------------
path = capture / "lights.json"
content = json.loads(path.read_text())
path.write_text(json.dumps({"lights": [*content["lights"], {"name": "found", "xyz": [1, 2, 3], "score": 0.5}]}))
facts["found"] = lights.new_light_names(scene, capture)
lights.write_to_capture(scene, capture)
facts["kept"] = [entry for entry in json.loads(path.read_text())["lights"] if entry["name"] == "found"]
ops.use_lights()
facts["used"] = [[lights.light_name(item) for item in lights.scene_lights(scene)],
                 lights.new_light_names(scene, capture)]
ops.remove_light(object="found")
lights.write_to_capture(scene, capture)
facts["taken out"] = [[light.name for light in read_lights(path)], lights.new_light_names(scene, capture)]
lamp = scene.objects["lamp"]
lights.write_to_capture(scene, capture)
lights.remember_names(scene)
lamp.location.x += 0.5  # while they are looked for
lamp.fit_flare.light = "desk lamp"
bpy.context.view_layer.update()
stood = lamp.matrix_world.translation.copy()
path.write_text(json.dumps({"lights": [*json.loads(path.read_text())["lights"], {"name": "more", "xyz": [1, 2, 3]}]}))
job = engine_jobs.Job("lights", capture / "lights", engine_jobs.Origin(0))
job.state = "done"
fits.on_lights_found(job)
bpy.context.view_layer.update()
facts["found meanwhile"] = [[lights.light_name(item) for item in lights.scene_lights(scene)],
                            (lamp.matrix_world.translation - stood).length, job.error]
for item in lights.scene_lights(scene):
    bpy.data.objects.remove(item)
fits.on_lights_found(job)
facts["found with none left"] = [lights.light_name(item) for item in lights.scene_lights(scene)]
scene.fit_flare.property_unset("known_lights")
path.write_text(json.dumps({"lights": [*content["lights"], {"name": "found", "xyz": [1, 2, 3]}]}))
lights.write_to_capture(scene, capture)
facts["of the version before"] = [light.name for light in read_lights(path)]

# ---- other scenes with the capture: linked from a file, and made of this one's settings -----------------
only = [entry for entry in content["lights"] if entry["name"] == "lamp"]
path.write_text(json.dumps({"lights": only}))
for name in ("Linked", "First"):
    scene = empty()
    scene.name = name
    ops.import_capture(directory=str(capture))
    bpy.ops.wm.save_as_mainfile(filepath=str(out / f"{name}.blend"))
with bpy.data.libraries.load(str(out / "Linked.blend"), link=True) as (_, wanted):
    wanted.scenes = ["Linked"]
root = wanted.scenes[0].fit_flare.root
bpy.ops.scene.new(type="EMPTY")
bpy.context.scene.name = "Second"
facts["added in the second"] = refusal(lambda: ops.add_light(name="own"))
path.write_text(json.dumps({"lights": [*only, {"name": "later", "xyz": [1, 2, 3]}]}))
job = engine_jobs.Job("lights", capture / "lights", engine_jobs.Origin(0))
job.state = "done"
fits.on_lights_found(job)
facts["of each scene"] = {one.name: [lights.light_name(item) for item in lights.scene_lights(one)]
                          for one in bpy.data.scenes}
bpy.ops.scene.new(type="NEW")
scene = bpy.context.scene
scene.collection.children.link(root.users_collection[0])
scene.fit_flare.root = root
facts["beside a linked root"] = [refusal(lambda: ops.add_light(name="own")), "own" in map(
    lights.light_name, lights.scene_lights(scene))]
leave(facts)
