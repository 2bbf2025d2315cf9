# SPDX-License-Identifier: GPL-3.0-or-later
"""The sidebar's "Fit Flare" tab."""
from __future__ import annotations

import bpy

from . import compositor
from .operators import FITFLARE_OT_set_up_compositor


class FITFLARE_PT_compositor(bpy.types.Panel):
    bl_label = "Compositor"
    bl_idname = "FITFLARE_PT_compositor"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Fit Flare"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.operator(FITFLARE_OT_set_up_compositor.bl_idname, icon="NODE_COMPOSITING")
        node = compositor.find_node(context.scene)
        if node is not None and node.node_tree is not None:
            layout.prop(node.inputs["Intensity"], "default_value", text="Intensity")
            layout.prop(node.inputs["Tint"], "default_value", text="Tint")


def register() -> None:
    bpy.utils.register_class(FITFLARE_PT_compositor)


def unregister() -> None:
    bpy.utils.unregister_class(FITFLARE_PT_compositor)
