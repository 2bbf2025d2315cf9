# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: a shot that its motion tracker solved, as a capture; suns; what hides lights. Arguments: the zip, a
folder.

The tracks are those of points that a distorted lens sees from a path, so that the solve is exact.
"""
from __future__ import annotations

import json
import math
import shutil
import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from start import empty, install, leave, part

package, out = sys.argv[1], Path(sys.argv[2])
install(package)
cameras, exporter, lights, looks, occlusion, blend_shot = (
    part(f"flare_addon.{name}") for name in ("cameras", "capture.exporter", "lights", "looks", "occlusion",
                                           "capture.blend_shot"))
facts: dict[str, object] = {}

FRAMES, WIDTH, HEIGHT, K1 = 20, 320, 180, -0.12
FOCAL = 35 / 36 * WIDTH

scene = empty()
scene.frame_start, scene.frame_end = 1, FRAMES
scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT
plate = bpy.data.images.new("plate", WIDTH, HEIGHT)
plate.file_format = "PNG"
(out / "clip").mkdir(parents=True)
for number in range(1, FRAMES + 1):
    plate.save(filepath=str(out / "clip" / f"{number:04d}.png"))
clip = bpy.data.movieclips.load(str(out / "clip" / "0001.png"))
tracking = clip.tracking
tracking.camera.sensor_width, tracking.camera.focal_length = 36, 35
tracking.camera.distortion_model, tracking.camera.k1 = "POLYNOMIAL", K1

points = np.random.default_rng(0).uniform((-2, -1.2, 4), (2, 1.2, 8), (30, 3))  # x right, y down, z forward
for index, point in enumerate(points):
    track = tracking.tracks.new(name=f"t{index}", frame=1)
    for number in range(1, FRAMES + 1):
        angle = 0.25 * (number / FRAMES - 0.5)
        turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
        seen = turn @ (point - (2.0 * (number / FRAMES - 0.5), 0.3 * math.sin(number / 5), 0.5 * number / FRAMES))
        plane = seen[:2] / seen[2]
        x, y = plane * (1 + K1 * (plane @ plane)) * FOCAL + (WIDTH / 2, HEIGHT / 2)
        track.markers.insert_frame(number, co=(x / WIDTH, 1 - y / HEIGHT))

window = bpy.context.window_manager.windows[0]
area = window.screen.areas[0]
area.type = "CLIP_EDITOR"
area.spaces.active.clip = clip
tracking.objects[0].keyframe_a, tracking.objects[0].keyframe_b = 1, FRAMES
with bpy.context.temp_override(window=window, area=area, region=next(one for one in area.regions
                                                                     if one.type == "WINDOW")):
    bpy.ops.clip.solve_camera()
facts["solve error"] = tracking.reconstruction.average_error

camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
scene.collection.objects.link(camera)
scene.camera = camera
camera.data.sensor_width, camera.data.lens = 36, tracking.camera.focal_length
solver = camera.constraints.new("CAMERA_SOLVER")
solver.use_active_clip, solver.clip = False, clip
back = camera.data.background_images.new()
back.source, back.clip = "MOVIE_CLIP", clip


def tracks_missed_by(folder: Path) -> float:
    """Export the scene as a capture; return how far its points, projected into its frames, are from their tracks.

    The greatest distance over all frames, pixels of the distorted frames; infinite if a point is behind a camera.
    """
    bpy.context.view_layer.update()
    exporter.export_capture(scene, folder)
    entries = json.loads((folder / "transforms.json").read_text())["frames"]
    found = exporter.scene_points(scene, camera)
    worst = 0.0
    for number, entry in enumerate(entries, 1):
        pose = np.linalg.inv(np.array(entry["transform_matrix"]) @ cameras.FLIP_YZ)
        seen = found @ pose[:3, :3].T + pose[:3, 3]
        plane = seen[:, :2] / seen[:, 2:]
        plane = plane * (1 + entry.get("k1", 0.0) * (plane**2).sum(1, keepdims=True))
        pixels = plane * (entry["fl_x"], entry["fl_y"]) + (entry["cx"], entry["cy"])
        markers = np.array([track.markers.find_frame(number).co for track in tracking.tracks if track.has_bundle])
        away = np.linalg.norm(pixels - (markers * (1, -1) + (0, 1)) * (WIDTH, HEIGHT), axis=1)
        worst = max(worst, float(away.max() if (seen[:, 2] > 0).all() else math.inf))
    return worst


facts["as solved"] = tracks_missed_by(out / "as_solved")
camera.location, camera.scale = (1, 2, 3), (2, 2, 2)  # what Set Origin, Set Floor and Set Scale do
camera.rotation_euler = (math.radians(80), 0, math.radians(20))
facts["set to the floor"] = tracks_missed_by(out / "on_the_floor")
parent = bpy.data.objects.new("Dolly", None)
scene.collection.objects.link(parent)
parent.location, parent.rotation_euler = (5, 0, 1), (0.1, 0.2, 0.3)
bpy.context.view_layer.update()
camera.parent = parent
camera.matrix_parent_inverse = parent.matrix_world.inverted()
parent.location.z = 4
facts["on a dolly"] = tracks_missed_by(out / "on_a_dolly")

facts["frames from elsewhere"] = exporter.lens_distortion(camera, out / "undistorted" / "0001.png")
tracking.camera.distortion_model, tracking.camera.division_k1 = "DIVISION", 0.1
try:
    exporter.lens_distortion(camera, out / "clip" / "0001.png")
except part("core.errors").CaptureError as problem:
    facts["another model"] = str(problem)
clip.frame_start, clip.frame_offset = 11, 3
facts["offset"] = [exporter.footage_of(camera).path(frame).name for frame in (11, 12)]

# ---- sizes -----------------------------------------------------------------------------------------
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 1280, 720, 35
facts["size at 35 %"] = cameras.render_size(scene.render)
scene.render.resolution_percentage = 100

# ---- a sun, and what hides it ----------------------------------------------------------------------
scene = empty()
camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
for item in (camera, sun):
    scene.collection.objects.link(item)
scene.camera = camera
camera.rotation_euler = (math.radians(90), 0, 0)  # looks along +y
sun.location, sun.rotation_euler = (3, -7, 5), (math.radians(-75), 0, 0)  # 15 degrees above the horizon
bpy.context.view_layer.update()
depsgraph = bpy.context.evaluated_depsgraph_get()
eye = camera.matrix_world.translation
expected = np.array([0, math.cos(math.radians(15)), math.sin(math.radians(15))])


def off(place: object) -> float:
    away = np.array(place, np.float64) - np.array(eye)
    return float(np.abs(away / np.linalg.norm(away) - expected).max())


sun.fit_flare.is_light = True
lights.write_to_capture(scene, out)
facts["sun"] = [off(json.loads((out / "lights.json").read_text())["lights"][0]["xyz"]),
                off(blend_shot.read_shot(scene, out / "x.flare", [], [1]).frames[0].lights[0].xyz)]
sun.hide_render = True
bpy.ops.mesh.primitive_cube_add()
cube = bpy.context.object
plate = next((out / "clip").iterdir())
blend_shot.write_capture(scene, {1: plate}, out / "no lights", [])
facts["no lights"] = sorted(path.name for path in (out / "no lights").iterdir())
lamp = bpy.data.objects.new("Torch", bpy.data.lights.new("Torch", "POINT"))
scene.collection.objects.link(lamp)
for frame, x, energy in ((1, 0.0, 10.0), (3, 4.0, 5.0)):
    lamp.location.x, lamp.data.energy = x, energy
    lamp.keyframe_insert("location", frame=frame)
    lamp.data.keyframe_insert("energy", frame=frame)
stands = bpy.data.objects.new("Stands", None)
scene.collection.objects.link(stands)
stands.location = (0, 0, 2)
plates = {}
for frame in (1, 3):
    plates[frame] = out / "plates" / f"shot.{frame}{plate.suffix}"
    plates[frame].parent.mkdir(exist_ok=True)
    shutil.copy(plate, plates[frame])
blend_shot.write_capture(scene, plates, out / "moving", ["Torch", "Stands"])
written = part("core.capture").Capture.open(out / "moving")
facts["moving lamps"] = [[np.round(written.light_state(light, view).xyz, 3).tolist(),
                          written.light_state(light, view).on]
                         for light in written.lights for view in written.views]
bpy.data.objects.remove(lamp)
bpy.data.objects.remove(stands)
bpy.data.objects.remove(cube)
sun.hide_render = False
second = bpy.data.objects.new("Second", bpy.data.cameras.new("Second"))
scene.collection.objects.link(second)
for frame, filming in ((1, camera), (4, second)):
    scene.timeline_markers.new(f"F{frame}", frame=frame).camera = filming
whole, part_of_it = (blend_shot.read_shot(scene, out / "lamp.flare", [], frames) for frames in ([1, 4], [4]))
facts["cut"] = [list(whole.folders.values()), list(part_of_it.folders.values()),
                whole.frames[1].cache_key() == part_of_it.frames[0].cache_key()]
scene.timeline_markers.clear()
nowhere = []
lamp = bpy.data.objects.new("Nowhere", bpy.data.lights.new("Nowhere", "POINT"))
scene.collection.objects.link(lamp)
lamp.location.x = math.nan
for filming, scale, place in ((camera, 1, 0), (second, 0, 0), (second, 1, math.nan)):
    scene.camera, second.scale, second.location.x = filming, (scale,) * 3, place
    try:
        blend_shot.read_shot(scene, out / "lamp.flare", ["Nowhere"], [1])
    except Exception as problem:
        nowhere.append([type(problem).__name__, str(problem)])
facts["nowhere"] = nowhere
bpy.data.objects.remove(lamp)
scene.camera = camera
item = scene.fit_flare.lights.add()
item.name, item.source, item.target = "lamp", "lamp", sun
facts["sun"].append(off(looks.place_lights(scene, depsgraph, camera)[1][0].xyz))

mesh = bpy.data.meshes.new("Wall")
mesh.from_pydata([(-50, 10, -50), (50, 10, -50), (50, 10, 50), (-50, 10, 50)], [], [(0, 1, 2, 3)])
wall = bpy.data.objects.new("Wall", mesh)
scene.collection.objects.link(wall)


def share() -> float:
    bpy.context.view_layer.update()
    return occlusion.visibility(scene, bpy.context.evaluated_depsgraph_get(), eye, item)


facts["behind a wall"] = share()
wall.hide_render = True
facts["that renders do not show"] = share()
wall.hide_render, wall.visible_camera = False, False
facts["that cameras do not see"] = share()


# ---- a lamp that is an instance of an asset -----------------------------------------------------------
scene = empty()
camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
scene.collection.objects.link(camera)
scene.camera = camera
asset, shade = bpy.data.collections.new("Asset"), bpy.data.meshes.new("Shade")
shade.from_pydata([(-1, -1, -1), (1, -1, -1), (1, -1, 1), (-1, -1, 1)], [], [(0, 1, 2, 3)])
asset.objects.link(bpy.data.objects.new("Shade", shade))
placed = [bpy.data.objects.new(name, None) for name in ("Lamp", "Lamp before it")]
for distance, thing in zip((10, 5), placed, strict=True):
    scene.collection.objects.link(thing)
    thing.instance_type, thing.instance_collection, thing.location.y = "COLLECTION", asset, distance
item = scene.fit_flare.lights.add()
item.name, item.source, item.target = "lamp", "lamp", placed[0]
eye = camera.matrix_world.translation
facts["behind another lamp of its asset"] = share()
bpy.data.objects.remove(placed[1])
facts["in its own asset"] = share()
leave(facts)
