# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders views with Cycles on the CPU as scene-linear pixels, and measures how much of a light a camera sees."""
from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import bpy
import numpy as np
from mathutils import Matrix, Vector
from numpy.typing import NDArray

from core.images.read import read_picture

from .description import Array, LightSource, Pinhole, disc_points

SHARE_SAMPLES = 512
"""Points on a light's disc whose visibility is tested."""
Rendered = TypeVar("Rendered")


def set_up_render(camera: Pinhole, samples: int) -> Any:
    """Set the render settings and return a camera object with the intrinsics of `camera` (square pixels).

    samples: of Cycles for each pixel; the result is denoised.
    """
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.use_denoising = True
    scene.cycles.denoiser = "OPENIMAGEDENOISE"
    scene.cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
    scene.cycles.denoising_prefilter = "ACCURATE"
    scene.cycles.max_bounces = 4
    scene.cycles.diffuse_bounces = 3
    scene.cycles.glossy_bounces = 2
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
    scene.cycles.sample_clamp_indirect = 4.0
    scene.render.use_persistent_data = True
    scene.render.resolution_x, scene.render.resolution_y = camera.width, camera.height
    scene.render.resolution_percentage = 100
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGB", "32"

    data = bpy.data.cameras.new("Camera")
    data.sensor_fit = "HORIZONTAL"
    data.lens = camera.fx * data.sensor_width / camera.width
    # Shifts are relative to the width, in both directions; y points up.
    data.shift_x = (camera.width / 2 - camera.cx) / camera.width
    data.shift_y = (camera.cy - camera.height / 2) / camera.width
    data.clip_start, data.clip_end = 0.01, 1000.0
    camera_object = bpy.data.objects.new("Camera", data)
    scene.collection.objects.link(camera_object)
    scene.camera = camera_object
    return camera_object


def set_pose(camera: Any, world_to_camera: Array) -> None:
    """Move the camera object to a pose (4, 4) in OpenCV's axes; Blender's cameras look along -z with y up."""
    pose = np.linalg.inv(world_to_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
    camera.matrix_world = Matrix(pose.tolist())
    bpy.context.view_layer.update()


def render_view(camera: Any, world_to_camera: Array, seed: int) -> NDArray[np.float32]:
    """Render the view from a pose (4, 4); return scene-linear Rec. 709 pixels (height, width, 3)."""
    set_pose(camera, world_to_camera)
    bpy.context.scene.cycles.seed = seed
    return render_and_read(lambda path: read_picture(path).pixels)


def render_and_read(read: Callable[[Path], Rendered]) -> Rendered:
    """Render the scene as it is set up and return what `read` returns for the file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "view.exr"
        bpy.context.scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
        return read(path)


def visible_share(light: LightSource, eye: Array) -> float:
    """Return the share of the light's disc, seen from `eye`, that no geometry hides: 0..1.

    Rays go from the eye to points spread evenly over the disc (a sunflower spiral) and must reach it.
    """
    scene, depsgraph = bpy.context.scene, bpy.context.evaluated_depsgraph_get()
    centre, origin = np.array(light.xyz), np.asarray(eye, float)
    points = disc_points(centre, origin, light.radius, SHARE_SAMPLES, up=(0.0, 0.0, 1.0))
    # The bulbs are hidden meanwhile, since they would stop the rays.
    bulbs = [item for item in scene.objects if item.get("light_source")]
    for bulb in bulbs:
        bulb.hide_viewport = True
    depsgraph.update()
    visible = 0
    for point in points:
        ray = point - origin
        length = float(np.linalg.norm(ray))
        hit = scene.ray_cast(depsgraph, Vector(origin), Vector(ray / length), distance=length - light.radius)[0]
        visible += not hit
    for bulb in bulbs:
        bulb.hide_viewport = False
    depsgraph.update()
    return visible / SHARE_SAMPLES
