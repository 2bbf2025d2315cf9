# SPDX-License-Identifier: GPL-3.0-or-later
"""Counts the changes of Blender's data, so that the overlay can draw again what it drew if nothing has changed since.

Blender updates its dependency graph after each change that is tagged: of an object, a setting, or a property with
`update`; items that Python removes need `update_tag`. It calls the handlers here before it draws. `overlay` compares
the counts.
"""
from __future__ import annotations

from typing import Any

import bpy

_count = 0
_HANDLERS = ("depsgraph_update_post", "frame_change_post", "undo_post", "redo_post", "load_post")


def change_count() -> int:
    """Return a number that grows with every tagged change of Blender's data."""
    return _count


@bpy.app.handlers.persistent
def _count_change(*_arguments: Any) -> None:
    """Count a change; a handler of Blender."""
    global _count
    _count += 1


def register() -> None:
    for name in _HANDLERS:
        getattr(bpy.app.handlers, name).append(_count_change)


def unregister() -> None:
    for name in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(_count_change)
