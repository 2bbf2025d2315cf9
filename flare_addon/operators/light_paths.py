# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the Movie Clip Editor: tracks as lights, and the lights of lights.json as tracks.

`editor_panels` has their buttons.
"""
from __future__ import annotations

import bpy

from .. import light_paths
from ..reports import GuardedOperator


def _clip(context: bpy.types.Context) -> bpy.types.MovieClip | None:
    """Return the clip of the editor, or the scene's active clip."""
    return getattr(context, "edit_movieclip", None) or context.scene.active_clip


class _ClipOperator(GuardedOperator):
    changes_scene = False

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return "" if _clip(context) is not None else "Open the frames as a clip first"


class FITFLARE_OT_lights_from_tracks(_ClipOperator, bpy.types.Operator):
    """Write the tracks of this clip to the lights.json beside its frames; each track becomes a light of its name"""

    bl_idname = "fit_flare.lights_from_tracks"
    bl_label = "Tracks to Lights"

    only_selected: bpy.props.BoolProperty(name="Selected Only", description="Leave out tracks that are not selected")  # type: ignore[valid-type]

    def act(self, context: bpy.types.Context) -> None:
        count = light_paths.write_tracks(_clip(context), self.only_selected)
        self.report({"INFO"}, f"Tracks written as lights: {count}")


class FITFLARE_OT_tracks_from_lights(_ClipOperator, bpy.types.Operator):
    """Add the lights that were found in the frames as tracks, to correct their markers; doubtful markers are muted"""

    bl_idname = "fit_flare.tracks_from_lights"
    bl_label = "Lights to Tracks"
    bl_options = {"REGISTER", "UNDO"}

    def act(self, context: bpy.types.Context) -> None:
        count = light_paths.add_light_tracks(_clip(context))
        self.report({"INFO"}, f"Lights added as tracks: {count}")


register, unregister = bpy.utils.register_classes_factory(
    (FITFLARE_OT_lights_from_tracks, FITFLARE_OT_tracks_from_lights))
