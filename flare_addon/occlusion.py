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


_CLEAR = min(sum(_WEIGHTS.tolist()), 1.0)
"""Visibility of a disc that nothing hides."""
MAX_BOXES, MAX_INSTANCES = 100, 1000
"""Most boxes that `Occluders` computes, and most objects and instances that it looks at."""
_WITHOUT_SURFACE = frozenset(("ARMATURE", "CAMERA", "EMPTY", "LATTICE", "LIGHT", "LIGHT_PROBE", "SPEAKER"))


class Occluders:
    """The boxes of all objects and instances that may hide a light, for a quick answer that none does.

    In a scene with too many of them, or with an object that is being edited, any light may be hidden.
    """

    def __init__(self, depsgraph: Any) -> None:
        lows: list[NDArray[np.float64]] = []
        highs: list[NDArray[np.float64]] = []
        self._is_complete = True
        for number, instance in enumerate(depsgraph.object_instances):
            obj = instance.object
            if obj.type in _WITHOUT_SURFACE and number < MAX_INSTANCES:
                continue
            if number >= MAX_INSTANCES or len(lows) >= MAX_BOXES or obj.original.mode != "OBJECT":
                self._is_complete = False
                break
            matrix = np.array(instance.matrix_world, np.float64)
            corners = np.array([tuple(corner) for corner in obj.bound_box], np.float64) @ matrix[:3, :3].T
            lows.append((corners + matrix[:3, 3]).min(0))
            highs.append((corners + matrix[:3, 3]).max(0))
        self._lows, self._highs = (np.array(ends, np.float64).reshape(-1, 3) for ends in (lows, highs))

    def may_hide(self, eye: Any, light: Any, radius: float) -> bool:
        """Return whether a box comes as near as `radius` to the line from `eye` to a light; lengths in world units."""
        if not self._is_complete:
            return True
        start, step = np.array(eye, np.float64), np.array(light, np.float64) - np.array(eye, np.float64)
        step = np.where(np.abs(step) < 1e-12, 1e-12, step)
        margin = radius + 1e-3 * float(np.linalg.norm(step))
        first, last = (self._lows - margin - start) / step, (self._highs + margin - start) / step
        enters, leaves = np.minimum(first, last).max(-1), np.maximum(first, last).min(-1)
        return bool(((enters <= leaves) & (leaves >= 0) & (enters <= 1)).any())


def visibility(scene: Any, depsgraph: Any, eye: Any, item: Any, occluders: Occluders | None = None) -> float:
    """Return the visibility of a flare's light from `eye`, 0..1: the part of its disc that no object hides.

    The lamp itself hides nothing: objects within `LIGHT_MARGIN` of the distance, the light object, its children, and
    the instances of these. occluders: boxes of what may hide it; None to cast all rays.
    """
    position = light_position(item.target, world_matrix(item.target, depsgraph), eye)
    radius = _disc_radius(item.radius, (position - eye).length)
    if occluders is not None and not occluders.may_hide(eye, position, radius):
        return _CLEAR
    ignored, instances = _lamp_parts(item, depsgraph)
    return disc_visibility(scene, depsgraph, eye, position, ignored, item.radius, instances)


def _disc_radius(radius: float, distance: float) -> float:
    """Return the radius of a light's disc, world units: `radius`, or for 0 the default part of the distance."""
    return radius or DISC_RADIUS_FRACTION * distance


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
    radius = _disc_radius(disc_radius, distance)
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
