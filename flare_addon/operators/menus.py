# SPDX-License-Identifier: GPL-3.0-or-later
"""Entries in Blender's menus, so that the search (F3) finds them too: File > Import, Render, Object, and the context
menu of objects. `add_flare` has the entry in Add > Light."""
from __future__ import annotations

from typing import Any

import bpy

from .. import handbook, looks
from ..reports import GuardedOperator
from .add_flare import FITFLARE_OT_add_library_flare
from .bake import FITFLARE_OT_bake
from .capture import FITFLARE_OT_import_capture
from .look import FITFLARE_OT_open_flare


class FITFLARE_OT_choose_flare(GuardedOperator, bpy.types.Operator):
    """Choose the flare of the active object in the list of the panel Look, where its sliders are"""

    bl_idname = "fit_flare.choose_flare"
    bl_label = "Show Flare in Panel"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return "" if _row_of(context) is not None else "The active object has no flare"

    def act(self, context: bpy.types.Context) -> None:
        row = _row_of(context)
        assert row is not None
        context.scene.fit_flare.light = row
        space = context.space_data
        if space is not None and space.type == "VIEW_3D":
            space.show_region_ui = True


def _row_of(context: Any) -> int | None:
    """Return the index of the flare of the active object; None where it has none."""
    active = context.active_object
    rows = enumerate(context.scene.fit_flare.lights)
    return next((row for row, item in rows if active is not None and item.target == active), None)


class FITFLARE_MT_object(bpy.types.Menu):
    """The main buttons of the sidebar, in the order of the work."""

    bl_idname = "FITFLARE_MT_object"
    bl_label = "Fit Flare"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the main buttons; the menu Object of the 3D view shows this menu."""
        layout = self.layout
        layout.operator_context = "INVOKE_DEFAULT"
        # The search (F3) compares these texts: "lens flare" finds the first.
        layout.operator(FITFLARE_OT_add_library_flare.bl_idname, text="Add Lens Flare", icon="LIGHT_SUN")
        apply = layout.operator("fit_flare.apply_flare", icon="LIGHT_SUN")
        apply.add = not context.scene.fit_flare.flare
        for name, icon in (("open_flare", "FILE_FOLDER"), ("make_flare", "CAMERA_STEREO"), ("add_flare", "ADD"),
                           ("pick_light", "EYEDROPPER"), ("choose_flare", "RESTRICT_SELECT_OFF"),
                           ("pick_element", "EYEDROPPER")):
            layout.operator(f"fit_flare.{name}", icon=icon)
        layout.operator("fit_flare.reset_look", text="Reset Look", icon="LOOP_BACK")
        layout.separator()
        for name, icon in (("import_capture", "IMPORT"), ("find_lights", "VIEWZOOM"),
                           ("flare_from_footage", "FILE_MOVIE"), ("fit", "RENDER_ANIMATION"),
                           ("clean_frames", "BRUSH_DATA"),
                           ("shot_from_picture", "IMAGE_DATA")):
            layout.operator(f"fit_flare.{name}", icon=icon)
        layout.separator()
        _draw_bake(layout)
        layout.operator("fit_flare.set_up_baked", icon="NODE_COMPOSITING")
        layout.operator("fit_flare.remove_compositor", icon="X")
        layout.operator("fit_flare.save_flare", icon="FILE_TICK")
        handbook.draw_button(layout, text="Fit Flare Handbook")


def _draw_bake(layout: Any) -> None:
    layout.operator(FITFLARE_OT_bake.bl_idname, text="Bake and Composite Flares", icon="RENDER_ANIMATION"
                    ).composite = True


def _draw_import(self: Any, _context: Any) -> None:
    self.layout.operator(FITFLARE_OT_import_capture.bl_idname, text="Fit Flare Capture (.json, COLMAP)")
    self.layout.operator(FITFLARE_OT_open_flare.bl_idname, text="Flare (.flare)")


def _draw_render(self: Any, context: Any) -> None:
    if context.scene.fit_flare.flare:
        self.layout.separator()
        _draw_bake(self.layout)


def _draw_object(self: Any, _context: Any) -> None:
    self.layout.separator()
    self.layout.menu(FITFLARE_MT_object.bl_idname, icon="LIGHT_SUN")


def _draw_context(self: Any, context: Any) -> None:
    """Draw the entries for a lamp, or another object with a flare."""
    active = context.active_object
    has_flare = _row_of(context) is not None and looks.path_of(context.scene) is not None
    if active is None or not (has_flare or active.type == "LIGHT"):
        return
    layout = self.layout
    layout.separator()
    layout.operator(FITFLARE_OT_add_library_flare.bl_idname, text="Add Flare", icon="LIGHT_SUN")
    if has_flare:
        layout.operator(FITFLARE_OT_choose_flare.bl_idname, icon="RESTRICT_SELECT_OFF")


_MENUS = (("TOPBAR_MT_file_import", _draw_import), ("TOPBAR_MT_render", _draw_render),
          ("VIEW3D_MT_object", _draw_object), ("VIEW3D_MT_object_context_menu", _draw_context))
_CLASSES = (FITFLARE_OT_choose_flare, FITFLARE_MT_object)


def register() -> None:
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    for menu, draw in _MENUS:
        getattr(bpy.types, menu).append(draw)


def unregister() -> None:
    for menu, draw in reversed(_MENUS):
        getattr(bpy.types, menu).remove(draw)
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
