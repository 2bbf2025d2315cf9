# SPDX-License-Identifier: GPL-3.0-or-later
"""Where objects of a scene stand, those too that the viewport is without, and which collections are shown."""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import bpy

from ..core.errors import CaptureError
from . import fcurves

_PLACING = ("location", "rotation_", "scale", "delta_")  # what begins the names of properties that place an object


def matrix_of(thing: Any, depsgraph: Any) -> Any:
    """matrix_world of an object as it stands now, also of one that is switched off in the viewport or in an excluded
    collection, which Blender does not keep up with; of another scene's as it was when that was looked at last. Raises
    CaptureError where one of this scene is switched off and moved by more than its parents."""
    if not _is_off(thing, depsgraph.view_layer):
        return thing.evaluated_get(depsgraph).matrix_world
    if _is_moved(thing) or thing.constraints or thing.parent_type != "OBJECT":
        if thing.name not in depsgraph.scene.objects:
            return thing.matrix_world.copy()
        raise CaptureError(f"{thing.name!r} is switched off in the viewport, or in an excluded collection, so that "
                           "Blender does not move it; switch it on there, and hide it by its eye instead.")
    if thing.parent is None:
        return thing.matrix_basis.copy()
    return matrix_of(thing.parent, depsgraph) @ thing.matrix_parent_inverse @ thing.matrix_basis


def _is_moved(thing: Any) -> bool:
    """Whether keys or drivers move an object: a lamp that blinks by them stands still."""
    data = thing.animation_data
    return data is not None and (bool(data.nla_tracks) or any(
        curve.data_path.startswith(_PLACING) for some in (*fcurves.of(thing), data.drivers) for curve in some))


def _is_off(thing: Any, layer: Any) -> bool:
    """Whether the viewport is without an object; one that is hidden by an eye alone is not meant."""
    if thing.visible_get(view_layer=layer):
        return False
    return thing.hide_viewport or not any(
        thing.name in some.objects for some in collections_shown(layer.layer_collection, "hide_viewport"))


def collections_shown(layer: Any, hidden: Literal["hide_viewport", "hide_render"]) -> Iterator[Any]:
    """The collections of a layer collection, itself first, but for those that are switched off and what is in them."""
    if not layer.exclude and not getattr(layer.collection, hidden):
        yield layer.collection
        for child in layer.children:
            yield from collections_shown(child, hidden)


def view_layer_of(scene: Any) -> Any:
    """The view layer in which a scene's objects are looked at."""
    return bpy.context.view_layer if bpy.context.scene == scene else scene.view_layers[0]


def depsgraph_of(scene: Any) -> Any:
    """Where the objects of a scene stand now, of one too that no window shows."""
    layer = view_layer_of(scene)
    layer.update()
    return layer.depsgraph
