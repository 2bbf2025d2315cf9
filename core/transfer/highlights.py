# SPDX-License-Identifier: GPL-3.0-or-later
"""Places a light at the highlights of a plate, for `transfer`; `core.lights.highlights` finds them."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..capture import Camera, LightExtent
from ..lights.highlights import Highlights
from ..look import PlacedLight

HIGHLIGHTS_LIGHT = "highlights"
"""Name of the light that stands for all highlights."""


def move_to_highlights(light: PlacedLight, highlights: Highlights, camera: Camera) -> PlacedLight:
    """Return the light with a flare at each highlight, at the light's own distance from the camera.

    highlights: at least one, in pixels of `camera`.
    """
    rays = np.stack([(highlights.xy[:, 0] - camera.cx) / camera.fx, (highlights.xy[:, 1] - camera.cy) / camera.fy,
                     np.ones(len(highlights))], -1)
    distance = float(np.linalg.norm(light.xyz - camera.position))
    points = (rays / np.linalg.norm(rays, axis=1, keepdims=True) * distance) @ camera.world_to_camera[:3, :3]
    centre = points.mean(0)
    return replace(light, xyz=camera.position + centre, shares=None,
                   extent=LightExtent.of_points(points - centre, highlights.light))
