# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that add, mark, remove and find the lights of the capture."""
from __future__ import annotations

import bpy

from .. import engine, fits, lights
from ..paths import is_folder
from ..reports import NO_CAPTURE, GuardedOperator


class FITFLARE_OT_add_light(GuardedOperator, bpy.types.Operator):
    """Add a light at the 3D cursor; then move it to the light in the footage"""

    bl_idname = "fit_flare.add_light"
    bl_label = "Add at Cursor"
    bl_options = {"REGISTER", "UNDO"}

    name: bpy.props.StringProperty(name="Name", description="Name of the light and of the layer of its flare",  # type: ignore[valid-type]
                                   default="light1")

    def act(self, context: bpy.types.Context) -> None:
        light = lights.add_to_scene(context.scene, context.scene.cursor.location, self.name)
        for item in context.selected_objects:
            item.select_set(False)
        if context.view_layer.objects.get(light.name) == light:  # not for an object in an excluded collection
            light.select_set(True)
            context.view_layer.objects.active = light


class FITFLARE_OT_lights_from_selected(GuardedOperator, bpy.types.Operator):
    """Mark the selected objects as lights; the fit learns a flare for each"""

    bl_idname = "fit_flare.lights_from_selected"
    bl_label = "From Selected"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if not context.selected_objects:
            return "Select the objects that are lights first"
        if any(item.library is not None for item in context.selected_objects):
            return "Make library overrides of the linked objects first"
        return ""

    def execute(self, context: bpy.types.Context) -> set[str]:
        used_names = {lights.light_name(item) for item in lights.scene_lights(context.scene)}
        count = lights.mark_as_lights(context.selected_objects, used_names)
        self.report({"INFO"}, f"{count} objects are lights now")
        return {"FINISHED"}


class FITFLARE_OT_remove_light(bpy.types.Operator):
    """Remove this light; an empty that was made for it is deleted, other objects are kept"""

    bl_idname = "fit_flare.remove_light"
    bl_label = "Remove Light"
    bl_options = {"REGISTER", "UNDO"}

    object: bpy.props.StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Unmark the light, and delete an empty that was made for it and has no children."""
        light = context.scene.objects.get(self.object)
        if light is None:
            self.report({"ERROR"}, f"The light {self.object!r} is not in this scene any more.")
            return {"CANCELLED"}
        lights.remember_names(context.scene)
        light.fit_flare.is_light = False
        if light.fit_flare.is_made and not light.children:
            bpy.data.objects.remove(light)
        return {"FINISHED"}


class FITFLARE_OT_find_lights(GuardedOperator, bpy.types.Operator):
    """Search the frames for lights in the engine; existing lights are kept"""

    bl_idname = "fit_flare.find_lights"
    bl_label = "Find in Frames"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        capture = fits.capture_folder(context.scene)
        if capture is None or not is_folder(capture):
            return NO_CAPTURE
        return engine.missing_reason()

    def act(self, context: bpy.types.Context) -> None:
        fits.start_light_search(context.scene)


class FITFLARE_OT_use_lights(GuardedOperator, bpy.types.Operator):
    """Add the lights that the engine found while this file was closed"""

    bl_idname = "fit_flare.use_lights"
    bl_label = "Use Found Lights"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        capture = fits.capture_folder(context.scene)
        if capture is None or not is_folder(capture):
            return NO_CAPTURE
        return "" if lights.new_light_names(context.scene, capture) else "All lights that were found are in the scene"

    def act(self, context: bpy.types.Context) -> None:
        capture = fits.capture_folder(context.scene)
        assert capture is not None
        lights.import_new_lights(context.scene, capture)


_CLASSES = (FITFLARE_OT_add_light, FITFLARE_OT_lights_from_selected, FITFLARE_OT_remove_light, FITFLARE_OT_find_lights,
            FITFLARE_OT_use_lights)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
