# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: an artist's work, operator by operator. Arguments: the zip, a capture, a .flare of it, a folder."""
from __future__ import annotations

import json
import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from quads import drawn_levels
from start import NAME, empty, install, leave, part, refusal

package, capture, flare, out = sys.argv[1:5]
install(package)
sys.path.remove(str(Path(__file__).parent))
ops = bpy.ops.fit_flare
shots, looks, occlusion, overlay, cameras = (
    part(f"flare_addon.{name}") for name in ("shots", "looks", "occlusion", "overlay", "cameras"))
core_capture, core_look = part("core.capture"), part("core.look")
drawing = part("core.look.drawing")
facts: dict[str, object] = {}
original = core_capture.Capture.open(capture)


def blenders_own(scene, camera, points):
    """Return the pixels (n, 2) of world points (n, 3), by the matrices that Blender itself renders with."""
    render = scene.render
    depsgraph = bpy.context.evaluated_depsgraph_get()
    evaluated = camera.evaluated_get(depsgraph)
    projection = evaluated.calc_matrix_camera(depsgraph, x=render.resolution_x, y=render.resolution_y,
                                              scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y)
    whole = np.array(projection) @ np.linalg.inv(np.array(evaluated.matrix_world.normalized()))
    clip = np.concatenate([points, np.ones((len(points), 1))], 1) @ whole.T
    ndc = clip[:, :2] / clip[:, 3:]
    return np.stack([(ndc[:, 0] + 1) / 2 * render.resolution_x, (1 - ndc[:, 1]) / 2 * render.resolution_y], -1)


# ---- import -----------------------------------------------------------------------------------------
for kind, up, scale in (("animated", "Z", 1.0), ("each", "-Y", 2.5)):
    scene = empty()
    assert ops.import_capture(directory=capture, cameras=kind, up=up, scale=scale) == {"FINISHED"}
    root = scene.fit_flare.root
    bpy.context.view_layer.update()
    to_world = np.array(root.matrix_world)
    cloud = original.points.xyz.astype(np.float64)
    worst = 0.0
    frames = part("core.conventions.frame_numbers").number_views(view.name for view in original.views)
    for frame in frames:
        view = original.view(frame.view)
        scene.frame_set(frame.number)
        camera = scene.camera if kind == "animated" else scene.objects[Path(frame.view).stem]
        expected, depth = view.camera.project(cloud)
        found = blenders_own(scene, camera, cloud @ to_world[:3, :3].T + to_world[:3, 3])
        worst = max(worst, float(np.abs(expected - found)[depth > 0.3].max()))
    facts[f"pixels off, {kind}"] = worst
    fitted = part("flare_addon.capture.importer")
    fitted.set_exposures(root, {view.name: 0.5 + number for number, view in enumerate(original.views)})
    found = []
    for frame in frames:
        scene.frame_set(frame.number)
        camera = scene.camera if kind == "animated" else scene.objects[Path(frame.view).stem]
        found.append(shots.shot_frame(scene, bpy.context.evaluated_depsgraph_get(), camera,
                                      frame.number).camera.exposure)
    facts[f"exposed, {kind}"] = found
    # A run of this capture exposes cameras that are imported later, too; one of another does not.
    fits = part("flare_addon.fits")
    earlier = Path(out) / f"earlier run, {kind}"
    earlier.mkdir()
    (earlier / "exposures.json").write_text('{"0001.png": 4.0}')
    for name, of in (("own", capture), ("other", out)):
        (earlier / "capture.txt").write_text(f"{of}\n")
        fitted.set_exposures(root, {})
        fits.expose_cameras(scene, earlier)
        scene.frame_set(frames[1].number)
        camera = scene.camera if kind == "animated" else scene.objects["0001"]
        facts[f"{name} run, {kind}"] = camera.fit_flare.exposure
    fitted.set_exposures(root, {})
    scene.frame_set(frames[2].number)
    facts[f"as usual, {kind}"] = [camera.fit_flare.exposure, scene.camera.fit_flare.exposure]
    facts[f"objects, {kind}"] = sorted(item.name for item in scene.objects)
    back = scene.camera.data.background_images[0]
    facts[f"background, {kind}"] = [back.image.source, back.frame_method, Path(back.image.filepath).name]
    if kind == "animated":
        facts["sequence"] = [back.image_user.frame_start, back.image_user.frame_offset, back.image_user.frame_duration]
        facts["frames"] = [scene.frame_start, scene.frame_end, scene.render.resolution_x, scene.render.resolution_y]
        mesh = scene.objects["Points"].data
        colour = np.empty(4 * len(mesh.vertices), np.float32)
        mesh.color_attributes["Col"].data.foreach_get("color_srgb", colour)
        facts["colours off"] = float(np.abs(colour.reshape(-1, 4)[:, :3] * 255 - original.points.rgb).max())
        facts["lights"] = {item.name: [round(value, 5) for value in item.location] for item in scene.objects
                           if item.fit_flare.is_light}

# ---- clean frames -----------------------------------------------------------------------------------
fits = part("flare_addon.fits")
facts["cleaned by the network"] = [str(word) for word in fits.cleaning_args(scene, Path("capture"))]
scene.fit_flare.matte = str(Path(out) / "roto")
facts["cleaned by a matte"] = [str(word) for word in fits.cleaning_args(scene, Path("capture"))]
scene.fit_flare.keep_glow = True
facts["cleaned, glow kept"] = [str(word) for word in fits.cleaning_args(scene, Path("capture"))]
given, again = [str(word) for word in fits.cleaning_args(scene, fits.capture_folder(scene))], []
chosen_space, record = part("flare_addon.plate_space"), fits.capture_folder(scene) / "plate_space.json"
facts["spaces offered"] = [chosen_space.search_names(None, None, "log")[:2],
                           "AgX Log" in chosen_space.search_names(None, None, "LOG")]
spaces, run_command = [], fits.engine.run
fits.engine.run = lambda _kind, _folder, words: spaces.append(list(map(str, words)))
for space in ("LogC4", "AgX Log", ""):
    scene.fit_flare.plate_space = space
    fits.start_light_search(scene)
    spaces.append(list(map(str, fits.cleaning_args(scene, Path("capture")))))
facts["spaces passed"] = spaces
fits.engine.run = run_command
record.write_text('{"space": "logc4", "ocio": null}')
chosen_space.show_recorded(scene, record.parent)
facts["space shown"] = scene.fit_flare.plate_space
scene.fit_flare.plate_space = ""
facts["space kept"] = record.exists()
find, start = fits.jobs.find_job, fits.engine.run
fits.engine.run = lambda _kind, _folder, words: again.append(words[-1] == "--overwrite")
for state, words in (("none", None), ("done", given), ("stopped", given), ("stopped", given[:-1])):
    made = None if words is None else SimpleNamespace(state=state, args=words)
    fits.jobs.find_job = lambda _, made=made: made
    fits.start_cleaning(scene)
fits.jobs.find_job, fits.engine.run = find, start
facts["cleaned again"] = again
run = Path(out) / "a run"
run.mkdir()
(run / fits.FLARE).write_bytes(b"")
scene.fit_flare.run = str(run)
facts["cleaned by the fit"] = [str(word) for word in fits.cleaning_args(scene, Path("capture"))]

# ---- a project that was moved, its capture with it --------------------------------------------------
moved, words = Path(out) / "moved" / "capture", []
moved.mkdir(parents=True)
(run / fits.CONFIG).write_text("")
scene.fit_flare.capture, chosen = str(moved), scene.fit_flare.capture
fits.engine.run = lambda _kind, _folder, these: words.append(list(map(str, these)))
(run / "capture.txt").write_text(f"{Path(out) / 'gone' / 'capture'}\n")
fits.resume_fit(scene)
facts["moved"] = [words[-1][1], list(map(str, fits.cleaning_args(scene, moved))), str(moved)]
(run / "capture.txt").write_text(f"{Path(out) / 'gone' / 'another'}\n")
try:
    fits.resume_fit(scene)
except part("core.errors").CaptureError as problem:
    facts["another's"] = str(problem)
for name in ("capture.txt", fits.CONFIG):
    (run / name).unlink()
scene.fit_flare.capture, fits.engine.run = chosen, start

# ---- clean frames that are made again ---------------------------------------------------------------
seen = bpy.data.images.new("clean", 4, 4)
seen.filepath_raw, seen.file_format = str(moved / "removed" / "0001.png"), "PNG"
seen.save()
shown = bpy.data.images.load(seen.filepath_raw)
facts["clean frames"] = [shown.pixels[0]]
seen.pixels.foreach_set(np.ones(64, np.float32))
seen.save()
fits.on_cleaning_finished(SimpleNamespace(folder=moved / "removal", state="done"))
facts["clean frames"].append(shown.pixels[0])

# ---- what a fit goes by -----------------------------------------------------------------------------
facts["goes by"] = []
for which in ("own", "made", "none"):
    scene, goes = empty(), Path(out) / f"frames {which}"
    shutil.copytree(capture, goes, ignore=shutil.ignore_patterns("fits", "removal", "truth"))
    if which == "made":
        names = [path.name for path in (goes / "removed").iterdir()]
        (goes / "removed" / "remove.json").write_text(json.dumps({"plates": dict.fromkeys(names, "by a network")}))
    elif which == "none":
        shutil.rmtree(goes / "removed")
    ops.import_capture(directory=str(goes))
    facts["goes by"].append(scene.fit_flare.mode)
part("flare_addon.panels")._draw_clean_frames(drawn := MagicMock(), scene.fit_flare, goes, "none")
scene.fit_flare.keep_glow = True
part("flare_addon.panels")._draw_clean_frames(glow := MagicMock(), scene.fit_flare, goes, "none")
scene.fit_flare.keep_glow = False
facts["says that a fit knows no matte"] = ["Press Make Clean" in str(one.mock_calls) for one in (drawn, glow)]
scene.fit_flare.mode = "default"
fits.on_cleaning_finished(SimpleNamespace(folder=goes / "removal", state="done"))
facts["goes by"].append(scene.fit_flare.mode)

# ---- one undo step ----------------------------------------------------------------------------------
scene = empty()
bpy.ops.ed.undo_push(message="before")
ops.import_capture(directory=capture)
bpy.ops.ed.undo_push(message="after")
count = len(bpy.data.objects)
bpy.ops.ed.undo()
facts["undo"] = [count, len(bpy.data.objects), bpy.context.scene.fit_flare.capture,
                 part("flare_addon.compositor.trees").tree_of(bpy.context.scene) is None]

# ---- lights -----------------------------------------------------------------------------------------
scene = empty()
ops.import_capture(directory=capture)
lights = part("flare_addon.lights")
scene.cursor.location = (0.5, -0.25, 1.0)
ops.add_light(name="key")
cube = bpy.data.objects.new("Bulb", bpy.data.meshes.new("Bulb"))
scene.collection.objects.link(cube)
for item in scene.objects:
    item.select_set(item == cube)
ops.lights_from_selected()
facts["lights now"] = [lights.light_name(item) for item in lights.scene_lights(scene)]
ops.remove_light(object="Bulb")
facts["bulb stays"] = "Bulb" in scene.objects
lights.write_to_capture(scene, Path(capture))
written = core_capture.read_lights(Path(capture) / "lights.json")
facts["lights.json"] = {light.name: light.xyz.tolist() for light in written}
key, places = scene.objects["key"], {light.name: light.xyz + 1 for light in written}
key.location.x += 0.5
bpy.context.view_layer.update()
lights.move_to_fit(scene, places, Path(capture))
bpy.context.view_layer.update()
depsgraph = part("flare_addon.objects").depsgraph_of(scene)
facts["followed"] = {name: bool(np.allclose(lights.capture_position(item, scene.fit_flare.root, depsgraph),
                                            places[name],
                                            atol=1e-4))
                     for name in places for item in lights.scene_lights(scene) if lights.light_name(item) == name}
lights.move_to_fit(scene, {light.name: light.xyz for light in written}, Path(capture))
bpy.context.view_layer.update()
facts["followed back"] = lights.capture_position(scene.objects["lamp"], scene.fit_flare.root, depsgraph).tolist()
scene.objects["lamp"].location = next(light.xyz for light in written if light.name == "lamp").tolist()
bpy.context.view_layer.update()
ops.remove_light(object="key")
lights.write_to_capture(scene, Path(capture))

# ---- look -------------------------------------------------------------------------------------------
facts["open"] = list(ops.open_flare(filepath=flare))
state = scene.fit_flare
facts["flares"] = [[item.name, item.source, item.target.name, len(item.elements) > 0] for item in state.lights]
facts["native"] = state.native
panels, facts["look says"] = part("flare_addon.panels"), []
(Path(capture) / "removed").mkdir(exist_ok=True)
for state.footage in ("images", "removed"):
    layout = MagicMock()
    panels.FITFLARE_PT_look.draw(SimpleNamespace(layout=layout), bpy.context)
    facts["look says"].append(" ".join(call.kwargs["text"] for call in layout.mock_calls if call[0].endswith(".label")))
state.footage = "images"
item = state.lights[0]
item.intensity = 0.5
item.keyframe_insert("intensity", frame=1)
item.intensity = 1.5
item.keyframe_insert("intensity", frame=3)
scene.frame_set(3)
facts["animated"] = looks.edits_of(state).light_edit(item.name).intensity
driver = state.master.driver_add("scale").driver
driver.type = "SCRIPTED"
driver.expression = "frame / 2"
scene.frame_set(4)
facts["driven"] = looks.edits_of(state).master.scale
state.master.driver_remove("scale")
state.master.scale = 1.0
element = item.elements[0]
element.rotation, element.tint = math.radians(30), (1.0, 0.5, 0.25)
words = looks.edits_of(state).texts()
facts["words"] = words
ops.reset_look()
facts["reset"] = looks.edits_of(state).is_neutral or looks.edits_of(state).texts()

# The overlay's quads, drawn by numpy as the GPU draws them, against the definition.
look = looks.look_of(scene)
scene.frame_set(2)
state.occlusion = False
gaussians = overlay.concatenate(list(looks.evaluate_flares(scene, bpy.context.evaluated_depsgraph_get(),
                                                           scene.camera).values()))
evaluated = scene.camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
core = cameras.core_camera(evaluated.data, evaluated.matrix_world, scene.render)


def far_off(picture, expected):
    return float(np.sqrt(((picture - expected) ** 2).sum() / (expected**2).sum()))


whole = overlay.drawn_region(overlay.CameraFrame(0, 0, 3 * core.width, 3 * core.height), (3 * core.width,
                                                                                          3 * core.height), core)
large = core.scaled(3 * core.width, 3 * core.height)
expected = drawing.draw([gaussians], large.intrinsics, *large.size, look.blend, look.pixel_grid)
facts["overlay off"] = far_off(drawn_levels(overlay, gaussians, whole, look), expected)
# Zoomed in, the frame larger than the region and beyond its edges.
cropped = overlay.drawn_region(overlay.CameraFrame(-40, -30, 3 * core.width, 3 * core.height), (100, 80), core)
rows = slice(3 * core.height - 30 - 80, 3 * core.height - 30)  # the frame reaches 10 pixels above the region
facts["cropped off"] = far_off(drawn_levels(overlay, gaussians, cropped, look), expected[rows, 40:140])
facts["outside"] = overlay.drawn_region(overlay.CameraFrame(500, 0, 64, 40), (100, 80), core) is None

# What is shown and what is baked are as bright as the frame was exposed.
scene.camera.fit_flare.exposure = 2.0
brighter = overlay.concatenate(list(looks.evaluate_flares(scene, bpy.context.evaluated_depsgraph_get(),
                                                          scene.camera).values()))
facts["brighter"] = [far_off(brighter.colours, 2 * gaussians.colours), float(np.abs(gaussians.colours).max())]
exposed_shot = shots.read_scene_shot(scene, [scene.camera], [2], Path(flare), None)
exposed_shot.write(Path(out) / "exposed.json")
scene.camera.fit_flare.exposure = 1.0

# ---- a shot, and the same by hand ------------------------------------------------------------------
state.occlusion = True
shot = shots.read_scene_shot(scene, [scene.camera], [1, 3], Path(flare), None)
pose = original.views[1].camera.world_to_camera
facts["pose off"] = float(np.abs(shot.frames[0].camera.world_to_camera - pose).max())
facts["place off"] = float(np.abs(shot.frames[0].lights[0].xyz - original.lights[0].xyz).max())
facts["shares"] = [light.visibility for light in shot.frames[0].lights]
root = state.root
root.rotation_euler, root.scale, root.location = (0.3, 0.2, 0.1), (2, 2, 2), (1, 2, 3)
moved = shots.read_scene_shot(scene, [scene.camera], [1, 3], Path(flare), None)
facts["moved root off"] = float(np.abs(moved.frames[0].camera.world_to_camera - pose).max())
root.rotation_euler, root.scale, root.location = (0, 0, 0), (1, 1, 1), (0, 0, 0)

# ---- cuts by markers --------------------------------------------------------------------------------
bpy.context.view_layer.update()
first, angle = scene.camera, bpy.data.objects.new("Other Angle", bpy.data.cameras.new("Other Angle"))
scene.collection.objects.link(angle)
angle.matrix_world = first.matrix_world
angle.location.x += 3
for frame, camera in ((1, first), (3, angle)):
    scene.timeline_markers.new("cut", frame=frame).camera = camera
cut = shots.read_scene_shot(scene, [], [1, 2, 3], Path(flare), None)
facts["cut"] = [sorted({one.name for one in cut.frames}), *(float(np.abs(one.camera.world_to_camera - np.linalg.inv(
    np.array(angle.matrix_world) @ cameras.FLIP_YZ)).max()) for one in cut.frames)]
scene.timeline_markers.clear()
scene.camera = first
bpy.data.objects.remove(angle)

# ---- occlusion: a wall slides before the light ------------------------------------------------------
scene.frame_set(1)
depsgraph = bpy.context.evaluated_depsgraph_get()
eye = scene.camera.evaluated_get(depsgraph).matrix_world.translation.copy()
light = state.lights[0].target.evaluated_get(depsgraph).matrix_world.translation.copy()
middle = (eye + light) / 2
forward = (light - eye).normalized()
right = forward.orthogonal().normalized()
up = forward.cross(right)
shares = []
for edge in np.linspace(-0.06, 0.06, 13):
    mesh = bpy.data.meshes.new("Wall")
    mesh.from_pydata([middle + right * (edge - 2 * a) + up * b for a, b in ((0, -2), (0, 2), (1, 2), (1, -2))], [],
                     [(0, 1, 2, 3)])
    wall = bpy.data.objects.new("Wall", mesh)
    scene.collection.objects.link(wall)
    bpy.context.view_layer.update()
    shares.append(occlusion.visibility(scene, bpy.context.evaluated_depsgraph_get(), eye, state.lights[0]))
    bpy.data.objects.remove(wall)
facts["fades"] = shares
bpy.context.view_layer.update()

# ---- behind the camera -----------------------------------------------------------------------------
behind = bpy.data.objects.new("Behind", bpy.data.cameras.new("Behind"))
scene.collection.objects.link(behind)
behind.location = light + 0.5 * forward
behind.rotation_euler = forward.to_track_quat("-Z", "Y").to_euler()
bpy.context.view_layer.update()
seen = looks.evaluate_flares(scene, bpy.context.evaluated_depsgraph_get(), behind)
facts["behind"] = [name for name in seen if name == state.lights[0].name]

# ---- save, reload ----------------------------------------------------------------------------------
state.lights[0].tint = (1, 0.5, 0.25)
bpy.ops.wm.save_as_mainfile(filepath=str(Path(out) / "work.blend"))
empty()
bpy.ops.wm.open_mainfile(filepath=str(Path(out) / "work.blend"))
state = bpy.context.scene.fit_flare
facts["reloaded"] = [Path(bpy.path.abspath(state.flare)).name, state.lights[0].target.name,
                     [round(value, 3) for value in state.lights[0].tint], state.root.name]
bpy.ops.preferences.addon_disable(module=NAME)
bpy.ops.preferences.addon_enable(module=NAME)
facts["enabled again"] = [round(value, 3) for value in bpy.context.scene.fit_flare.lights[0].tint]

# ---- library and transfer --------------------------------------------------------------------------
extensions = Path(bpy.utils.user_resource("EXTENSIONS"))
facts["library's place"] = [part("flare_addon.library").folder().is_absolute(),
                            part("flare_addon.library").folder().is_relative_to(extensions)]
part("flare_addon.user_settings").addon_preferences().library = str(Path(out) / "library")
facts["saved"] = [list(ops.save_flare(name="Desk: lamp", notes="35 mm")),
                  refusal(lambda: ops.save_flare(name="Desk: lamp"))]
library = part("flare_addon.library")
facts["library"] = [path.name for path in library.user_files()]
facts["thumbnail"] = (Path(out) / "library" / "Desk lamp.png").stat().st_size
facts["items"] = [entry[1:3] for entry in library.menu_items()[:1]]
other = empty()
camera = bpy.data.objects.new("Second", bpy.data.cameras.new("Second"))
camera.rotation_euler = (math.pi / 2, 0, 0)
lamp = bpy.data.objects.new("Spot", bpy.data.lights.new("Spot", "SPOT"))
lamp.rotation_euler = (-math.pi / 2, 0, 0)  # shines at the camera
lamp.location = (-1.0, 6.0, 0.8)
for thing in (camera, lamp):
    other.collection.objects.link(thing)
other.camera = camera
bpy.context.view_layer.update()
lamp.select_set(True)
facts["applied"] = list(ops.apply_flare(filepath=str(library.user_files()[0])))
state = other.fit_flare
place = shots.choose_layers_folder(other)  # the .blend is not saved, and beside the flare is the library
facts["layers of a flare of the library"] = [library.folder() in place.parents,
                                             Path(bpy.utils.user_resource("DATAFILES")) in place.parents]
facts["applied to"] = [item.target.name if item.target else "" for item in state.lights]
seen = looks.evaluate_flares(other, bpy.context.evaluated_depsgraph_get(), camera)
facts["transferred"] = [state.native, len(seen), float(drawing.draw(seen.values(), cameras.core_camera(
    camera.data, camera.matrix_world, other.render).scaled(96, 54).intrinsics, 96, 54).sum()) > 0.1]

# ---- a single picture, the light picked in it -------------------------------------------------------
image = bpy.data.images.new("plate", 96, 64)
image.filepath_raw, image.file_format = str(Path(out) / "plate.png"), "PNG"
image.save()
single = empty()
state = single.fit_flare
ops.open_flare(filepath=flare)
facts["picture"] = [list(ops.shot_from_picture(filepath=str(Path(out) / "plate.png"))),
                    single.render.resolution_x, single.render.resolution_y]
bpy.context.view_layer.update()
ops.pick_light(x=0.25, y=0.3)
bpy.context.view_layer.update()
core = cameras.core_camera(single.camera.data, single.camera.matrix_world, single.render)
where, _ = core.project([list(state.lights[0].target.matrix_world.translation)])
facts["picked"] = (where[0] / core.size).tolist()

upright = bpy.data.images.new("upright", 64, 96)
upright.filepath_raw, upright.file_format = str(Path(out) / "upright.png"), "PNG"
upright.save()
ops.shot_from_picture(filepath=str(Path(out) / "upright.png"))
core = cameras.core_camera(single.camera.data, single.camera.matrix_world, single.render)
filmed = looks.look_of(single).camera
facts["upright"] = [core.fx / 96, filmed.fx / filmed.width, filmed.width > filmed.height]

# ---- a capture of Blender's own camera --------------------------------------------------------------
scene = empty()
ops.import_capture(directory=capture)
exported = Path(out) / "exported"
facts["exported"] = list(ops.capture_from_camera(directory=str(exported)))
again = core_capture.Capture.open(exported)
facts["export off"] = max(float(np.abs(one.camera.world_to_camera - two.camera.world_to_camera).max())
                          for one, two in zip(again.views, original.views, strict=True))
facts["export lens off"] = float(np.abs(again.views[0].camera.intrinsics - original.views[0].camera.intrinsics).max())
facts["export points"] = len(again.points)

facts["exported again"] = list(ops.capture_from_camera(directory=str(exported)))
core_files = part("core.system.files")
theirs = core_files.read_json(exported / "transforms.json", RuntimeError)
del theirs["made_by"]
others = {"of nerfstudio": Path(out) / "nerfstudio", "of COLMAP": Path(out) / "colmap"}
shutil.copytree(exported, others["of nerfstudio"])
core_files.write_json(others["of nerfstudio"] / "transforms.json", theirs)
shutil.copytree(Path(capture) / "sparse", others["of COLMAP"] / "sparse")
for name, folder in others.items():
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    said = refusal(lambda folder=folder: ops.capture_from_camera(directory=str(folder)))
    facts[f"exported into one {name}"] = [said, before == {path: path.read_bytes() for path in folder.rglob("*")
                                                           if path.is_file()}]

# ---- a folder that holds no layers ------------------------------------------------------------------
scene = empty()
image = bpy.data.images.new("plain", 8, 8, float_buffer=True)
image.filepath_raw, image.file_format = str(Path(out) / "plain" / "a.0001.exr"), "OPEN_EXR"
image.save()
bpy.data.images.remove(image)
flare_node = part("flare_addon.compositor.flare_node")
facts["no layers"] = [refusal(lambda: ops.set_up_compositor(directory=str(Path(out) / "plain"))),
                      flare_node.tree_of(scene) is None, [image.name for image in bpy.data.images]]

# ---- a .blend below a linked folder -----------------------------------------------------------------
real, link, beside = (Path(out) / name for name in ("real/deep", "link", "beside"))
real.mkdir(parents=True)
beside.mkdir()
link.symlink_to(real, target_is_directory=True)
bpy.ops.wm.save_as_mainfile(filepath=str(link / "a.blend"))
paths = part("flare_addon.paths")
facts["through a link"] = [paths.blend_relative(beside)[:2], paths.absolute(paths.blend_relative(beside)).is_dir()]
state = bpy.context.scene.fit_flare
state.capture, state.flare = paths.blend_relative(beside), str(beside / "a.flare")
(beside / "versions").mkdir()
bpy.ops.wm.save_as_mainfile(filepath=str(beside / "copy.blend"), copy=True)
facts["after a copy"] = paths.absolute(state.capture) == beside.resolve()
bpy.ops.wm.save_as_mainfile(filepath=str(beside / "versions" / "b.blend"))
facts["saved elsewhere"] = [[state.capture, paths.absolute(state.flare) == beside / "a.flare"]]
for name in ("copy.blend", "versions/b.blend"):
    bpy.ops.wm.open_mainfile(filepath=str(beside / name))
    facts["saved elsewhere"].append(str(paths.absolute(bpy.context.scene.fit_flare.capture)) == str(beside))

# ---- the engine's own bake of a shot, from the panel ------------------------------------------------
replace(shot, frames=shot.frames[:1]).write(Path(out) / "shot.json")

leave(facts)
