# SPDX-License-Identifier: GPL-3.0-or-later
"""Converts between the paths that a .blend stores and paths on disk, and keeps them valid when a .blend moves."""
from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

PATH_PROPERTIES = ("capture", "matte", "run", "flare", "layers")
"""The properties of a scene that hold a path."""

_paths_before_save: dict[tuple[str, str], str] = {}
"""The paths before the current save, by scene and property."""


def blend_relative(path: Path) -> str:
    """Return a path as a .blend stores it: relative to the file where possible."""
    # Not resolved, since a network drive would lose its letter.
    return _relative(Path(os.path.normpath(path.absolute())), bpy.data.filepath)


def absolute(text: str, library: Any = None) -> Path:
    """Return the path on disk of a stored path, without "..", which below a linked folder would lead elsewhere.

    library: the library of a linked data block, whose paths are relative to that .blend.
    """
    text = text.replace("\\", "/") if text.startswith("//") else text
    return Path(os.path.normpath(bpy.path.abspath(text, library=library)))


def is_folder(path: Path) -> bool:
    """Return whether a folder exists and can be accessed; an invalid name or a missing permission counts as no."""
    return os.path.isdir(path)  # noqa: PTH112 - pathlib's raises then


def is_file(path: Path) -> bool:
    """Return whether a file exists and can be accessed, as `is_folder` does."""
    return os.path.isfile(path)  # noqa: PTH113


def _relative(path: Path, blend: str) -> str:
    """Return a path relative to a .blend as Blender writes it, or absolute where that is impossible."""
    if not blend:
        return os.fspath(path)
    try:
        relative = str(bpy.path.relpath(os.fspath(path), start=os.fspath(Path(blend).parent)))
        return relative.replace("\\", "/") if os.name == "nt" else relative
    except ValueError:  # another drive
        return os.fspath(path)


# ---- a .blend saved in another folder: what Blender does for its own paths ----------------------------------


@bpy.app.handlers.persistent
def _update_relative_paths(blend: str, *_: object) -> None:
    """Before a save: make relative paths relative to the new file; on the first save make all paths relative."""
    _paths_before_save.clear()
    is_first_save = not bpy.data.filepath
    if not blend or (not is_first_save and Path(blend).parent == Path(bpy.data.filepath).parent):
        return
    for scene in (scene for scene in bpy.data.scenes if scene.library is None):
        for name in PATH_PROPERTIES:
            text = getattr(scene.fit_flare, name)
            # On the first save these are the absolute paths, later the relative ones.
            if text and text.startswith("//") != is_first_save:
                _paths_before_save[scene.name, name] = text
                setattr(scene.fit_flare, name, _relative(absolute(text), blend))


@bpy.app.handlers.persistent
def _restore_paths(blend: str, *_: object) -> None:
    """After a save of a copy, or a failed save: restore the paths, since the open file is still the earlier one."""
    if not blend or Path(blend).parent != Path(bpy.data.filepath).parent:
        for (scene, name), text in _paths_before_save.items():
            setattr(bpy.data.scenes[scene].fit_flare, name, text)
    _paths_before_save.clear()


@bpy.app.handlers.persistent
def _update_appended_paths(context: Any, *_: object) -> None:
    """After scenes of another .blend were appended: make their paths relative to this file."""
    for item in context.import_items:
        if item.id_type != "SCENE" or item.id is None or item.id.library is not None or item.source_library is None:
            continue
        for name in PATH_PROPERTIES:
            text = getattr(item.id.fit_flare, name)
            if text.startswith("//"):
                setattr(item.id.fit_flare, name, blend_relative(absolute(text, item.source_library)))


_HANDLERS = [("save_pre", _update_relative_paths), ("save_post", _restore_paths), ("save_post_fail", _restore_paths)]
if hasattr(bpy.app.handlers, "blend_import_post"):  # from 4.3 on
    _HANDLERS.append(("blend_import_post", _update_appended_paths))


def register() -> None:
    for when, handler in _HANDLERS:
        getattr(bpy.app.handlers, when).append(handler)


def unregister() -> None:
    for when, handler in _HANDLERS:
        getattr(bpy.app.handlers, when).remove(handler)
