# SPDX-License-Identifier: GPL-3.0-or-later
"""The cameras of stereo renders: one for each view of a scene, placed and shifted as Blender does it.

In Stereo 3D the camera object moves to the left and to the right eye, by the stereo settings of its data. In Multi-View
each view has a camera object of its own, by the suffix of its name. `shots` bakes every view, `overlay` draws the one
that a 3D view shows. The formulas are those of Blender's BKE_camera_multiview_model_matrix and
BKE_camera_multiview_shift_x.
"""
from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from mathutils import Matrix

from ..core.capture import Camera
from . import cameras

Eye = Literal["", "left", "right"]
"""The eye to which a camera moves, by the name of Blender's view; "" for a camera that stays."""
EYES: tuple[Eye, Eye] = ("left", "right")


@dataclass(frozen=True)
class RenderView:
    """One view of a scene's renders, as a camera object sees it.

    name: of Blender's view, "" where a scene renders a single picture. camera: the camera object. label: name of the
    view's sequence of layers, such as "Camera_L".
    """

    name: str
    camera: Any
    eye: Eye
    label: str


def rendered_views(render: Any) -> list[Any]:
    """Return the views that a scene renders, of its render settings; [] for a scene that renders a single picture."""
    if not render.use_multiview:
        return []
    return [view for view in render.views if view.use and (render.views_format == "MULTIVIEW" or view.name in EYES)]


def camera_views(scene: Any, camera: Any) -> list[RenderView]:
    """Return the views that the scene renders with a camera object; a single one with the name "" without stereo."""
    views = rendered_views(scene.render)
    if not views:
        return [RenderView("", camera, "", camera.name)]
    suffixes = view_suffixes(scene.render)
    base = camera.name if scene.render.views_format == "STEREO_3D" else _base_name(scene.render, camera)
    return [RenderView(view.name, *view_camera(scene, camera, view.name), f"{base}{suffixes[view.name]}")
            for view in views]


def view_suffixes(render: Any) -> dict[str, str]:
    """Return a distinct suffix of each rendered view, by its name: that of the view, else an underscore and its name.
    """
    views = rendered_views(render)
    suffixes = [view.file_suffix for view in views]
    return {view.name: view.file_suffix if suffixes.count(view.file_suffix) == 1 else f"_{view.name}"
            for view in views}


def possible_labels(render: Any, name: str) -> set[str]:
    """Return the labels that views of a camera of this name can have, in any stereo mode."""
    return {f"{name}{suffix}" for view in render.views for suffix in (view.file_suffix, f"_{view.name}")}


def _base_name(render: Any, camera: Any) -> str:
    """Return the name of a camera object without the suffix of a view, the longest where several match."""
    matching = [view.file_suffix for view in render.views if camera.name.endswith(view.file_suffix)]
    return str(camera.name.removesuffix(max(matching, key=len, default="")))


def view_camera(scene: Any, camera: Any, name: str) -> tuple[Any, Eye]:
    """Return the camera object and the eye of the view of this name; the camera itself for "".

    camera: that of the scene, or of a 3D view.
    """
    render = scene.render
    if not name:
        return camera, ""
    if render.views_format == "STEREO_3D":
        return camera, "right" if name == "right" else "left"
    if not any(camera.name.endswith(view.file_suffix) for view in render.views):
        return camera, ""
    suffix = render.views[name].file_suffix if name in render.views else name
    return scene.objects.get(_base_name(render, camera) + suffix, camera), ""


def displayed_view(context: Any, camera: Any) -> str:
    """Return the name of the view that the 3D view of a context shows through a camera; "" for the camera itself.

    Settings of the 3D view and of the window make Blender show one eye, both in turn, or the camera itself. The matrix
    with which it draws tells which.
    """
    scene, depsgraph = context.scene, context.view_layer.depsgraph
    if not scene.render.use_multiview:
        return ""

    def difference(name: str) -> float:
        viewed_camera, eye = view_camera(scene, camera, name)
        matrix = eye_matrix(viewed_camera.evaluated_get(depsgraph), eye).normalized()
        return float(np.abs(np.array(matrix.inverted_safe()) - np.array(context.region_data.view_matrix)).max())

    return min(("", *EYES), key=difference)


def eye_matrix(camera: Any, eye: Eye) -> Matrix:
    """Return the matrix_world (4, 4) of an evaluated camera object that is moved to an eye; its own for ""."""
    stereo = camera.data.stereo if eye and camera.type == "CAMERA" else None
    if stereo is None or stereo.pivot == eye.upper():
        return camera.matrix_world.copy()
    placed, side = camera.matrix_world.normalized(), -1.0 if eye == "left" else 1.0
    is_centred = stereo.pivot == "CENTER"
    offset = Matrix.Translation((side * stereo.interocular_distance * (0.5 if is_centred else 1.0), 0.0, 0.0))
    if stereo.convergence_mode != "TOE":
        return placed @ offset
    toe_in = Matrix.Rotation(side * math.atan(0.5 * stereo.interocular_distance / stereo.convergence_distance), 4, "Y")
    return placed @ offset @ toe_in if is_centred else placed @ toe_in @ offset @ toe_in


def eye_shift(camera: Any, eye: Eye) -> float:
    """Return what off-axis convergence adds to the shift_x of a camera object; 0 without it."""
    stereo = camera.data.stereo if eye and camera.type == "CAMERA" else None
    if stereo is None or stereo.convergence_mode != "OFFAXIS" or stereo.pivot == eye.upper():
        return 0.0
    distance = stereo.interocular_distance * (0.5 if stereo.pivot == "CENTER" else 1.0)
    # Blender takes the sensor's width here, whichever side the sensor fits.
    shift = distance / camera.data.sensor_width * camera.data.lens / stereo.convergence_distance
    return float(shift if eye == "left" else -shift)


def eye_camera(camera: Any, render: Any, eye: Eye = "") -> Camera:
    """Return the core's camera for an evaluated camera object that is moved to an eye, in Blender's world.

    render: the scene's render settings. Raises CaptureError, as `cameras.core_camera` does.
    """
    return cameras.core_camera(camera.data, eye_matrix(camera, eye), render, eye_shift(camera, eye))
