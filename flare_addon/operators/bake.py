# SPDX-License-Identifier: GPL-3.0-or-later
"""Layers out, and back together in the compositor."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...core.bake.folder import LayerFolder
from ...core.errors import CaptureError
from .. import engine, jobs, render_settings, shots
from ..compositor import drivers, flare_node, setup, warnings
from ..paths import absolute, is_folder
from ..reports import NO_CAMERA, NO_FLARE, Action, reported


class FITFLARE_OT_bake(Action, bpy.types.Operator):
    """Render the flares to EXR layers in the engine, for the frames and the camera of the scene"""

    bl_idname = "fit_flare.bake"
    bl_label = "Bake Layers"
    bl_options = {"UNDO"}  # the folder that it chooses, or undoing what comes later would forget it

    selected: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Selected Cameras", description="Bake from every selected camera, each into a folder of its own",
        default=False)
    replace: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Replace Others", description="Other frames of the folder that were baked otherwise may go",
        default=False, options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        scene = context.scene
        if not scene.fit_flare.flare:
            return NO_FLARE
        if scene.camera is None:
            return NO_CAMERA
        if missing := engine.missing():
            return missing
        return "A bake is running" if _baking(scene) else ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        lost: list[int] = []
        with reported(self) as outcome:
            lost = shots.replaced(context.scene, self._chosen(context))
        if outcome.status == {"CANCELLED"}:
            return outcome.status
        self.replace = True  # none go, or someone says that they may
        if not lost:
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self, event, title="Replace Layers", confirm_text="Replace",
            message=shots.losing(shots.layers_folder(context.scene), lost))

    def act(self, context: bpy.types.Context) -> None:
        shots.bake(context.scene, self._chosen(context), others_may_go=self.replace)

    def _chosen(self, context: bpy.types.Context) -> list[Any]:
        """The cameras to bake from; none for the scene's own. Raises CaptureError where none is selected."""
        if not self.selected:
            return []
        found = [item for item in context.selected_objects if item.type == "CAMERA"]
        if not found:
            raise CaptureError("No camera is selected; select those to bake from.")
        return found


def _baking(scene: Any) -> bool:
    """Whether the engine is at work on this scene's layers."""
    job = jobs.find(shots.layers_folder(scene)) if scene.fit_flare.layers else None
    return job is not None and job.running


def set_up(operator: Any, scene: Any, folder: str, *, keep_image: bool, plate: bool, match: bool = False) -> None:
    """Nodes for the layers in a folder, over the baked scene, what the compositor shows now (`keep_image`) or the
    footage behind the camera (`plate`); `match` gives the scene their frames and size. Raises FrameError."""
    layers = LayerFolder.open(shots.folder_of_camera(absolute(folder), scene.camera))
    setup.set_up(scene, layers, keep_image=keep_image, plate=setup.plate_of(scene) if plate else None)
    if match:
        render_settings.match_scene(scene, layers, layers.size())
    live = "; Intensity and Tint of the panel act on it" if wire(scene, layers) else ""
    for told in warnings.warnings(scene, layers, bool(live)):
        operator.report({"WARNING"}, told)
    operator.report({"INFO"}, f"{len(layers.files)} frames of layers set up{live}")


class FITFLARE_OT_set_up_compositor(Action, bpy.types.Operator):
    """Put baked layers together in the compositor of this scene, over what is there"""

    bl_idname = "fit_flare.set_up_compositor"
    bl_label = "Set Up Compositor"
    bl_options = {"REGISTER", "UNDO"}

    directory: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Layers",
        description="Folder of the baked EXR layers",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},  # else the last one would pass for one that was dropped
    )
    keep_image: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Over the Present Image",
        description="Lay the flare over what the compositor shows now, instead of the baked scene",
        default=False,
    )
    plate: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Over the Footage",
        description="Lay the flare over the frames behind the scene's camera",
        default=False,
    )
    match_scene: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Match Scene",
        description="Give the scene the frames and the size of the layers",
        default=True,
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if self.directory:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> None:
        set_up(self, context.scene, self.directory, keep_image=self.keep_image, plate=self.plate,
               match=self.match_scene)


def wire(scene: Any, layers: LayerFolder) -> bool:
    """Connect the panel's sliders to layers that this scene has baked without them; whether it was done."""
    gains = shots.live_layers(scene.fit_flare, layers.folder)
    if gains is None:
        return False
    drivers.wire(scene, gains)
    return True


class FITFLARE_OT_remove_compositor(Action, bpy.types.Operator):
    """Take Fit Flare's nodes out of the compositor; what was there before is there again"""

    bl_idname = "fit_flare.remove_compositor"
    bl_label = "Remove from Compositor"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if flare_node.find_node(context.scene) is None:
            return "The compositor is not set up"
        return ""

    def act(self, context: bpy.types.Context) -> None:
        setup.remove(context.scene)


class FITFLARE_OT_set_up_baked(Action, bpy.types.Operator):
    """Put the layers that were baked here together in the compositor"""

    bl_idname = "fit_flare.set_up_baked"
    bl_label = "Set Up Compositor"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        state = context.scene.fit_flare
        if not state.layers:
            return "Bake layers first, or choose their folder"
        return "The bake is still running" if _baking(context.scene) else ""

    def act(self, context: bpy.types.Context) -> None:
        state = context.scene.fit_flare
        set_up(self, context.scene, state.layers, keep_image=state.over == "present", plate=state.over == "plate")


class FITFLARE_OT_open_folder(bpy.types.Operator):
    """Open this folder in the system's file browser"""

    bl_idname = "fit_flare.open_folder"
    bl_label = "Open Folder"

    folder: bpy.props.StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]

    def execute(self, _context: bpy.types.Context) -> set[str]:
        if not is_folder(Path(self.folder)):
            self.report({"ERROR"}, f"The folder {self.folder} is not there any more.")
            return {"CANCELLED"}
        bpy.ops.wm.path_open(filepath=self.folder)
        return {"FINISHED"}


_CLASSES = (FITFLARE_OT_bake, FITFLARE_OT_set_up_compositor, FITFLARE_OT_set_up_baked, FITFLARE_OT_remove_compositor,
            FITFLARE_OT_open_folder)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
