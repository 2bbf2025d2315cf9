# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths as a .blend keeps them, and as the disk knows them."""
from __future__ import annotations

import os
from pathlib import Path

import bpy


def stored(path: Path) -> str:
    """A path as a .blend keeps it: relative to the file where it can be."""
    text = os.fspath(path.resolve())
    if bpy.data.filepath:
        try:
            return str(bpy.path.relpath(text))
        except ValueError:  # another drive
            return text
    return text


def absolute(text: str) -> Path:
    """Of such a path the place on disk, without `..`: below a linked folder that would lead elsewhere, and the same
    place would have several names."""
    return Path(os.path.normpath(bpy.path.abspath(text)))
