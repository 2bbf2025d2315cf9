# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of the panels in the sidebar: settings of a fit and a bake, the switches of a flare, and notes about lights
that move and stereo renders."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy

from . import baking, fits, jobs, lamp_drive, light_paths, lights, looks, stereo
from .compositor.warnings import stereo_warnings
from .layouts import label_lines, settings_column
from .paths import is_folder


def draw_switches(column: Any, scene: Any, item: Any) -> None:
    """Draw the switches for what a flare follows of its light object, and why it is dark if they make it so."""
    if item.target is None:
        return
    if lamp_drive.is_lamp(item.target):
        column.prop(item, "follow_power")
        if note := lamp_drive.reference_note(scene, item):
            label_lines(column, note, "INFO")
    column.prop(item, "follow_visibility")
    if lamp_drive.has_direction(item):
        column.prop(item, "follow_direction")
    if not lamp_drive.is_sun(item.target):
        column.prop(item, "follow_distance")
        if item.follow_distance:
            column.prop(item, "reference_distance")
    reasons = _dark_reasons(scene)
    if reasons.get(item.name) and not all(reasons.values()):
        label_lines(column, reasons[item.name], "INFO")


def _dark_reasons(scene: Any) -> dict[str, str]:
    """Return why each placed flare is dark by its switches, by name; "" for one that is not."""
    depsgraph, rendered = bpy.context.view_layer.depsgraph, lamp_drive.rendered_collections(scene)
    return {item.name: lamp_drive.dark_reason(scene, depsgraph, item, rendered) for item in scene.fit_flare.lights
            if looks.is_placed(item, scene)}


def draw_dark_reason(layout: Any, scene: Any) -> None:
    """Draw why there is no flare to see, where the switches make all flares dark."""
    reasons = _dark_reasons(scene)
    if reasons and all(reasons.values()):
        label_lines(layout, next(iter(reasons.values())), "INFO")


def _is_animated(scene: Any, light: Any) -> bool:
    """Return whether a light of the capture moves or changes."""
    return light_paths.may_move(light, scene.fit_flare.root) or light_paths.has_animated_light(light)


def light_icon(scene: Any, light: Any) -> str:
    """Return the icon of a light of the capture, another one where it moves or changes."""
    return "ANIM" if _is_animated(scene, light) else "LIGHT_POINT"


def draw_motion_note(layout: Any, scene: Any, objects: Sequence[Any]) -> None:
    """Draw what a fit does with the lights of the capture that move or change."""
    names = [lights.light_name(light) for light in objects if _is_animated(scene, light)]
    if not names:
        return
    folder = fits.capture_folder(scene)
    if folder is not None and is_folder(folder / "images"):
        label_lines(layout, f"Fitted along the animation, frame by frame: {', '.join(names)}.", "INFO")
    else:
        label_lines(layout, "Animated, but fitted where they are at the current frame, since the capture has no folder "
                            f"images: {', '.join(names)}.", "INFO")


def draw_view_transform_note(layout: Any, scene: Any, footage: Sequence[Any]) -> None:
    """Draw why a render differs from a camera view whose footage bypasses the view transform, with switches of the
    images.

    footage: background images of the camera, from `views.display_footage`.
    """
    transform = scene.view_settings.view_transform
    label_lines(layout, f"The footage behind the camera bypasses the view transform {transform}, so renders differ "
                "from this view.", "INFO")
    for image in {background.image: None for background in footage if background.source == "IMAGE"}:
        layout.prop(image, "use_view_as_render", text=f"View as Render: {image.name}", toggle=True)
    if any(background.source != "IMAGE" for background in footage):
        label_lines(layout, "A movie clip always bypasses the view transform; load its frames as an image sequence "
                            "instead.", "INFO")


def draw_bake_buttons(row: Any, state: Any) -> None:
    """Draw the buttons that bake, and composite where this is chosen: for the scene's camera, for the selected ones."""
    label = "Bake and Composite" if state.bake_composite else "Bake Layers"
    for selected in (False, True):
        icon = "OUTLINER_OB_CAMERA" if selected else "RENDER_ANIMATION"
        button = row.operator("fit_flare.bake", text="" if selected else label, icon=icon)
        button.selected, button.composite = selected, state.bake_composite


def draw_stereo_note(layout: Any, scene: Any) -> None:
    """Draw which views a bake of a stereo scene has, and what its renders do not show right."""
    if views := stereo.rendered_views(scene.render):
        names = ", ".join(view.name for view in views)
        label_lines(layout, f"Stereo: a bake has layers for each view ({names}).", "INFO")
    for warning in stereo_warnings(scene):
        label_lines(layout, warning, "ERROR")


def draw_fit_settings(layout: Any, state: Any) -> None:
    """Draw preset, mode and the limit of the width."""
    settings = settings_column(layout)
    settings.prop(state, "preset")
    settings.prop(state, "mode")
    row = settings.row(heading="Limit Width")
    row.prop(state, "limits_width", text="")
    if state.limits_width:
        row.prop(state, "width", text="")


def draw_bake_settings(layout: Any, state: Any) -> None:
    """Draw range, folder and layers of the next bake."""
    column = settings_column(layout)
    column.prop(state, "bake_range")
    if state.bake_range == "custom":
        column.prop(state, "bake_first")
        column.prop(state, "bake_last")
    column.prop(state, "layers")
    column.prop(state, "bake_live")
    column.prop(state, "bake_scene")
    column.prop(state, "bake_composite")


def draw_last_bake(layout: Any, scene: Any, job: jobs.Job | None) -> None:
    """Draw the error or the result of the last bake, which does not run; nothing without one."""
    if error := baking.last_error(scene):
        label_lines(layout, error, "ERROR")
    elif job is not None and job.error:
        label_lines(layout, job.error, "INFO" if job.state == "stopped" else "ERROR")
    elif job is not None and job.state == "done":
        count = job.result.get("frames", 0)
        label_lines(layout, f"Layers of {count} frame{'' if count == 1 else 's'} are baked.", "CHECKMARK")
        for warning in job.warnings:
            label_lines(layout, warning, "ERROR")
