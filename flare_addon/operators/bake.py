# SPDX-License-Identifier: GPL-3.0-or-later
"""Layers out, and back together in the compositor."""
from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bpy

from ...core.bake.layers import layer_names
from ...core.errors import FrameError
from .. import compositor, engine, jobs, looks, shots
from ..layer_folder import LayerFolder
from ..reports import reported


class FITFLARE_OT_bake(bpy.types.Operator):
    """Render the flares to EXR layers in the engine, for the frames and the camera of the scene"""

    bl_idname = "fit_flare.bake"
    bl_label = "Bake Layers"

    selected: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Selected Cameras", description="Bake from every selected camera, each into a folder of its own",
        default=False)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        scene = context.scene
        job = jobs.find(shots.layers_folder(scene)) if scene.fit_flare.layers else None
        if not scene.fit_flare.flare:
            cls.poll_message_set("Fit or open a flare first")
        elif scene.camera is None:
            cls.poll_message_set("The scene has no camera")
        elif engine.find() is None:
            cls.poll_message_set(engine.MISSING)
        elif job is not None and job.running:
            cls.poll_message_set("A bake is running")
        else:
            return True
        return False

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene = context.scene
        chosen = [item for item in context.selected_objects if item.type == "CAMERA"] if self.selected else []
        with reported(self) as outcome:
            shots.bake(scene, chosen or [scene.camera])
        return outcome.status


class FITFLARE_OT_set_up_compositor(bpy.types.Operator):
    """Put baked layers together in the compositor of this scene, over what is there"""

    bl_idname = "fit_flare.set_up_compositor"
    bl_label = "Set Up Compositor"
    bl_options = {"REGISTER", "UNDO"}

    directory: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Layers",
        description="Folder of the baked EXR layers",
        subtype="DIR_PATH",
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

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene = context.scene
        with reported(self) as outcome:
            layers = LayerFolder.open(bpy.path.abspath(self.directory))
            plate = footage_of(scene) if self.plate else None
            compositor.set_up(scene, layers, keep_image=self.keep_image, plate=plate)
            if self.match_scene:
                compositor.match_scene(scene, layers, layers.size())
            wired = wire(scene, layers)
            live = "; Intensity and Tint of the panel act on it" if wired else ""
            self.report({"INFO"}, f"{len(layers.files)} frames of layers set up{live}")
        return outcome.status


def footage_of(scene: Any) -> tuple[Any, int, int, int]:
    """The image behind the scene's camera and its place in time. Raises FrameError where there is none."""
    camera = scene.camera
    for back in camera.data.background_images if camera is not None and camera.type == "CAMERA" else ():
        if back.source == "IMAGE" and back.image is not None:
            user = back.image_user
            return back.image, user.frame_start, user.frame_offset, user.frame_duration
    raise FrameError("The camera has no footage behind it; lay the flare over the present image instead.")


def wire(scene: Any, layers: LayerFolder) -> bool:
    """Connect the panel's sliders to layers that this scene has baked without them; whether it was done."""
    note = layers.folder / shots.LIVE
    try:
        names = json.loads(note.read_text(encoding="utf-8"))["lights"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    present = {item.name for item in scene.fit_flare.lights}
    gains = {layer: name for name, layer in layer_names(names).items() if name in present}
    compositor.wire(scene, gains)
    return True


class FITFLARE_OT_remove_compositor(bpy.types.Operator):
    """Take Fit Flare's nodes out of the compositor; what was there before is there again"""

    bl_idname = "fit_flare.remove_compositor"
    bl_label = "Remove from Compositor"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if compositor.find_node(context.scene) is None:
            cls.poll_message_set("The compositor is not set up")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        with reported(self) as outcome:
            compositor.remove(context.scene)
        return outcome.status


class FITFLARE_OT_set_up_baked(bpy.types.Operator):
    """Put the layers that were baked here together in the compositor"""

    bl_idname = "fit_flare.set_up_baked"
    bl_label = "Set Up Compositor"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        state = context.scene.fit_flare
        if not state.layers:
            cls.poll_message_set("Bake layers first, or choose their folder")
            return False
        job = jobs.find(shots.layers_folder(context.scene))
        if job is not None and job.running:
            cls.poll_message_set("The bake is still running")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        state = context.scene.fit_flare
        with reported(self) as outcome:
            layers = LayerFolder.open(bpy.path.abspath(state.layers))
            plate = footage_of(context.scene) if state.over == "plate" else None
            compositor.set_up(context.scene, layers, keep_image=state.over == "present", plate=plate)
            wired = wire(context.scene, layers)
            live = "; Intensity and Tint of the panel act on it" if wired else ""
            self.report({"INFO"}, f"{len(layers.files)} frames of layers set up{live}")
        return outcome.status


class FITFLARE_OT_open_folder(bpy.types.Operator):
    """Open this folder in the system's file browser"""

    bl_idname = "fit_flare.open_folder"
    bl_label = "Open Folder"

    folder: bpy.props.StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]

    def execute(self, _context: bpy.types.Context) -> set[str]:
        if not Path(self.folder).is_dir():
            self.report({"ERROR"}, f"The folder {self.folder} is not there any more.")
            return {"CANCELLED"}
        bpy.ops.wm.path_open(filepath=self.folder)
        return {"FINISHED"}


_CLASSES = (FITFLARE_OT_bake, FITFLARE_OT_set_up_compositor, FITFLARE_OT_set_up_baked, FITFLARE_OT_remove_compositor,
            FITFLARE_OT_open_folder)


def register() -> None:
    for cls in _CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
    looks.forget()
