# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames out of a scene: its size, range and view as the footage has them, and files that are whole or absent."""
from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import bpy

from ..core.bake.folder import LayerFolder
from ..core.errors import FrameError
from ..core.images.exr import exr_is_cut_off
from ..core.system.files import atomic_path
from .paths import absolute, stored

PLAIN_VIEWS = ("Standard", "Un-tone-mapped")  # of Blender's own colour configuration, and of ACES'


def match_scene(scene: Any, layers: LayerFolder, size: tuple[int, int]) -> None:
    """Give the scene the layers' frames and size (width, height), and stand on one of those frames. Its pixels keep
    their aspect: the camera goes by that."""
    scene.frame_start, scene.frame_end = layers.first, layers.last
    if not layers.first <= scene.frame_current <= layers.last:  # where there is nothing to see
        scene.frame_set(layers.first)
    render = scene.render
    render.resolution_x, render.resolution_y = size
    render.resolution_percentage = 100


def plain_view(scene: Any) -> str:
    """Show pictures with no look and no dithering, as the footage was. Returns what `show_as_filmed` does."""
    scene.render.dither_intensity = 0.0
    return show_as_filmed(scene)


def show_as_filmed(scene: Any) -> str:
    """Show pictures as they are on the screen that they were made for; Blender's own view is AgX. Returns a sentence
    where the colour configuration has no view for it, "" where it has."""
    view = scene.view_settings
    view.look, view.exposure, view.gamma = "None", 0.0, 1.0
    for name in PLAIN_VIEWS:
        with contextlib.suppress(TypeError):  # the configuration has none of that name
            view.view_transform = name
            return ""
    return (f"The colour configuration has no view {' or '.join(PLAIN_VIEWS)}, which shows footage as it is; it is "
            f"shown by {view.view_transform}: choose another in the scene's colour management.")


def render_frames(scene: Any, frames: Iterable[int], path_of: Callable[[int, str], Path],
                  done: Callable[[int], None] = lambda _frame: None) -> None:
    """Render frames through the compositor: a half-float EXR and an 8 bit PNG each, written atomically.

    path_of: from a frame's number and a suffix (".exr", ".png") to the file. The EXR is scene-linear, the
    PNG as the scene's view shows it (see `plain_view`). done: called after each frame.
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
                    raise _unwritten(temporary) from problem
                if not _is_whole(temporary):
                    raise _unwritten(temporary)
        done(frame)


_ENDS = {".png": b"IEND", ".blend": b"ENDB"}
_LAST_BLOCK = 32
"""Bytes at most of a file's last block, which begins with its name or has it before a checksum."""


def _is_whole(path: Path) -> bool:
    """Of a file that Blender has written: it does not say so when a disk fills up meanwhile."""
    if path.suffix == ".exr":
        return path.stat().st_size > 0 and not exr_is_cut_off(path)
    return _ENDS[path.suffix] in path.read_bytes()[-_LAST_BLOCK:]


def _unwritten(path: Path) -> FrameError:
    return FrameError(f"Blender could not write a whole file to {path.parent}; make room there, or choose another "
                      "folder.")


def _render_result() -> Any:
    return next(image for image in bpy.data.images if image.type == "RENDER_RESULT")


def _set_format(settings: Any, suffix: str) -> None:
    if hasattr(settings, "media_type"):
        settings.media_type = "IMAGE"
    settings.file_format = "OPEN_EXR" if suffix == ".exr" else "PNG"
    settings.color_mode = "RGBA" if suffix == ".exr" else "RGB"
    settings.color_depth = "16" if suffix == ".exr" else "8"
    if suffix == ".exr":
        settings.exr_codec = "ZIP"


def save_beside(path: Path) -> None:
    """Save the file, with paths relative to it wherever they can be."""
    preferences = bpy.context.preferences.filepaths
    versions = preferences.save_version
    preferences.save_version = 0  # no .blend1 of a file that is made anew
    try:
        with atomic_path(path) as temporary:
            try:
                bpy.ops.wm.save_as_mainfile(filepath=os.fspath(temporary))
                for image in bpy.data.images:
                    if image.source == "SEQUENCE":
                        image.filepath = stored(absolute(image.filepath))
                bpy.ops.wm.save_as_mainfile(filepath=os.fspath(temporary), compress=False)
            except RuntimeError as problem:
                raise _unwritten(temporary) from problem
            if not _is_whole(temporary):
                raise _unwritten(temporary)
    finally:
        preferences.save_version = versions
