# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the point cloud of a capture in its colours; Blender itself draws loose vertices as black dots."""
from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .views import schedule_redraw

ATTRIBUTE = "Col"
MAX_VERTICES = 400_000  # that are drawn; larger clouds are thinned to every second, third, ... vertex
VERTICES_PER_DRAWING = 25_000
"""Vertices that one drawing sends to the GPU at most."""

Floats = NDArray[np.float32]


class _Cloud:
    """The GPU batches of a point cloud, made over several drawings so that none takes long.

    The first drawing of a cloud often follows its import, for which Blender computes much of its own; it makes nothing.
    The second reads the mesh, and each later one makes one batch until all vertices are in one.
    """

    def __init__(self) -> None:
        # Positions (n, 3) and linear colours (n, 4); None before they are read and once all are on the GPU.
        self._vertices: tuple[Floats, Floats] | None = None
        self._count: int | None = None  # vertices to draw; None before they are read
        self._batches: list[Any] = []
        self._sent = 0  # vertices in the batches
        self._is_new = True

    @property
    def is_complete(self) -> bool:
        """Whether all vertices are on the GPU."""
        return self._sent == self._count

    def prepare(self, mesh: Any) -> None:
        """Do the next part of the work on the cloud of a mesh."""
        from gpu_extras.batch import batch_for_shader

        if self._is_new:
            self._is_new = False
        elif self._count is None:
            self._vertices = _read_vertices(mesh)
            self._count = len(self._vertices[0])
        elif self._vertices is not None:
            rows = slice(self._sent, self._sent + VERTICES_PER_DRAWING)
            positions, colours = (np.ascontiguousarray(values[rows]) for values in self._vertices)
            self._batches.append(batch_for_shader(_shader(), "POINTS", {"pos": positions, "color": colours}))
            self._sent += len(positions)
            if self.is_complete:
                self._vertices = None

    def draw(self) -> None:
        """Draw the batches."""
        for batch in self._batches:
            batch.draw(_shader())


def _read_vertices(mesh: Any) -> tuple[Floats, Floats]:
    """Return positions (n, 3) and linear colours (n, 4) of the vertices of a mesh, thinned to MAX_VERTICES."""
    count = len(mesh.vertices)
    positions, colours = np.empty(3 * count, np.float32), np.empty(4 * count, np.float32)
    mesh.vertices.foreach_get("co", positions)
    mesh.color_attributes[ATTRIBUTE].data.foreach_get("color", colours)
    step = max(-(-count // MAX_VERTICES), 1)
    return positions.reshape(-1, 3)[::step], colours.reshape(-1, 4)[::step]


_clouds: dict[tuple[str, int], _Cloud] = {}
"""By the name of the mesh and its number of vertices."""
_handle: Any = None


def _cloud_of(mesh: Any) -> _Cloud:
    """Return the cloud of a mesh, cached by its name and size."""
    key = (mesh.name, len(mesh.vertices))
    if key not in _clouds:
        for outdated in [other for other in _clouds if other[0] == mesh.name]:
            del _clouds[outdated]
        _clouds[key] = _Cloud()
    return _clouds[key]


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
        cloud = _cloud_of(item.data)
        cloud.prepare(item.data)
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.point_size_set(3.0)
        with gpu.matrix.push_pop():
            gpu.matrix.multiply_matrix(item.matrix_world)
            cloud.draw()
        gpu.state.depth_test_set("NONE")
        if not cloud.is_complete:
            schedule_redraw()


def clear_cache() -> None:
    """Free the batches of the clouds that were drawn."""
    _clouds.clear()


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
