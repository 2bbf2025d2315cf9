# SPDX-License-Identifier: GPL-3.0-or-later
"""The 3D views of Blender's windows."""
from __future__ import annotations

from typing import Any

import bpy

REFINE_S = 0.02
"""Seconds after which a drawing that is not complete is followed by another."""


def look_through_camera(context: Any) -> bool:
    """Turn the largest 3D view of the screen to the scene's camera; return whether there is one.

    A view that looks through a camera of its own is turned to the scene's.
    """
    view = largest_view(context)
    if view is None or context.scene.camera is None:
        return False
    space = view[2]
    space.use_local_camera = False
    space.region_3d.view_perspective = "CAMERA"
    return True


def largest_view(context: Any) -> tuple[Any, Any, Any] | None:
    """Return area, region and space of the largest 3D view of the screen; None without one."""
    areas = [area for area in context.screen.areas if area.type == "VIEW_3D"] if context.screen else []
    if not areas:
        return None
    area = max(areas, key=lambda area: area.width * area.height)
    return area, next(region for region in area.regions if region.type == "WINDOW"), area.spaces.active


def view_areas() -> list[Any]:
    """Return the areas of the 3D views of all windows."""
    manager = getattr(bpy.context, "window_manager", None)
    return [area for window in (manager.windows if manager else ()) for area in window.screen.areas
            if area.type == "VIEW_3D"]


def redraw_viewports(_self: Any = None, _context: Any = None) -> None:
    """Redraw every 3D view, since a change affects the overlay."""
    for area in view_areas():
        area.tag_redraw()


def schedule_redraw() -> None:
    """Redraw every 3D view after `REFINE_S`."""
    if not bpy.app.timers.is_registered(redraw_viewports):
        bpy.app.timers.register(redraw_viewports, first_interval=REFINE_S)


def camera_of(space: Any, scene: Any) -> Any:
    """Return the camera that a 3D view looks through: its own where it has one, else the scene's; None without."""
    return space.camera if space.use_local_camera and space.camera else scene.camera


def has_display_footage(camera: Any) -> bool:
    """Return whether a camera shows footage, behind or in front of the scene, that bypasses the view transform."""
    return bool(display_footage(camera))


def display_footage(camera: Any) -> list[Any]:
    """Return the background images of a camera that bypass the view transform: movie clips, and images that are not
    viewed as renders. A hidden one does not count."""
    if camera is None or camera.type != "CAMERA" or not camera.data.show_background_images:
        return []
    return [background for background in camera.data.background_images
            if background.alpha > 0 and _bypasses_view_transform(background)]


def _bypasses_view_transform(background: Any) -> bool:
    """Return whether a background image of a camera has footage that bypasses the view transform."""
    if background.source == "IMAGE":
        return background.image is not None and not background.image.use_view_as_render
    return background.clip is not None


def view_region_at(area: Any, x: float, y: float) -> Any | None:
    """Return the region of a 3D view at a position in the window, px; None outside, and where a sidebar lies over it.
    """
    regions = [region for region in area.regions
               if 0 <= x - region.x < region.width and 0 <= y - region.y < region.height]
    return regions[0] if [region.type for region in regions] == ["WINDOW"] else None
