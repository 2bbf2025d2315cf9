# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's side of Fit Flare. Each module registers its own classes; the last registered goes first.

    properties.py       what a .blend remembers           preferences.py   engine and library
    capture_import.py   captures in                       capture_export.py   Blender's cameras as captures
    cameras.py          Blender's cameras and the core's  lights.py        light objects
    engine.py, jobs.py  the process with torch            fits.py          fits
    looks.py            .flare, flares                    occlusion.py     what of a light is seen
    overlay.py, points.py   what is drawn in the viewport
    shots.py            what is baked                     compositor.py    layers back together
    flare_node.py       what puts layers together         wires.py         the panel's sliders on it
    library.py          flares for other shots            paths.py         files of a .blend that moves
    objects.py          where objects stand               curves.py        animation of what is moved
    rendering.py        frames and .blends out            reports.py       what buttons tell
    blend_shot.py       a .blend for the commands         layouts.py       what panels are laid out of
    operators/, panels.py   buttons and panels
"""
from __future__ import annotations

import bpy

from . import fits, jobs, looks, operators, overlay, panels, paths, points, preferences, properties
from .compositor import drivers

_MODULES = (properties, preferences, operators, panels, points, overlay, paths)


@bpy.app.handlers.persistent
def _loaded(_path: str) -> None:
    """Another file: nothing that was read for the last one stays, and what it has of an earlier version is brought
    up to this one."""
    looks.forget()
    points.forget()
    overlay.problem = ""
    for scene in bpy.data.scenes:
        drivers.go_by_numbers(scene)


@bpy.app.handlers.persistent
def _before_a_save(_path: str) -> None:
    """What a Blender without this extension needs to render the file goes into it."""
    for scene in bpy.data.scenes:
        drivers.keep_standing(scene)


def register() -> None:
    for module in _MODULES:
        module.register()
    bpy.app.handlers.load_post.append(_loaded)
    bpy.app.handlers.save_pre.append(_before_a_save)


def unregister() -> None:
    bpy.app.handlers.load_post.remove(_loaded)
    bpy.app.handlers.save_pre.remove(_before_a_save)
    jobs.unregister()
    fits.unregister()
    looks.forget()
    for module in reversed(_MODULES):
        module.unregister()
