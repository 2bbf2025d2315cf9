# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths as a .blend keeps them, and as the disk knows them."""
from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

OURS = ("capture", "matte", "run", "flare", "layers")
"""Of a scene, the properties that hold one."""

_before: dict[tuple[str, str], str] = {}
"""By scene and property what they were before the save that goes on now."""


def stored(path: Path) -> str:
    """A path as a .blend keeps it: relative to the file where it can be."""
    # Not resolved: a drive of the network would lose its letter.
    return _relative(Path(os.path.normpath(path.absolute())), bpy.data.filepath)


def absolute(text: str, library: Any = None) -> Path:
    """Of such a path the place on disk, without `..`: below a linked folder that would lead elsewhere, and the same
    place would have several names. library: of what is linked from another .blend, which its paths start from."""
    text = text.replace("\\", "/") if text.startswith("//") else text
    return Path(os.path.normpath(bpy.path.abspath(text, library=library)))


def is_folder(path: Path) -> bool:
    """Whether a folder is there to be looked at: a name that is too long for the disk, or no leave to look, is no error
    of the panel that asks."""
    return os.path.isdir(path)  # noqa: PTH112 - pathlib's raises then


def is_file(path: Path) -> bool:
    """Whether a file is there to be looked at, as `is_folder`."""
    return os.path.isfile(path)  # noqa: PTH113


def _relative(path: Path, blend: str) -> str:
    if not blend:
        return os.fspath(path)
    try:
        relative = str(bpy.path.relpath(os.fspath(path), start=os.fspath(Path(blend).parent)))
        return relative.replace("\\", "/") if os.name == "nt" else relative
    except ValueError:  # another drive
        return os.fspath(path)


# ---- a .blend saved elsewhere: what Blender does for its own paths ----------------------------------


@bpy.app.handlers.persistent
def _remap(blend: str, *_: object) -> None:
    """Before a save: relative paths from where the file goes; of a file that is saved for the first time all become
    relative."""
    _before.clear()
    first = not bpy.data.filepath
    if not blend or (not first and Path(blend).parent == Path(bpy.data.filepath).parent):
        return
    for scene in (scene for scene in bpy.data.scenes if scene.library is None):
        for name in OURS:
            text = getattr(scene.fit_flare, name)
            if text and text.startswith("//") != first:
                _before[scene.name, name] = text
                setattr(scene.fit_flare, name, _relative(absolute(text), blend))


@bpy.app.handlers.persistent
def _put_back(blend: str, *_: object) -> None:
    """After a save: as they were, where it was a copy or failed and the file here is still the other one."""
    if not blend or Path(blend).parent != Path(bpy.data.filepath).parent:
        for (scene, name), text in _before.items():
            setattr(bpy.data.scenes[scene].fit_flare, name, text)
    _before.clear()


@bpy.app.handlers.persistent
def _take_along(context: Any, *_: object) -> None:
    """After scenes of another .blend were appended: their paths, which are told from there."""
    for item in context.import_items:
        if item.id_type != "SCENE" or item.id is None or item.id.library is not None or item.source_library is None:
            continue
        for name in OURS:
            text = getattr(item.id.fit_flare, name)
            if text.startswith("//"):
                setattr(item.id.fit_flare, name, stored(absolute(text, item.source_library)))


_HANDLERS = [("save_pre", _remap), ("save_post", _put_back), ("save_post_fail", _put_back)]
if hasattr(bpy.app.handlers, "blend_import_post"):  # from 4.3 on
    _HANDLERS.append(("blend_import_post", _take_along))


def register() -> None:
    for when, handler in _HANDLERS:
        getattr(bpy.app.handlers, when).append(handler)


def unregister() -> None:
    for when, handler in _HANDLERS:
        getattr(bpy.app.handlers, when).remove(handler)
