# SPDX-License-Identifier: GPL-3.0-or-later
"""Thumbnails of looks as their own camera sees them, for the library that comes with the program."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..colour.srgb import srgb_from_linear
from .drawing import draw
from .look import Look, ViewOfLight

PLACE = -0.45, -0.38
"""The light in a thumbnail, relative to the frame's half width and height."""


def draw_thumbnail(look: Look, width: int, height: int) -> NDArray[np.float32]:
    """Return display values (height, width, 3): the flare of a look's first light, which is at the upper left.

    The camera is the look's own, cropped about the centre to this aspect ratio. The look must add light."""
    focal = look.camera.fx / look.camera.width * max(width, height * look.camera.width / look.camera.height)
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    light_position = np.array([PLACE[0] * width / 2 / focal, PLACE[1] * height / 2 / focal], np.float32)
    light = look.lights[0]
    camera = (light.query_range.camera_low + light.query_range.camera_high) / 2
    gaussians = light.evaluate(ViewOfLight(camera, np.eye(3, dtype=np.float32), light_position, 1.0))
    picture = (np.zeros((height, width, 3), np.float32) if gaussians is None
               else draw([gaussians], intrinsics, width, height, look.blend, look.pixel_grid))
    return np.clip(srgb_from_linear(np.maximum(picture, 0)), 0, 1)
