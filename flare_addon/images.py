# SPDX-License-Identifier: GPL-3.0-or-later
"""Loads and reloads pictures as Blender images."""
from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import bpy

from .paths import absolute, blend_relative


def load_image(path: Path, source: Literal["FILE", "SEQUENCE"] = "FILE") -> Any:
    """Return the image of a picture, or of the sequence that begins with it, under a path relative to the .blend.

    An image that the .blend has already is reused, unless it is a still and a sequence is needed, or the reverse.
    """
    image = bpy.data.images.load(str(path), check_existing=True)
    if image.users and image.source != source:
        image = bpy.data.images.load(str(path))
    if not image.users:
        image.source, image.filepath = source, blend_relative(path)
    return image


def reload_images(folder: Path) -> int:
    """Reload the images below a folder from disk, since Blender keeps the old pixels; return their number."""
    folder, count = folder.resolve(), 0
    for image in bpy.data.images:
        if image.source in ("FILE", "SEQUENCE") and image.filepath and \
                absolute(image.filepath, image.library).resolve().is_relative_to(folder):
            image.reload()
            count += 1
    return count
