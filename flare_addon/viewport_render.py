# SPDX-License-Identifier: GPL-3.0-or-later
"""Viewport renders (playblasts) with the flare: what the camera view shows, drawn off screen and saved as pictures.

Blender's own viewport renders leave out everything that add-ons draw. Here the view is drawn scene-linear, the flare is
added as in the camera view, and the view transform is applied when a picture is saved. The operators are in
`operators.viewport_render`.
"""
from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import FrameError, SettingsError
from ..core.system.files import atomic_path
from . import overlay

HIDDEN = ("show_floor", "show_axis_x", "show_axis_y", "show_axis_z", "show_ortho_grid", "show_text", "show_stats",
          "show_cursor", "show_extras", "show_object_origins", "show_outline_selected", "show_relationship_lines",
          "show_bones", "show_motion_paths", "show_annotation")
"""Overlays that a viewport render leaves out. Footage behind the camera is an overlay too, and stays."""


PICTURE_FORMATS = {"OPEN_EXR_MULTILAYER": "OPEN_EXR"}
"""Output formats that a single picture cannot have, and their replacements. PNG replaces all video formats."""


def check_scene(scene: Any) -> None:
    """Raise SettingsError where the scene has no camera to render from."""
    if scene.camera is None or scene.camera.type != "CAMERA":
        raise SettingsError("The scene has no camera to render from; add one.")


def picture_format(scene: Any) -> str:
    """Return Blender's name of the format in which pictures are saved: PNG if the scene's output is a video."""
    file_format: str = scene.render.image_settings.file_format
    return "PNG" if scene.render.is_movie_format else PICTURE_FORMATS.get(file_format, file_format)


@contextlib.contextmanager
def _picture_output(scene: Any) -> Iterator[None]:
    """Set the output to a format and path of single pictures, if its format is a video or multilayer; restore both at
    the end."""
    render, settings = scene.render, scene.render.image_settings
    file_format = picture_format(scene)
    if file_format == settings.file_format:
        yield
        return
    # The order matters: a medium (Blender 5.0 on) limits the formats, a format limits colours and depth.
    names = ("media_type", "file_format", "color_mode", "color_depth")
    previous = {name: getattr(settings, name) for name in names if hasattr(settings, name)}
    previous_path, had_extension = render.filepath, render.use_file_extension
    try:
        if "media_type" in previous:
            settings.media_type = "IMAGE"
        settings.file_format = file_format
        render.use_file_extension = True
        if Path(previous_path).suffix.lower() in bpy.path.extensions_movie:
            render.filepath = previous_path.removesuffix(Path(previous_path).suffix)
        yield
    finally:
        render.filepath, render.use_file_extension = previous_path, had_extension
        for name, value in previous.items():
            setattr(settings, name, value)


def output_path(scene: Any, frame: int) -> Path:
    """Return the file of a frame, as a render to pictures names it."""
    with _picture_output(scene):
        return Path(bpy.path.abspath(scene.render.frame_path(frame=frame)))


def picture_size(scene: Any) -> tuple[int, int]:
    """Return width and height of the pictures."""
    render = scene.render
    width, height = (max(int(length * render.resolution_percentage / 100), 1)
                     for length in (render.resolution_x, render.resolution_y))
    return width, height


def draw_frame(context: Any, space: Any, region: Any) -> NDArray[np.float32]:
    """Draw the present frame of the scene's camera with the shading of a 3D view; return pixels (height, width, 4),
    scene-linear, row 0 at the bottom.

    space, region: the 3D view's. Needs a GPU context. Raises FitFlareError.
    """
    import gpu

    scene, depsgraph = context.scene, context.evaluated_depsgraph_get()
    width, height = picture_size(scene)
    camera = scene.camera.evaluated_get(depsgraph)
    render = scene.render
    projection = camera.calc_matrix_camera(depsgraph, x=width, y=height, scale_x=render.pixel_aspect_x,
                                           scale_y=render.pixel_aspect_y)
    target = gpu.types.GPUOffScreen(width, height, format="RGBA16F")
    try:
        with _without_overlays(space):
            target.draw_view3d(scene, context.view_layer, space, region, camera.matrix_world.inverted(), projection,
                               do_color_management=False)
        if scene.fit_flare.show and scene.fit_flare.flare and not overlay.is_composited(space, scene):
            overlay.add_to_picture(target, scene, depsgraph, scene.camera, width, height)
        with target.bind():
            rgba = gpu.state.active_framebuffer_get().read_color(0, 0, width, height, 4, 0, "FLOAT")
    finally:
        target.free()
    rgba.dimensions = width * height * 4
    return np.array(rgba, np.float32).reshape(height, width, 4)


@contextlib.contextmanager
def _without_overlays(space: Any) -> Iterator[None]:
    """Switch off the overlays of a 3D view that are no part of the picture."""
    settings = space.overlay
    previous = {name: getattr(settings, name) for name in HIDDEN if hasattr(settings, name)}
    previous_gizmo = space.show_gizmo
    try:
        space.show_gizmo = False
        for name in previous:
            setattr(settings, name, False)
        yield
    finally:
        space.show_gizmo = previous_gizmo
        for name, value in previous.items():
            setattr(settings, name, value)


def save_picture(scene: Any, pixels: NDArray[np.float32], path: Path) -> None:
    """Save pixels (height, width, 4), scene-linear, row 0 at the bottom, as the scene's output settings and view
    transform say, in `picture_format`. Raises FrameError."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new("Viewport Render", width, height, alpha=True, float_buffer=True)
    try:
        opaque = pixels.copy()
        opaque[..., 3] = 1.0
        image.pixels.foreach_set(opaque.ravel())
        with atomic_path(path) as temporary, _picture_output(scene):
            try:
                image.save_render(str(temporary), scene=scene)
            except RuntimeError as problem:
                raise FrameError(f"{path} could not be written ({problem}); choose another folder in Output."
                                 ) from problem
    finally:
        bpy.data.images.remove(image)
