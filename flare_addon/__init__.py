# SPDX-License-Identifier: GPL-3.0-or-later
"""The Blender extension. `register` registers every module's classes; `unregister` removes them in reverse.

    properties.py       the properties that a .blend stores      user_settings.py   values of the preferences
    preferences.py      panel of the preferences                 panels.py          the sidebar
    operators/          the buttons                              reports.py         refusals and errors of buttons
    panel_parts.py      parts of the sidebar's panels            engine.py          finding and installing the engine
    layouts.py          labels and progress bars                 handbook.py         links to the handbook
    jobs.py             processes of the engine                  fits.py            fits, light search, clean frames
    weights.py          the weights of the removal network
    capture/            captures into and out of Blender         cameras.py         Blender's cameras and the core's
    lights.py           light objects                            objects.py         matrices of objects
    light_paths.py      lights that move, and tracks of clips
    looks.py            the look of a scene, its flares          occlusion.py       visibility of lights
    overlay.py          the flare in the viewport                points.py          the point cloud in the viewport
    shots.py            scenes as shots                          baking.py          bakes
    lamp_drive.py       power of lamps as a factor               light_extents.py   areas of lights
    asset_browser.py    looks in the Asset Browser      highlight.py        the chosen element in the view
    viewport_render.py  viewport renders with the flare      editor_panels.py    panels of other editors
    views.py            3D views                                 compositor/        the layers in the compositor
    library.py          the library of flares                    paths.py           paths of a .blend that moves
    fcurves.py          animation of list items                  render_settings.py   rendering and saving
    images.py           pictures loaded from disk
"""
from __future__ import annotations

import bpy

from . import (
    asset_browser,
    baking,
    editor_panels,
    fits,
    handbook,
    highlight,
    jobs,
    looks,
    operators,
    overlay,
    panels,
    paths,
    points,
    preferences,
    properties,
    scene_changes,
)
from .compositor import drivers

_MODULES = (properties, preferences, handbook, operators, panels, editor_panels, points, scene_changes, overlay,
            highlight, paths, asset_browser)


@bpy.app.handlers.persistent
def _after_load(_path: str) -> None:
    """After a file is loaded: clear the caches of the previous one, and migrate data of earlier versions."""
    baking.abandon()
    looks.clear_cache()
    points.clear_cache()
    overlay.last_error = ""
    for scene in bpy.data.scenes:
        drivers.migrate_to_indices(scene)


@bpy.app.handlers.persistent
def _before_save(_path: str) -> None:
    """Before a save: store what a Blender without this extension needs to render the file."""
    for scene in bpy.data.scenes:
        drivers.store_fallbacks(scene)


def register() -> None:
    """Register all classes and handlers."""
    for module in _MODULES:
        module.register()
    bpy.app.handlers.load_post.append(_after_load)
    bpy.app.handlers.save_pre.append(_before_save)


def unregister() -> None:
    """Remove all classes, handlers and timers."""
    bpy.app.handlers.load_post.remove(_after_load)
    bpy.app.handlers.save_pre.remove(_before_save)
    jobs.unregister()
    fits.unregister()
    looks.clear_cache()
    for module in reversed(_MODULES):
        module.unregister()
