# SPDX-License-Identifier: GPL-3.0-or-later
"""Render settings that match the footage, and atomic writing of rendered frames and .blend files."""
from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import bpy

from ..core.bake.folder import LayerFolder
from ..core.errors import FrameError
from ..core.images.exr import is_exr_truncated
from ..core.system.files import atomic_path
from .paths import absolute, blend_relative

PLAIN_VIEWS = ("Standard", "Un-tone-mapped")  # of Blender's own colour configuration, and of ACES'


def match_scene(scene: Any, layers: LayerFolder, size: tuple[int, int]) -> None:
    """Set frame range and size (width, height) of the scene to the layers', and go to one of their frames.

    The pixel aspect is kept, since the camera depends on it.
    """
    scene.frame_start, scene.frame_end = layers.first, layers.last
    if not layers.first <= scene.frame_current <= layers.last:  # a frame without layers
        scene.frame_set(layers.first)
    render = scene.render
    render.resolution_x, render.resolution_y = size
    render.resolution_percentage = 100


def set_plain_output(scene: Any) -> str:
    """Switch dithering off, and the view transform to the plain one. Returns what `set_plain_view` does."""
    scene.render.dither_intensity = 0.0
    return set_plain_view(scene)


def set_plain_view(scene: Any) -> str:
    """Choose the plain view transform, which shows pictures unchanged, in place of Blender's default AgX.

    Returns a sentence where the colour configuration has no such view, "" where it has.
    """
    view = scene.view_settings
    view.look, view.exposure, view.gamma = "None", 0.0, 1.0
    for name in PLAIN_VIEWS:
        with contextlib.suppress(TypeError):  # the configuration has none of that name
            view.view_transform = name
            return ""
    return (f"The colour configuration has no view {' or '.join(PLAIN_VIEWS)}, which shows footage unchanged; it is "
            f"shown by {view.view_transform}: choose another in the scene's colour management.")


def has_plain_view(scene: Any) -> bool:
    """Return whether the view transform shows pictures unchanged, as `set_plain_view` sets it."""
    view = scene.view_settings
    return (view.view_transform in PLAIN_VIEWS and view.look == "None" and (view.exposure, view.gamma) == (0.0, 1.0)
            and not view.use_curve_mapping)


def render_frames(scene: Any, frames: Iterable[int], path_of: Callable[[int, str], Path],
                  done: Callable[[int], None] = lambda _frame: None) -> None:
    """Render frames through the compositor, each to a half-float EXR and an 8 bit PNG, written atomically.

    path_of: the file for a frame's number and a suffix (".exr", ".png"). The EXR is scene-linear, the PNG is as the
    scene's view transform shows it. done: called after each frame. Raises FrameError.
    """
    if hasattr(scene.render, "compositor_device"):
        scene.render.compositor_device = "CPU"
    for frame in frames:
        scene.frame_set(frame)
        bpy.ops.render.render(scene=scene.name)
        for suffix in (".exr", ".png"):
            _set_format(scene.render.image_settings, suffix)
            with atomic_path(path_of(frame, suffix)) as temporary:
                try:
                    _render_result().save_render(str(temporary), scene=scene)
                except RuntimeError as problem:
                    raise _incomplete_file(temporary) from problem
                if not _is_complete(temporary):
                    raise _incomplete_file(temporary)
        done(frame)


_END_MARKS = {".png": b"IEND", ".blend": b"ENDB"}
_LAST_BLOCK = 32
"""Largest size in bytes of the last block of a file; the block has the mark at its start or before a checksum."""


def _is_complete(path: Path) -> bool:
    """Return whether a file that Blender wrote is complete; Blender does not report a disk that became full."""
    if path.suffix == ".exr":
        return path.stat().st_size > 0 and not is_exr_truncated(path)
    return _END_MARKS[path.suffix] in path.read_bytes()[-_LAST_BLOCK:]


def _incomplete_file(path: Path) -> FrameError:
    """Return the error for a file that Blender could not write."""
    return FrameError(f"Blender could not write a complete file to {path.parent}; make room there, or choose another "
                      "folder.")


def _render_result() -> Any:
    """Return the image of the last render."""
    return next(image for image in bpy.data.images if image.type == "RENDER_RESULT")


def _set_format(settings: Any, suffix: str) -> None:
    """Set the image format for files with this suffix."""
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format = "OPEN_EXR" if suffix == ".exr" else "PNG"
    settings.color_mode = "RGBA" if suffix == ".exr" else "RGB"
    settings.color_depth = "16" if suffix == ".exr" else "8"
    if suffix == ".exr":
        settings.exr_codec = "ZIP"


def save_blend(path: Path) -> None:
    """Save the .blend at `path` atomically, with relative paths where possible. Raises FrameError."""
    preferences = bpy.context.preferences.filepaths
    versions = preferences.save_version
    preferences.save_version = 0  # no .blend1 backup of the temporary file
    try:
        with atomic_path(path) as temporary:
            try:
                # The first save gives the file a place, to which paths can be relative; the second stores these paths.
                bpy.ops.wm.save_as_mainfile(filepath=os.fspath(temporary))
                for image in bpy.data.images:
                    if image.source == "SEQUENCE":
                        image.filepath = blend_relative(absolute(image.filepath))
                bpy.ops.wm.save_as_mainfile(filepath=os.fspath(temporary), compress=False)
            except RuntimeError as problem:
                raise _incomplete_file(temporary) from problem
            if not _is_complete(temporary):
                raise _incomplete_file(temporary)
    finally:
        preferences.save_version = versions
