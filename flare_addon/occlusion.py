# SPDX-License-Identifier: GPL-3.0-or-later
"""Visibility of a light behind the objects of a scene, by ray casts in Blender.

`looks` evaluates it for the overlay and for bakes. `core.flare.visibility` computes it for a scene of Gaussians.
"""
from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.look.shot import LIGHT_MARGIN, LIGHT_RADIUS
from .lights import light_position
from .objects import world_matrix

DISC_RADIUS_FRACTION = 2 * LIGHT_RADIUS
"""Default radius of the light's disc as a part of its distance: two standard deviations, as in a fit."""
RAYS = 25
"""Sample points of the disc."""


def _disc_samples() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sample points (n, 2) in the unit disc, in a sunflower pattern, and their Gaussian weights (n,)."""
    index = np.arange(RAYS) + 0.5
    radius, angle = np.sqrt(index / RAYS), index * math.pi * (3 - math.sqrt(5))
    # The rim of the unit disc is two standard deviations from its centre: exp(-(2 r)² / 2).
    weights = np.exp(-2.0 * radius**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1), weights / weights.sum()


_POINTS, _WEIGHTS = _disc_samples()


def visibility(scene: Any, depsgraph: Any, eye: Any, item: Any) -> float:
    """Return the visibility of a flare's light from `eye`, 0..1: the part of its disc that no object hides.

    The lamp itself hides nothing: objects within `LIGHT_MARGIN` of the distance, the light object, its children, and
    the instances of these.
    """
    position = light_position(item.target, world_matrix(item.target, depsgraph), eye)
    ignored, instances = _lamp_parts(item, depsgraph)
    return disc_visibility(scene, depsgraph, eye, position, ignored, item.radius, instances)


def _lamp_parts(item: Any, depsgraph: Any) -> tuple[set[str], set[tuple[str, Any]]]:
    """Return the names of the light object of a flare and its children, and the instances of these."""
    objects = (item.target, *item.target.children_recursive)
    names = {obj.name for obj in objects}
    return names, _instances_of(depsgraph, names) if any(obj.is_instancer for obj in objects) else set()


def _instances_of(depsgraph: Any, parents: set[str]) -> set[tuple[str, Any]]:
    """Return the instances of objects with these names, each as the object's name and its matrix_world."""
    return {(instance.object.original.name, instance.matrix_world.copy().freeze())
            for instance in depsgraph.object_instances
            if instance.is_instance and instance.parent.original.name in parents}


def disc_visibility(scene: Any, depsgraph: Any, eye: Any, light: Any, ignored: set[str], disc_radius: float = 0.0,
                    instances: Collection[tuple[str, Any]] = ()) -> float:
    """Return the part of a disc about the point `light` that is visible from `eye`, 0..1.

    The disc faces the eye. Its middle counts more than its rim. ignored, instances: objects by name, and instances by
    name and matrix_world, that hide nothing. disc_radius: radius in world units, 0 for the default part of the
    distance.
    """
    offset = light - eye
    distance = offset.length
    if distance < 1e-6:
        return 1.0
    radius = disc_radius or DISC_RADIUS_FRACTION * distance
    forward = offset / distance
    right = forward.orthogonal().normalized()
    up = forward.cross(right)
    visible = 0.0
    for (x, y), weight in zip(_POINTS.tolist(), _WEIGHTS.tolist(), strict=True):
        target = light + radius * (x * right + y * up)
        visible += weight * _is_clear(scene, depsgraph, eye, (target - eye).normalized(), distance, ignored, instances)
    return min(visible, 1.0)  # rounding


def visible_points(scene: Any, depsgraph: Any, eye: Any, item: Any, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (n,) which points of a flare's light no object hides from `eye`; the lamp itself hides nothing.

    item: the flare. points: (n, 3) in the world.
    """
    from mathutils import Vector

    ignored, instances = _lamp_parts(item, depsgraph)
    is_clear = []
    for point in points.tolist():
        offset = Vector(point) - eye
        is_clear.append(offset.length < 1e-6 or _is_clear(scene, depsgraph, eye, offset.normalized(), offset.length,
                                                          ignored, instances))
    return np.array(is_clear, bool)


def _is_clear(scene: Any, depsgraph: Any, eye: Any, direction: Any, distance: float, ignored: set[str],
              instances: Collection[tuple[str, Any]]) -> bool:
    """Return whether nothing hides a light at this distance from `eye` in a direction (unit vector).

    ignored: names of objects that hide nothing. instances: the same, by name and matrix_world.
    """
    from mathutils import Vector

    start, remaining = Vector(eye), (1 - LIGHT_MARGIN) * distance
    for _ in range(4):  # passes up to four surfaces that hide nothing; after these the light counts as visible
        hit, hit_point, _normal, _index, obj, matrix = scene.ray_cast(depsgraph, start, direction, distance=remaining)
        if not hit:
            return True
        if obj is None or not (obj.original.name in ignored or _is_invisible_to_camera(obj)
                               or any(obj.original.name == name and matrix == instance_matrix
                                      for name, instance_matrix in instances)):
            return False
        # Go on just behind the surface.
        step = (hit_point - start).length + 1e-4 * distance
        start, remaining = start + direction * step, remaining - step
        if remaining <= 0:
            return True
    return True


def _is_invisible_to_camera(obj: Any) -> bool:
    """Return whether renders do not show an object that the viewport shows."""
    return bool(obj.original.hide_render) or not obj.original.visible_camera
