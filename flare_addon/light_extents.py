# SPDX-License-Identifier: GPL-3.0-or-later
"""The extent of a light object: the area of an area light, the radius of other lamps, a mesh's surface, a curve.

`looks.place_lights` hands it to the core, which sums the flare over it.
"""
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.capture import LightExtent, sample_curve, sample_surface
from ..core.errors import CaptureError

Floats = NDArray[np.float64]


def extent_of(item: Any, depsgraph: Any, matrix: Any) -> LightExtent | None:
    """Return the extent of a flare's light object in Blender's world, about the object's origin; None for a point.

    Unless the artist chooses otherwise, only area lights have an extent. matrix: matrix_world of the object. Raises
    CaptureError for an object whose shape cannot be used.
    """
    target = item.target
    if is_point(item):
        return None
    linear = np.array(matrix.to_3x3(), np.float64)
    evaluated = target.evaluated_get(depsgraph)
    try:
        if target.type == "LIGHT":
            return _extent_of_lamp(evaluated.data, linear)
        return _extent_of_geometry(evaluated, linear)
    except ValueError as problem:
        raise CaptureError(f"{target.name!r} cannot flare as an area ({problem}); choose Point as its extent."
                           ) from problem


def is_point(item: Any) -> bool:
    """Return whether a flare's light counts as a point, whose visibility is that of a disc of its radius."""
    is_area = item.target.type == "LIGHT" and item.target.data.type == "AREA"
    return bool(item.extent == "point" or item.target.type == "EMPTY" or (item.extent == "auto" and not is_area))


def _extent_of_lamp(data: Any, linear: Floats) -> LightExtent | None:
    """Return the extent of a lamp in Blender's world, about its origin; None for a lamp that is a point.

    data: the lamp's data. linear: the upper left (3, 3) of its matrix_world.
    """
    if data.type == "AREA":
        wide = data.size
        high = data.size_y if data.shape in ("RECTANGLE", "ELLIPSE") else wide
        # The core's light emits along the cross product of its axes, Blender's along its -Z: hence the minus below.
        wide *= math.copysign(1, float(np.linalg.det(linear)))  # a mirrored lamp shines along its -Z, too
        axes = np.array([linear @ (wide / 2, 0, 0), linear @ (0, -high / 2, 0)])
        if not np.linalg.norm(axes, axis=1).all():
            return None
        make = LightExtent.rectangle if data.shape in ("SQUARE", "RECTANGLE") else LightExtent.ellipse
        return make(axes, one_sided=True)
    if data.type == "SUN":
        return None  # the sun's disc in the sky is smaller than any ghost
    radius = float(data.shadow_soft_size) * float(np.cbrt(abs(np.linalg.det(linear))))
    return LightExtent.sphere(radius) if radius > 0 and math.isfinite(radius) else None


def _extent_of_geometry(evaluated: Any, linear: Floats) -> LightExtent:
    """Return the extent of a mesh or curve object: points spread evenly over its faces, or along its vertices if it has
    none. linear: (3, 3) of the object's matrix. Raises ValueError if it has no area or no length."""
    mesh = evaluated.to_mesh()
    try:
        coordinates = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", coordinates)
        vertices = coordinates.reshape(-1, 3).astype(np.float64)
        mesh.calc_loop_triangles()
        if len(mesh.loop_triangles):
            corners = np.empty(3 * len(mesh.loop_triangles), np.int32)
            mesh.loop_triangles.foreach_get("vertices", corners)
            local = sample_surface(vertices, corners.reshape(-1, 3))
        else:
            local = sample_curve(vertices)
    finally:
        evaluated.to_mesh_clear()
    return LightExtent.of_points(local @ linear.T)
