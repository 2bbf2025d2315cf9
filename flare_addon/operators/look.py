# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that open a .flare, add flares to objects, remove them, and reset sliders; the lists of flares."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...core.errors import FitFlareError
from .. import lamp_drive, looks
from ..compositor import drivers
from ..properties import EDIT_NAMES
from ..reports import NO_FLARE, GuardedOperator


def _look_items(_self: Any, context: Any) -> list[tuple[str, str, str]]:
    """Return the lights of the scene's .flare as menu items, kept here since Blender holds no reference to the
    texts."""
    global _items
    try:
        _items = [(name, name, f"The look of {name}") for name in looks.look_of(context.scene).names]
    except FitFlareError:
        _items = []
    return _items or [("", "None", "No flare is open")]


_items: list[tuple[str, str, str]] = []


class FITFLARE_OT_open_flare(GuardedOperator, bpy.types.Operator):
    """Show a .flare in this scene, at the lights of the same names or the selected objects"""

    bl_idname = "fit_flare.open_flare"
    bl_label = "Open Flare"
    bl_options = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(name="Flare", description="A .flare file", subtype="FILE_PATH",  # type: ignore[valid-type]
                                       options={"SKIP_SAVE"})  # else the last value would count as a dropped file
    filter_glob: bpy.props.StringProperty(default="*.flare", options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if self.filepath:  # dropped
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> None:
        selected = [item for item in context.selected_objects if item.type != "CAMERA"]
        look = looks.show_look(context.scene, Path(bpy.path.abspath(self.filepath)), selected)
        self.report({"INFO"}, f"{Path(self.filepath).name}: {len(look.lights)} lights, {look.count} Gaussians")
        lamp_drive.report_dark(self, context.scene)


class FITFLARE_OT_add_flare(GuardedOperator, bpy.types.Operator):
    """Add a flare at each selected object, with the look of a light of the .flare"""

    bl_idname = "fit_flare.add_flare"
    bl_label = "Flare from Selected"
    bl_options = {"REGISTER", "UNDO"}

    source: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Look", description="The light of the .flare whose look the selected objects get", items=_look_items)

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if not context.scene.fit_flare.flare:
            return NO_FLARE
        if not any(item.type != "CAMERA" for item in context.selected_objects):
            return "Select the objects that get a flare first"
        return ""

    def act(self, context: bpy.types.Context) -> None:
        """Add the flares; name the objects that already have a flare from this light of the .flare, which get no second
        one, and the cameras, which get none."""
        scene, look = context.scene, looks.look_of(context.scene)
        source, skipped, cameras = self.source or look.names[0], list[str](), list[str]()
        placed = {(item.target, item.source) for item in scene.fit_flare.lights}
        for item in context.selected_objects:
            if (item, source) in placed:
                skipped.append(item.name)
            elif item.type == "CAMERA":
                cameras.append(item.name)
            else:
                looks.add_flare(scene, item, source)
        if cameras:
            self.report({"WARNING"}, f"{', '.join(sorted(cameras))}: a camera gets no flare")
        if skipped:
            others = ". Adjust Last Operation offers the other lights of the .flare" if len(look.names) > 1 else ""
            names = ", ".join(sorted(skipped))
            self.report({"WARNING"}, f"{names}: already has a flare from the light {source}{others}")
        lamp_drive.report_dark(self, context.scene)


class FITFLARE_OT_remove_flare(GuardedOperator, bpy.types.Operator):
    """Remove this flare from the scene; its light object is kept"""

    bl_idname = "fit_flare.remove_flare"
    bl_label = "Remove Flare"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        state = context.scene.fit_flare
        if not 0 <= state.light < len(state.lights):
            return "There is no flare to remove"
        return ""

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove the chosen flare; warn where its layer stays in the compositor."""
        state = context.scene.fit_flare
        name = state.lights[state.light].name
        if state.light in drivers.connected_flares(context.scene).values():
            self.report({"WARNING"}, f"The layer of {name} stays in the compositor as it was baked; bake again to "
                        "remove it")
        looks.remove_flare(context.scene, state.light)
        state.light = max(min(state.light, len(state.lights) - 1), 0)
        return {"FINISHED"}


class FITFLARE_OT_remove_lost_flares(GuardedOperator, bpy.types.Operator):
    """Remove every flare whose light object was deleted from the scene"""

    bl_idname = "fit_flare.remove_lost_flares"
    bl_label = "Remove Flares of Deleted Lights"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return "" if looks.lost_flares(context.scene) else "Every flare has its light object"

    def act(self, context: bpy.types.Context) -> None:
        state, lost = context.scene.fit_flare, looks.lost_flares(context.scene)
        for index in reversed(lost):
            looks.remove_flare(context.scene, index)
        state.light = max(min(state.light, len(state.lights) - 1), 0)
        self.report({"INFO"}, f"{len(lost)} flares removed; their layers stay as they were baked")


class FITFLARE_OT_reset_look(bpy.types.Operator):
    """Reset every slider: the flare is as filmed"""

    bl_idname = "fit_flare.reset_look"
    bl_label = "Reset"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Reset the sliders of all flares together, of each flare and of each element."""
        state = context.scene.fit_flare
        for sliders in (state.master, *state.lights, *(part for item in state.lights for part in item.elements)):
            for name in (*EDIT_NAMES, "moved_sliders"):
                sliders.property_unset(name)
        return {"FINISHED"}


class FITFLARE_FH_flare(bpy.types.FileHandler):
    """Opens a .flare that is dropped on a 3D view."""

    bl_idname = "FITFLARE_FH_flare"
    bl_label = "Fit Flare Look"
    bl_import_operator = "fit_flare.open_flare"
    bl_file_extensions = ".flare"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return bool(context.area and context.area.type == "VIEW_3D")


class FITFLARE_UL_lights(bpy.types.UIList):
    """The list of the flares of a scene, with mute and solo."""

    def draw_item(self, context: Any, layout: Any, _data: Any, item: Any, _icon: Any, _active: Any, _property: Any,
                  _index: int = 0) -> None:
        row = layout.row(align=True)
        icon = "LIGHT_SUN" if looks.is_placed(item, context.scene) else "ERROR"
        row.prop(item, "name", text="", emboss=False, icon=icon)
        row.prop(item, "intensity", text="", emboss=False)
        row.prop(item, "solo", text="", icon="SOLO_ON" if item.solo else "SOLO_OFF", emboss=False)
        row.prop(item, "mute", text="", icon="HIDE_ON" if item.mute else "HIDE_OFF", emboss=False)


class FITFLARE_UL_elements(bpy.types.UIList):
    """The list of the elements of a flare, with mute and solo; elements that the look lacks are left out."""

    def filter_items(self, _context: Any, data: Any, property_name: str) -> tuple[list[int], list[int]]:
        """Return the flags that show or hide each item, and their order, for Blender's list."""
        elements, helpers = getattr(data, property_name), bpy.types.UI_UL_list
        # Without this flag (before Blender 4.4), Blender itself inverts the filter.
        hide_flag = getattr(self, "bitflag_item_never_show", 0)
        flags = helpers.filter_items_by_name(self.filter_name, self.bitflag_filter_item, elements, "name",
                                             reverse=bool(hide_flag and self.use_filter_invert))
        is_inverted_later = not hide_flag and self.use_filter_invert
        hide, show = (self.bitflag_filter_item, 0) if is_inverted_later else (hide_flag, self.bitflag_filter_item)
        flags = flags or [show] * len(elements)
        order = helpers.sort_items_by_name(elements, "name") if self.use_filter_sort_alpha else []
        return [hide if element.is_absent else flag for element, flag in zip(elements, flags, strict=True)], order

    def draw_item(self, _context: Any, layout: Any, _data: Any, item: Any, _icon: Any, _active: Any, _property: Any,
                  _index: int = 0) -> None:
        row = layout.row(align=True)
        row.label(text=item.name.capitalize())
        row.prop(item, "intensity", text="", emboss=False)
        row.prop(item, "solo", text="", icon="SOLO_ON" if item.solo else "SOLO_OFF", emboss=False)
        row.prop(item, "mute", text="", icon="HIDE_ON" if item.mute else "HIDE_OFF", emboss=False)


_CLASSES = (FITFLARE_OT_open_flare, FITFLARE_OT_add_flare, FITFLARE_OT_remove_flare, FITFLARE_OT_remove_lost_flares,
            FITFLARE_OT_reset_look,
            FITFLARE_FH_flare, FITFLARE_UL_lights, FITFLARE_UL_elements)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
