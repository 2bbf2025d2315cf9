# SPDX-License-Identifier: GPL-3.0-or-later
"""What the buttons do: read the properties, call the module that does it, report what went wrong."""
from __future__ import annotations

import bpy

from ..core.errors import FitFlareError
from . import compositor
from .layer_folder import LayerFolder


class FITFLARE_OT_set_up_compositor(bpy.types.Operator):
    """Put baked layers together in the compositor of this scene"""

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
    match_scene: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Match Scene",
        description="Give the scene the frames and the size of the layers",
        default=True,
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            layers = LayerFolder.open(bpy.path.abspath(self.directory))
            compositor.set_up(context.scene, layers, keep_image=self.keep_image)
            if self.match_scene:
                compositor.match_scene(context.scene, layers, layers.size())
        except FitFlareError as problem:
            self.report({"ERROR"}, str(problem))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{len(layers.files)} frames of layers set up")
        return {"FINISHED"}


def register() -> None:
    bpy.utils.register_class(FITFLARE_OT_set_up_compositor)


def unregister() -> None:
    bpy.utils.unregister_class(FITFLARE_OT_set_up_compositor)
