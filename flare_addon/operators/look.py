# SPDX-License-Identifier: GPL-3.0-or-later
"""The look: a .flare opened, flares given to objects, sliders put back."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...core.errors import FitFlareError
from .. import looks
from ..compositor import drivers
from ..properties import EDIT_NAMES
from ..reports import NO_FLARE, Action


def _sources(_self: Any, context: Any) -> list[tuple[str, str, str]]:
    """The lights of the scene's .flare, for a menu; kept, since Blender holds no reference to the texts."""
    global _shown
    try:
        _shown = [(name, name, f"The look of {name}") for name in looks.look_of(context.scene).names]
    except FitFlareError:
        _shown = []
    return _shown or [("", "None", "No flare is open")]


_shown: list[tuple[str, str, str]] = []


class FITFLARE_OT_open_flare(Action, bpy.types.Operator):
    """Show a .flare in this scene: its flares come from the lights of the same names, or the selected objects"""

    bl_idname = "fit_flare.open_flare"
    bl_label = "Open Flare"
    bl_options = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(name="Flare", description="A .flare file", subtype="FILE_PATH",  # type: ignore[valid-type]
                                       options={"SKIP_SAVE"})  # else the last one would pass for one that was dropped
    filter_glob: bpy.props.StringProperty(default="*.flare", options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if self.filepath:  # dropped
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> None:
        look = looks.use(context.scene, Path(bpy.path.abspath(self.filepath)))
        free = [item for item in context.scene.fit_flare.lights if item.target is None]
        chosen = [item for item in context.selected_objects if item.type != "CAMERA"]
        for item, target in zip(free, chosen, strict=False):
            item.target = target
        self.report({"INFO"}, f"{Path(self.filepath).name}: {len(look.lights)} lights, {look.count} Gaussians")


class FITFLARE_OT_add_flare(Action, bpy.types.Operator):
    """Let the selected objects flare with the look of a light of the .flare"""

    bl_idname = "fit_flare.add_flare"
    bl_label = "Flare from Selected"
    bl_options = {"REGISTER", "UNDO"}

    source: bpy.props.EnumProperty(name="Look", description="Which light's look they get", items=_sources)  # type: ignore[valid-type]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if not context.scene.fit_flare.flare:
            return NO_FLARE
        if not any(item.type != "CAMERA" for item in context.selected_objects):
            return "Select the objects that are to flare first"
        return ""

    def act(self, context: bpy.types.Context) -> None:
        look = looks.look_of(context.scene)
        for item in context.selected_objects:
            if item.type != "CAMERA":
                looks.add_instance(context.scene, item, self.source or look.names[0])


class FITFLARE_OT_remove_flare(Action, bpy.types.Operator):
    """Take this flare out of the scene; its light object stays"""

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
        state = context.scene.fit_flare
        name = state.lights[state.light].name
        if state.light in drivers.wired(context.scene).values():
            self.report({"WARNING"}, f"The layer of {name} stays in the compositor as it was baked; bake again to have "
                        "it go")
        looks.remove(context.scene, state.light)
        state.light = max(min(state.light, len(state.lights) - 1), 0)
        return {"FINISHED"}


class FITFLARE_OT_reset_look(bpy.types.Operator):
    """Put every slider back: the flare as it was filmed"""

    bl_idname = "fit_flare.reset_look"
    bl_label = "Reset"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        state = context.scene.fit_flare
        for sliders in (state.master, *state.lights, *(part for item in state.lights for part in item.elements)):
            for name in EDIT_NAMES:
                sliders.property_unset(name)
        return {"FINISHED"}


class FITFLARE_FH_flare(bpy.types.FileHandler):
    """A .flare dropped into the 3D viewport is shown in the scene."""

    bl_idname = "FITFLARE_FH_flare"
    bl_label = "Fit Flare Look"
    bl_import_operator = "fit_flare.open_flare"
    bl_file_extensions = ".flare"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return bool(context.area and context.area.type == "VIEW_3D")


class FITFLARE_UL_lights(bpy.types.UIList):
    """The flares of a scene, with mute and solo."""

    def draw_item(self, context: Any, layout: Any, _data: Any, item: Any, _icon: Any, _active: Any, _property: Any,
                  _index: int = 0) -> None:
        row = layout.row(align=True)
        icon = "LIGHT_SUN" if looks.is_placed(item, context.scene) else "ERROR"
        row.prop(item, "name", text="", emboss=False, icon=icon)
        row.prop(item, "intensity", text="", emboss=False)
        row.prop(item, "solo", text="", icon="SOLO_ON" if item.solo else "SOLO_OFF", emboss=False)
        row.prop(item, "mute", text="", icon="HIDE_ON" if item.mute else "HIDE_OFF", emboss=False)


class FITFLARE_UL_elements(bpy.types.UIList):
    """The elements of a flare, with mute and solo."""

    def draw_item(self, _context: Any, layout: Any, _data: Any, item: Any, _icon: Any, _active: Any, _property: Any,
                  _index: int = 0) -> None:
        row = layout.row(align=True)
        row.label(text=item.name.capitalize())
        row.prop(item, "intensity", text="", emboss=False)
        row.prop(item, "solo", text="", icon="SOLO_ON" if item.solo else "SOLO_OFF", emboss=False)
        row.prop(item, "mute", text="", icon="HIDE_ON" if item.mute else "HIDE_OFF", emboss=False)


_CLASSES = (FITFLARE_OT_open_flare, FITFLARE_OT_add_flare, FITFLARE_OT_remove_flare, FITFLARE_OT_reset_look,
            FITFLARE_FH_flare, FITFLARE_UL_lights, FITFLARE_UL_elements)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
