# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures that a .blend has from disk."""
from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import bpy

from .paths import absolute, stored


def loaded(path: Path, source: Literal["FILE", "SEQUENCE"] = "FILE") -> Any:
    """The picture, or the sequence that begins with it: the image that is here for it, unless that one is the other of
    the two. By a path that goes with a .blend into another place."""
    image = bpy.data.images.load(str(path), check_existing=True)
    if image.users and image.source != source:
        image = bpy.data.images.load(str(path))
    if not image.users:
        image.source, image.filepath = source, stored(path)
    return image


def read_again(folder: Path) -> None:
    """Read pictures below a folder from disk again, where Blender has them: it would show those of before."""
    folder = folder.resolve()
    for image in bpy.data.images:
        if image.source in ("FILE", "SEQUENCE") and image.filepath and \
                absolute(image.filepath, image.library).resolve().is_relative_to(folder):
            image.reload()
