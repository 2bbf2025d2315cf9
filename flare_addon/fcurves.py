# SPDX-License-Identifier: GPL-3.0-or-later
"""Inserts keys in bulk, and keeps F-curves and drivers on the items of a collection property whose indices change."""
from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray


def fcurves_of(block: Any) -> list[Any]:
    """Return the collections of F-curves that animate a data block; from Blender 4.4 on, of the block's slot in
    the action."""
    data = block.animation_data
    if data is None or data.action is None:
        return []
    if bpy.app.version < (4, 4, 0):
        return [data.action.fcurves]
    return [bag.fcurves for layer in data.action.layers for strip in layer.strips for bag in strip.channelbags
            if bag.slot_handle == data.action_slot_handle]


def insert_keys(block: Any, channels: dict[str, NDArray[Any]], frames: Sequence[int]) -> None:
    """Insert linear keys on a data block in bulk, in a new action.

    channels: values (frames, components of the property) by RNA path.
    """
    action = bpy.data.actions.new(f"{block.name} Action")
    block.animation_data_create().action = action
    curves: Any
    if bpy.app.version >= (4, 4, 0):
        slot = action.slots.new(id_type=block.id_type, name=block.name)
        block.animation_data.action_slot = slot
        strip = action.layers.new("Layer").strips.new(type="KEYFRAME")
        curves = strip.channelbag(slot, ensure=True).fcurves
    else:
        curves = action.fcurves
    for path, values in channels.items():
        for index in range(values.shape[1]):
            curve = curves.new(path, index=index)
            curve.keyframe_points.add(len(frames))
            flat = np.stack([np.asarray(frames, np.float32), values[:, index].astype(np.float32)], -1).ravel()
            curve.keyframe_points.foreach_set("co", flat)
            curve.keyframe_points.foreach_set("interpolation", [1] * len(frames))  # LINEAR
            curve.update()


def renumber(block: Any, path: str, new_index: Callable[[int], int | None]) -> None:
    """Update the indices in the paths of F-curves and drivers on the items of the collection at `path`.

    new_index: returns the new index of an item for its old one; None for an item that was removed, whose curves are
    removed too.
    """
    pattern = re.compile(re.escape(path) + r"\[(\d+)\](.*)")
    drivers = [block.animation_data.drivers] if block.animation_data is not None else []
    for curves in (*fcurves_of(block), *drivers):
        for curve in list(curves):
            if match := pattern.fullmatch(curve.data_path):
                index = new_index(int(match[1]))
                if index is None:
                    curves.remove(curve)
                else:
                    curve.data_path = f"{path}[{index}]{match[2]}"


def is_animated(block: Any, path: str) -> bool:
    """Return whether an F-curve or a driver of a data block acts on the property at `path`, or on one below it."""
    drivers = [block.animation_data.drivers] if block.animation_data is not None else []
    return any(curve.data_path == path or curve.data_path.startswith((f"{path}.", f"{path}["))
               for curves in (*fcurves_of(block), *drivers) for curve in curves)


def _unshare_action(block: Any) -> None:
    """Copy the action of a data block if another block uses it too, as after a linked copy of a scene."""
    data = block.animation_data
    if data is None or data.action is None:
        return
    if bpy.app.version < (4, 4, 0):
        users = data.action.users - data.action.use_fake_user
    else:
        users = len(data.action_slot.users()) if data.action_slot is not None else 0
    if users > 1:
        slot = getattr(data, "action_slot", None)
        identifier = slot.identifier if slot is not None else ""
        data.action = data.action.copy()
        if identifier:
            data.action_slot = data.action.slots[identifier]


def remove_item(collection: Any, path: str, index: int) -> None:
    """Remove an item of the collection property at `path` of its data block, with the animation of that item."""
    collection.remove(index)
    # Blender counts no change for an item that Python removes, and the overlay would keep drawing the removed item.
    collection.id_data.update_tag()
    if is_animated(collection.id_data, path):
        _unshare_action(collection.id_data)
    renumber(collection.id_data, path, lambda old: None if old == index else old - (old > index))
