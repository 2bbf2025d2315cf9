# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights of the capture: added, taken from objects, removed, found."""
from __future__ import annotations

import bpy

from .. import engine, fits, lights
from ..paths import is_folder
from ..reports import NO_CAPTURE, Action


class FITFLARE_OT_add_light(Action, bpy.types.Operator):
    """Add a light at the 3D cursor; move it on to the lamp in the footage"""

    bl_idname = "fit_flare.add_light"
    bl_label = "Add at Cursor"
    bl_options = {"REGISTER", "UNDO"}

    name: bpy.props.StringProperty(name="Name", description="Name of the light and of its flare's layer",  # type: ignore[valid-type]
                                   default="light1")

    def act(self, context: bpy.types.Context) -> None:
        light = lights.add(context.scene, context.scene.cursor.location, self.name)
        for item in context.selected_objects:
            item.select_set(False)
        if context.view_layer.objects.get(light.name) == light:  # one in an excluded collection is not
            light.select_set(True)
            context.view_layer.objects.active = light


class FITFLARE_OT_lights_from_selected(Action, bpy.types.Operator):
    """Make the selected objects lights: the fit learns a flare for each"""

    bl_idname = "fit_flare.lights_from_selected"
    bl_label = "From Selected"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if not context.selected_objects:
            return "Select the objects that are lights first"
        if any(item.library is not None for item in context.selected_objects):
            return "Of what is linked from another file, make library overrides first"
        return ""

    def execute(self, context: bpy.types.Context) -> set[str]:
        taken = {lights.name_of(item) for item in lights.of_scene(context.scene)}
        made = lights.take(context.selected_objects, taken)
        self.report({"INFO"}, f"{made} objects are lights now")
        return {"FINISHED"}


class FITFLARE_OT_remove_light(bpy.types.Operator):
    """Take this light out; an empty that was made for it is deleted, other objects stay"""

    bl_idname = "fit_flare.remove_light"
    bl_label = "Remove Light"
    bl_options = {"REGISTER", "UNDO"}

    object: bpy.props.StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        light = context.scene.objects.get(self.object)
        if light is None:
            self.report({"ERROR"}, f"The light {self.object!r} is not in this scene any more.")
            return {"CANCELLED"}
        lights.remember(context.scene)
        light.fit_flare.is_light = False
        if light.fit_flare.is_made and not light.children:
            bpy.data.objects.remove(light)
        return {"FINISHED"}


class FITFLARE_OT_find_lights(Action, bpy.types.Operator):
    """Have the engine look for light sources in the frames; lights that are there already stay"""

    bl_idname = "fit_flare.find_lights"
    bl_label = "Find in Frames"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        capture = fits.capture_of(context.scene)
        if capture is None or not is_folder(capture):
            return NO_CAPTURE
        return engine.missing()

    def act(self, context: bpy.types.Context) -> None:
        fits.find_lights(context.scene)


class FITFLARE_OT_use_lights(Action, bpy.types.Operator):
    """Bring the lights that were found since into the scene"""

    bl_idname = "fit_flare.use_lights"
    bl_label = "Use Found Lights"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        capture = fits.capture_of(context.scene)
        if capture is None or not is_folder(capture):
            return NO_CAPTURE
        return "" if lights.unknown(context.scene, capture) else "All lights that were found are in the scene"

    def act(self, context: bpy.types.Context) -> None:
        capture = fits.capture_of(context.scene)
        assert capture is not None
        lights.bring_in(context.scene, capture)


_CLASSES = (FITFLARE_OT_add_light, FITFLARE_OT_lights_from_selected, FITFLARE_OT_remove_light, FITFLARE_OT_find_lights,
            FITFLARE_OT_use_lights)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
