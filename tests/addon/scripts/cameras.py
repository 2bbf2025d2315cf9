# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: cameras of every fit, axes, frame numbers and edits, as numbers against Blender's own.

Arguments: zip.
"""
from __future__ import annotations

import itertools
import sys
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
from mathutils import Euler

sys.path.insert(0, str(Path(__file__).parent))
from start import empty, install, leave, part

install(sys.argv[1])
sys.path.remove(str(Path(__file__).parent))
cameras, shots, looks = (part(f"flare_addon.{name}") for name in ("cameras", "shots", "looks"))
facts: dict[str, object] = {}
scene = empty()
render = scene.render
data = bpy.data.cameras.new("Camera")
camera = bpy.data.objects.new("Camera", data)
scene.collection.objects.link(camera)

# ---- every way to fit the sensor ------------------------------------------------------------------
facts["intrinsics"] = {}
for fit, (width, height), (x, y) in itertools.product(
        ("AUTO", "HORIZONTAL", "VERTICAL"), ((64, 40), (40, 64)), ((1, 1), (1, 1.4), (2, 1))):
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x, render.pixel_aspect_y = x, y
    data.sensor_fit, data.sensor_width, data.sensor_height = fit, 36, 20
    data.lens, data.shift_x, data.shift_y = 40, 0.07, -0.03
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    p = np.array(camera.evaluated_get(graph).calc_matrix_camera(graph, x=width, y=height, scale_x=x, scale_y=y))
    blenders = (p[0, 0] * width / 2, p[1, 1] * height / 2, (1 - p[0, 2]) * width / 2, (1 + p[1, 2]) * height / 2)
    facts["intrinsics"][f"{fit} {width}x{height} {x}:{y}"] = [list(map(float, blenders)),
                                                              list(map(float, cameras.intrinsics_of(data, render)))]

# ---- a camera of the core with other pixels than square, into Blender and back --------------------
facts["back"] = []
for fx, fy in ((70.0, 50.0), (50.0, 70.0)):
    one = part("core.capture").Camera(64, 40, fx, fy, 33.0, 19.5, np.eye(4))
    aspect = cameras.pixel_aspect(fx, fy)
    render.resolution_x, render.resolution_y = 64, 40
    render.pixel_aspect_x, render.pixel_aspect_y = aspect
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.lens, data.shift_x, data.shift_y = cameras.lens_of(one, 36.0, aspect)
    facts["back"].append([[fx, fy, 33.0, 19.5], list(map(float, cameras.intrinsics_of(data, render)))])

# ---- what a scene has one of ----------------------------------------------------------------------
Camera = part("core.capture").Camera
facts["unlike"] = [list(part("flare_addon.capture.importer").camera_warnings(
    [Camera(64, 40, 70.0, 70.0, 32, 20, np.eye(4)), Camera(64, height, 70.0, fy, 32, 20, np.eye(4))]))
    for height, fy in ((40, 70.1), (44, 70.0), (40, 71.4))]

# ---- what was up in the capture is up in Blender --------------------------------------------------
axes = part("flare_addon.capture.importer").UP_ROTATIONS
facts["up"] = {name: list(np.array(Euler(axes[name]).to_matrix()) @ up)
               for name, up in (("Z", (0, 0, 1)), ("-Y", (0, -1, 0)), ("Y", (0, 1, 0)))}

# ---- frames ---------------------------------------------------------------------------------------
custom = SimpleNamespace(bake_range="custom", bake_first=3, bake_last=5)
facts["custom"] = list(shots.frames_to_bake(SimpleNamespace(fit_flare=custom, frame_step=1)))
sequence = SimpleNamespace(source="SEQUENCE", library=None, filepath="/s/plate.1001.exr")
behind = SimpleNamespace(source="IMAGE", image=sequence,
                         image_user=SimpleNamespace(frame_start=1, frame_offset=1004))
filmed = part("flare_addon.capture.exporter").footage_of(
    SimpleNamespace(type="CAMERA", data=SimpleNamespace(background_images=[behind])))
facts["footage"] = filmed.path(3).name

# ---- what the compositor does live is not baked too -----------------------------------------------
edits = part("core.look").LookEdits.parse(["*.mute=1", "lamp.solo=1", "key.mute=1", "lamp.scale=2"], ["lamp", "key"])
facts["baked edits"] = list(shots.without_live_edits(edits).texts())

# ---- a light that was moved from where it was learned shows its flare as the source does ----------
facts["query"] = [looks.query_of(SimpleNamespace(root=1, native=native)) for native in (True, False)]
root, lamp = bpy.data.objects.new("Root", None), bpy.data.objects.new("Lamp", None)
for thing in (root, lamp):
    scene.collection.objects.link(thing)
reach = SimpleNamespace(camera_high=np.ones(3), camera_low=np.zeros(3))
learned = SimpleNamespace(lights=[SimpleNamespace(name="lamp", xyz=np.zeros(3), query_range=reach)])
facts["native"] = []
for away in (0, 5):
    lamp.location = (away, 0, 0)
    depsgraph = part("flare_addon.objects").depsgraph_of(scene)
    facts["native"].append([bool(looks._is_of_this_capture(learned, SimpleNamespace(root=its, capture=capture),
                                                         {"lamp": lamp},
                                              depsgraph))
                            for its, capture in ((root, "//capture"), (None, "//of this camera"), (None, ""))])
leave(facts)
