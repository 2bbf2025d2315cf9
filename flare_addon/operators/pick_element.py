# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that picks an element of the flare by a click in the camera view."""
from __future__ import annotations

from typing import Any

import bpy

from ...core.look.picking import brightest_element
from .. import looks, overlay, stereo
from ..reports import NO_CAMERA, NO_FLARE, GuardedOperator, report_errors
from ..views import camera_of, view_region_at

_VIEW_EVENTS = ("MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE", "TRACKPADPAN", "TRACKPADZOOM", "TIMER", "MOUSEMOVE",
                "INBETWEEN_MOUSEMOVE")
"""Events that stay Blender's while the operator waits for a click, so that the view can be zoomed."""


class FITFLARE_OT_pick_element(GuardedOperator, bpy.types.Operator):
    """Choose the ghost, streak, ring or glare that is brightest where you click in the camera view"""

    bl_idname = "fit_flare.pick_element"
    bl_label = "Pick Element"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        """Return why nothing can be picked now, for the tooltip; "" where it can."""
        state = context.scene.fit_flare
        if not state.flare or not state.lights:
            return NO_FLARE
        if context.scene.camera is None:
            return NO_CAMERA
        if bpy.app.background:
            return "Picking needs Blender's window"
        return "" if any(map(_is_camera_view, context.screen.areas)) else (
            "No 3D viewport here shows the flare through the camera: press Numpad 0 in one")

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Wait for a click."""
        context.window_manager.modal_handler_add(self)
        context.window.cursor_modal_set("EYEDROPPER")
        context.workspace.status_text_set("Click an element of the flare in the camera view; ESC to cancel")
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Pick at a click in a camera view; a click elsewhere is ignored."""
        if event.type in _VIEW_EVENTS:
            return {"PASS_THROUGH"}
        if event.type in ("ESC", "RIGHTMOUSE"):
            self.cancel(context)
            return {"CANCELLED"}
        if event.type != "LEFTMOUSE" or event.value != "PRESS":
            return {"RUNNING_MODAL"}
        view = view_at(context.screen, event.mouse_x, event.mouse_y)
        if view is None:
            return {"RUNNING_MODAL"}
        self.cancel(context)
        area, region = view
        with report_errors(self) as outcome, context.temp_override(area=area, region=region):
            if not choose_element_at(bpy.context, (event.mouse_x - region.x, event.mouse_y - region.y)):
                self.report({"INFO"}, "No element of the flare shines there")
                return {"CANCELLED"}
        return outcome.status

    def cancel(self, context: bpy.types.Context) -> None:
        """Restore cursor and status bar; Blender also calls this when it closes the window."""
        if context.window is not None:  # the window may be closed
            context.window.cursor_modal_restore()
            context.workspace.status_text_set(None)


def _is_camera_view(area: Any) -> bool:
    """Return whether an area is a 3D view through a camera."""
    return bool(area.type == "VIEW_3D" and area.spaces.active.region_3d.view_perspective == "CAMERA")


def view_at(screen: Any, x: float, y: float) -> tuple[Any, Any] | None:
    """Return area and region of the camera view at a position in the window, px; None outside, and on its sidebars."""
    for area in screen.areas:
        if _is_camera_view(area):
            region = view_region_at(area, x, y)
            if region is not None:
                return area, region
    return None


def choose_element_at(context: Any, position: tuple[float, float]) -> bool:
    """Choose the element that is brightest at a position in the region, px from its lower left corner; return whether
    there is one. Raises FitFlareError."""
    scene = context.scene
    camera = camera_of(context.space_data, scene)
    camera, eye = stereo.view_camera(scene, camera, stereo.displayed_view(context, camera))
    window = overlay.drawn_part(context, scene, camera, eye)
    if window is None:
        return False
    point = position[0] + 0.5 - window.x, window.height - (position[1] + 0.5 - window.y)
    return choose_element(scene, context.view_layer.depsgraph, camera, window.intrinsics, point, eye)


def choose_element(scene: Any, depsgraph: Any, camera: Any, intrinsics: Any, point: tuple[float, float],
                   eye: stereo.Eye = "") -> bool:
    """Choose the element that is brightest at a point, px of the intrinsics (3, 3), in the lists of the panel Look,
    which highlights it; return whether there is one. Raises FitFlareError."""
    looks.update_elements(scene)
    state, look, edits = scene.fit_flare, looks.look_of(scene), looks.edits_of(scene.fit_flare)
    flares = looks.evaluate_flares(scene, depsgraph, camera, eye=eye)
    placed = {item.name: (index, item.source) for index, item in enumerate(state.lights)
              if looks.is_placed(item, scene) and item.source in look.names}
    source_names = {name: source for name, (_, source) in placed.items()}
    names = brightest_element(look, source_names, flares, edits, intrinsics, point)
    if names is None:
        return False
    flare_name, element_name = names
    index, _ = placed[flare_name]
    item = state.lights[index]
    state.light, item.show_elements = index, True
    item.element = next(row for row, element in enumerate(item.elements) if element.name == element_name)
    return True


register, unregister = bpy.utils.register_classes_factory((FITFLARE_OT_pick_element,))
