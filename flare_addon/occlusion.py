# SPDX-License-Identifier: GPL-3.0-or-later
"""How much of a light a camera sees past the objects of a scene, by Blender's own rays: where a fit's scene is of
Gaussians, `core.flare.visibility` says it by theirs."""
from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.look.shot import LIGHT_MARGIN, LIGHT_RADIUS
from .lights import stands
from .objects import matrix_of

DISK_SHARE = 2 * LIGHT_RADIUS
"""Of a light's distance, the disk's radius where none is given: two deviations wide, as a fit's."""
RAYS = 25


def _disk() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points of a sunflower on the unit disk (n, 2), and weights that fall off to the rim."""
    index = np.arange(RAYS) + 0.5
    radius, angle = np.sqrt(index / RAYS), index * math.pi * (3 - math.sqrt(5))
    weights = np.exp(-2.0 * radius**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1), weights / weights.sum()


_POINTS, _WEIGHTS = _disk()


def visible_share(scene: Any, depsgraph: Any, eye: Any, item: Any) -> float:
    """How much of a light's disk the eye sees past the scene's objects, 0..1, by rays to points of the disk.

    What stands right at the light (within `LIGHT_MARGIN` of the distance) is the lamp itself and hides nothing, and so
    do its children and what it or they are instances of.
    """
    where = stands(item.target, matrix_of(item.target, depsgraph), eye)
    lamp = (item.target, *item.target.children_recursive)
    own = {thing.name for thing in lamp}
    instances = _instances_of(depsgraph, own) if any(thing.is_instancer for thing in lamp) else set()
    return share_seen(scene, depsgraph, eye, where, own, item.radius, instances)


def _instances_of(depsgraph: Any, parents: set[str]) -> set[tuple[str, Any]]:
    """The instances that objects of these names show, each by its object's name and where it is."""
    return {(one.object.original.name, one.matrix_world.copy().freeze()) for one in depsgraph.object_instances
            if one.is_instance and one.parent.original.name in parents}


def share_seen(scene: Any, depsgraph: Any, eye: Any, light: Any, own: set[str], disk: float = 0.0,
               instances: Collection[tuple[str, Any]] = ()) -> float:
    """How much of a disk about the point `light` the eye sees past all objects but `own` and these instances (name and
    matrix_world), 0..1; its radius in world units, 0 for a share of the distance."""
    from mathutils import Vector

    away = light - eye
    distance = away.length
    if distance < 1e-6:
        return 1.0
    radius = disk or DISK_SHARE * distance
    forward = away / distance
    right = forward.orthogonal().normalized()
    up = forward.cross(right)
    share = 0.0
    reach = (1 - LIGHT_MARGIN) * distance
    for (x, y), weight in zip(_POINTS.tolist(), _WEIGHTS.tolist(), strict=True):
        target = light + radius * (x * right + y * up)
        direction = (target - eye).normalized()
        start, left, clear = Vector(eye), reach, True
        for _ in range(4):  # past the lamp's own meshes
            hit, where, _normal, _index, thing, matrix = scene.ray_cast(depsgraph, start, direction, distance=left)
            if not hit:
                break
            if thing is None or not (thing.original.name in own or _is_unseen(thing)
                                     or any(thing.original.name == name and matrix == place
                                            for name, place in instances)):
                clear = False
                break
            step = (where - start).length + 1e-4 * distance
            start, left = start + direction * step, left - step
            if left <= 0:
                break
        share += weight * clear
    return min(share, 1.0)  # of rounding


def _is_unseen(thing: Any) -> bool:
    """Whether pictures of the camera do not show an object that the viewport has."""
    return bool(thing.original.hide_render) or not thing.original.visible_camera
