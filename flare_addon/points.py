# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the point cloud of a capture in its colours; Blender itself draws loose vertices as black dots."""
from __future__ import annotations

from typing import Any

import bpy
import numpy as np

ATTRIBUTE = "Col"
MAX_VERTICES = 400_000  # that are drawn; larger clouds are thinned to every second, third, ... vertex

_batches: dict[tuple[str, int], Any] = {}
_handle: Any = None


def _point_batch(mesh: Any) -> Any:
    """Return the shader and the GPU batch of a point cloud, cached by mesh and size."""
    from gpu_extras.batch import batch_for_shader

    key = (mesh.name, len(mesh.vertices))
    if key not in _batches:
        for outdated in [other for other in _batches if other[0] == mesh.name]:
            del _batches[outdated]
        count = len(mesh.vertices)
        coordinates, colours = np.empty(3 * count, np.float32), np.empty(4 * count, np.float32)
        mesh.vertices.foreach_get("co", coordinates)
        mesh.color_attributes[ATTRIBUTE].data.foreach_get("color", colours)
        step = max(-(-count // MAX_VERTICES), 1)
        shader = _shader()
        _batches[key] = shader, batch_for_shader(shader, "POINTS", {
            "pos": np.ascontiguousarray(coordinates.reshape(-1, 3)[::step]),
            "color": np.ascontiguousarray(colours.reshape(-1, 4)[::step])})
    return _batches[key]


def _shader() -> Any:
    """Return Blender's shader for coloured points."""
    import gpu

    return gpu.shader.from_builtin("POINT_FLAT_COLOR" if bpy.app.version >= (4, 5, 0) else "FLAT_COLOR")


def _draw() -> None:
    """Draw the point clouds in the current 3D view."""
    import gpu

    context = bpy.context
    if context.region_data is None or context.region_data.view_perspective == "CAMERA":
        return  # it would cover the footage
    if not context.space_data.overlay.show_overlays:
        return
    for item in context.visible_objects:
        # The importer sets the display as bounds; with another one, Blender draws the vertices itself.
        if item.type != "MESH" or item.display_type != "BOUNDS" or ATTRIBUTE not in item.data.color_attributes:
            continue
        if not item.fit_flare.is_points or not len(item.data.vertices):
            continue
        shader, batch = _point_batch(item.data)
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.point_size_set(3.0)
        with gpu.matrix.push_pop():
            gpu.matrix.multiply_matrix(item.matrix_world)
            batch.draw(shader)
        gpu.state.depth_test_set("NONE")


def clear_cache() -> None:
    """Free the batches of the clouds that were drawn."""
    _batches.clear()


def register() -> None:
    global _handle
    if not bpy.app.background:
        _handle = bpy.types.SpaceView3D.draw_handler_add(_draw, (), "WINDOW", "POST_VIEW")


def unregister() -> None:
    global _handle
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None
    clear_cache()
