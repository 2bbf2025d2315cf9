# SPDX-License-Identifier: GPL-3.0-or-later
"""World matrices of objects, also of ones that are disabled in the viewport, and the enabled collections of a layer."""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import bpy

from ..core.errors import CaptureError
from . import fcurves

_TRANSFORM_PREFIXES = ("location", "rotation_", "scale",
                       "delta_")  # what begins the names of properties that place an object


def world_matrix(obj: Any, depsgraph: Any) -> Any:
    """Return the current matrix_world of an object, also of a disabled one, which Blender does not update.

    Disabled means off in the viewport or in an excluded collection. For an object of another scene this is the matrix
    of that scene's last update. Raises CaptureError for a disabled object of this scene that is moved by animation,
    by constraints, or by a parent other than an object.
    """
    if not _is_disabled(obj, depsgraph.view_layer):
        return obj.evaluated_get(depsgraph).matrix_world
    if _is_animated(obj) or obj.constraints or obj.parent_type != "OBJECT":
        if obj.name not in depsgraph.scene.objects:
            return obj.matrix_world.copy()
        raise CaptureError(f"{obj.name!r} is disabled in the viewport, or in an excluded collection, so Blender does "
                           "not move it; enable it there, and hide it with its eye icon instead.")
    if obj.parent is None:
        return obj.matrix_basis.copy()
    return world_matrix(obj.parent, depsgraph) @ obj.matrix_parent_inverse @ obj.matrix_basis


def _is_animated(obj: Any) -> bool:
    """Return whether keys or drivers move an object; animated brightness does not count."""
    data = obj.animation_data
    return data is not None and (bool(data.nla_tracks) or any(
        curve.data_path.startswith(_TRANSFORM_PREFIXES) for group in (*fcurves.fcurves_of(obj),
                                                                      data.drivers) for curve in group))


def _is_disabled(obj: Any, layer: Any) -> bool:
    """Return whether an object is disabled in the viewport; one hidden by its eye icon alone is not."""
    if obj.visible_get(view_layer=layer):
        return False
    return obj.hide_viewport or not any(
        obj.name in group.objects for group in enabled_collections(layer.layer_collection, "hide_viewport"))


def enabled_collections(layer: Any, hidden: Literal["hide_viewport", "hide_render"]) -> Iterator[Any]:
    """Yield the enabled collections of a layer collection, itself first."""
    if not layer.exclude and not getattr(layer.collection, hidden):
        yield layer.collection
        for child in layer.children:
            yield from enabled_collections(child, hidden)


def view_layer_of(scene: Any) -> Any:
    """Return the view layer in which the objects of a scene are evaluated."""
    return bpy.context.view_layer if bpy.context.scene == scene else scene.view_layers[0]


def depsgraph_of(scene: Any) -> Any:
    """Return the updated dependency graph of a scene, also of one that no window shows."""
    layer = view_layer_of(scene)
    layer.update()
    return layer.depsgraph
