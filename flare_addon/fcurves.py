# SPDX-License-Identifier: GPL-3.0-or-later
"""F-curves and drivers, whose paths go by number, where what is numbered is moved."""
from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import bpy


def of(block: Any) -> list[Any]:
    """The collections of F-curves that animate a data block."""
    data = block.animation_data
    if data is None or data.action is None:
        return []
    if bpy.app.version < (4, 4, 0):
        return [data.action.fcurves]
    return [bag.fcurves for layer in data.action.layers for strip in layer.strips for bag in strip.channelbags
            if bag.slot_handle == data.action_slot_handle]


def renumber(block: Any, path: str, moved: Callable[[int], int | None]) -> None:
    """Have what animates and drives the items of the collection at `path` follow them: `moved` gives an item's new
    number by its old one, None for one that is gone."""
    numbered = re.compile(re.escape(path) + r"\[(\d+)\](.*)")
    drivers = [block.animation_data.drivers] if block.animation_data is not None else []
    for curves in (*of(block), *drivers):
        for curve in list(curves):
            if match := numbered.fullmatch(curve.data_path):
                number = moved(int(match[1]))
                if number is None:
                    curves.remove(curve)
                else:
                    curve.data_path = f"{path}[{number}]{match[2]}"


def take_out(collection: Any, path: str, number: int) -> None:
    """Remove an item of a collection property, at `path` of its data block; those after it move up."""
    collection.remove(number)
    renumber(collection.id_data, path, lambda one: None if one == number else one - (one > number))
