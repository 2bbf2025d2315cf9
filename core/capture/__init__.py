# SPDX-License-Identifier: GPL-3.0-or-later
"""Captures: frames, cameras, points and lights, from COLMAP models and transforms.json.

Reading needs numpy alone, so that Blender's own Python can do it; pictures are decoded by OpenCV and OpenEXR, imported
with the first one. `solve/` makes captures; fit, bake, transfer and removal read them.
"""
from __future__ import annotations

from .camera import Camera
from .capture import LIGHTS, REMOVED, Capture, View
from .colmap import PointCloud
from .frame_files import PictureIndex
from .lens import Lens
from .light_extent import LightExtent, sample_curve, sample_surface
from .lights import Light, LightKey, LightState, read_lights

__all__ = ["LIGHTS", "REMOVED", "Camera", "Capture", "Lens", "Light", "LightExtent", "LightKey", "LightState",
           "PictureIndex", "PointCloud", "View", "read_lights", "sample_curve", "sample_surface"]
