# SPDX-License-Identifier: GPL-3.0-or-later
"""The 3D views of Blender's windows."""
from __future__ import annotations

from typing import Any


def look_through_camera(context: Any) -> bool:
    """Turn the largest 3D view of the screen to the scene's camera; return whether there is one.

    A view that looks through a camera of its own is turned to the scene's.
    """
    areas = [area for area in context.screen.areas if area.type == "VIEW_3D"] if context.screen else []
    if not areas or context.scene.camera is None:
        return False
    space = max(areas, key=lambda area: area.width * area.height).spaces.active
    space.use_local_camera = False
    space.region_3d.view_perspective = "CAMERA"
    return True
