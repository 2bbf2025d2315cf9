# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: the overlay as its shaders draw it, against numpy. Arguments: the zip, a .flare with one light."""
from __future__ import annotations

import sys
from pathlib import Path

import bpy
import gpu
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from quads import drawn_levels
from start import install, leave, part, scene_with, select

package, flare = sys.argv[1:3]
facts: dict[str, object] = {}
try:
    gpu.init()  # from Blender 5.2 on
    gpu.types.GPUOffScreen(8, 8, format="RGBA32F").free()
except (AttributeError, SystemError, RuntimeError, ValueError) as problem:
    facts["missing"] = f"this Blender draws nothing without a window ({problem})"
    leave(facts)
install(package)
sys.path.remove(str(Path(__file__).parent))
looks, overlay, cameras, space = (part(f"flare_addon.{name}") for name in (
    "looks", "overlay", "cameras", "working_space"))
scene, (lamp,) = scene_with((0.4, 8, 0.3))
select(scene, lamp)
bpy.ops.fit_flare.apply_flare(filepath=flare)


def compare(width: int, height: int, levels: tuple[int, ...]) -> list[float]:
    """Largest difference of a picture from numpy's and numpy's largest value, both with these levels alone, and how
    many of them were drawn."""
    quads_by_level = overlay.quads_by_level

    def some_levels(*values):
        return {divisor: quads for divisor, quads in quads_by_level(*values).items() if divisor in levels}

    look = looks.look_of(scene)
    scene.render.resolution_x, scene.render.resolution_y = width, height
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    core = cameras.core_camera(scene.camera.data, scene.camera.matrix_world, scene.render)
    window = overlay.drawn_region(overlay.CameraFrame(0, 0, width, height), (width, height), core)
    gaussians = overlay.concatenate(list(looks.evaluate_flares(scene, depsgraph, scene.camera).values()))
    overlay.quads_by_level = some_levels
    drawn = overlay.render_picture(scene, depsgraph, scene.camera, width, height)
    expected = drawn_levels(overlay, gaussians, window, look) @ space.working_space().T
    overlay.quads_by_level = quads_by_level
    return [float(np.abs(drawn - expected).max()), float(expected.max()), len(some_levels(gaussians, window, look))]


facts["pictures"] = [compare(333, 187, overlay.LEVELS), compare(64, 101, overlay.LEVELS), compare(333, 187, (4,))]
scene, (lamp,) = scene_with((0.4, 8, 0.3))
select(scene, lamp)
bpy.ops.fit_flare.add_library_flare(look=next(row[0] for row in part("flare_addon.library").menu_items()))
facts["many in one place"] = compare(333, 187, overlay.LEVELS)
leave(facts)
