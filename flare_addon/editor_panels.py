# SPDX-License-Identifier: GPL-3.0-or-later
"""The tab "Fit Flare" of other editors: Look and Bake beside the compositor's nodes and beside renders, the button for
a flare over the picture of the Image Editor, and lights as tracks in the Movie Clip Editor.

Look and Bake draw what they draw in the 3D viewport (`panels`).
"""
from __future__ import annotations

import bpy

from . import handbook, jobs
from .panels import FITFLARE_PT_bake, FITFLARE_PT_look


class _NodePanel(handbook.LinkedPanel):
    """Mixin that puts a panel beside the compositor's nodes."""

    page = "editing"
    bl_space_type, bl_region_type, bl_category = "NODE_EDITOR", "UI", jobs.SIDEBAR_TAB

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bool(context.space_data.tree_type == "CompositorNodeTree")


class _ImagePanel(handbook.LinkedPanel):
    """Mixin that puts a panel beside the picture of the Image Editor, where the scene shows a flare."""

    page = "editing"
    bl_space_type, bl_region_type, bl_category = "IMAGE_EDITOR", "UI", jobs.SIDEBAR_TAB

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bool(context.scene.fit_flare.flare)


class FITFLARE_PT_node_look(_NodePanel, bpy.types.Panel):
    bl_label, bl_idname = "Look", "FITFLARE_PT_node_look"
    draw_header, draw = FITFLARE_PT_look.draw_header, FITFLARE_PT_look.draw


class FITFLARE_PT_node_bake(_NodePanel, bpy.types.Panel):
    bl_label, bl_idname = "Bake", "FITFLARE_PT_node_bake"
    draw, _draw_compositor = FITFLARE_PT_bake.draw, FITFLARE_PT_bake._draw_compositor


class FITFLARE_PT_image_picture(_ImagePanel, bpy.types.Panel):
    bl_label, bl_idname = "Picture", "FITFLARE_PT_image_picture"
    page = "transfer"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        image = context.space_data.image
        return image is not None and image.source == "FILE" and bool(image.filepath)

    def draw(self, context: bpy.types.Context) -> None:
        operator = self.layout.operator("fit_flare.shot_from_picture", text="Flare over This Picture", icon="LIGHT_SUN")
        operator.filepath = context.space_data.image.filepath


class FITFLARE_PT_image_look(_ImagePanel, bpy.types.Panel):
    bl_label, bl_idname = "Look", "FITFLARE_PT_image_look"
    draw_header, draw = FITFLARE_PT_look.draw_header, FITFLARE_PT_look.draw


class FITFLARE_PT_image_bake(_ImagePanel, bpy.types.Panel):
    bl_label, bl_idname = "Bake", "FITFLARE_PT_image_bake"
    draw, _draw_compositor = FITFLARE_PT_bake.draw, FITFLARE_PT_bake._draw_compositor


class FITFLARE_PT_clip_lights(handbook.LinkedPanel, bpy.types.Panel):
    bl_label = "Lights"
    bl_idname = "FITFLARE_PT_clip_lights"
    bl_space_type, bl_region_type, bl_category = "CLIP_EDITOR", "UI", jobs.SIDEBAR_TAB
    page = "first_fit"

    def draw(self, _context: bpy.types.Context) -> None:
        column = self.layout.column(align=True)
        column.operator("fit_flare.tracks_from_lights", icon="IMPORT")
        column.operator("fit_flare.lights_from_tracks", icon="EXPORT").only_selected = False
        column.operator("fit_flare.lights_from_tracks", text="Selected Tracks to Lights").only_selected = True


register, unregister = bpy.utils.register_classes_factory((
    FITFLARE_PT_node_look, FITFLARE_PT_node_bake, FITFLARE_PT_image_picture, FITFLARE_PT_image_look,
    FITFLARE_PT_image_bake, FITFLARE_PT_clip_lights))
