# SPDX-License-Identifier: GPL-3.0-or-later
"""What the user sets once: where the Python with the engine is."""
from __future__ import annotations

import bpy

# The extension's full name ("bl_ext.user_default.fit_flare"), by which Blender knows its preferences.
PACKAGE = __package__.rpartition(".")[0]


class FITFLARE_AP_preferences(bpy.types.AddonPreferences):
    bl_idname = PACKAGE

    engine: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Engine",
        description="The Python that has torch, or the folder of its virtual environment",
        subtype="FILE_PATH",
    )

    def draw(self, _context: bpy.types.Context) -> None:
        self.layout.prop(self, "engine")


def engine_path() -> str:
    """The engine set in the preferences; "" where none is, or the extension is not enabled."""
    for name, addon in bpy.context.preferences.addons.items():
        if name.rpartition(".")[2] == "fit_flare" and addon.preferences is not None:
            return bpy.path.abspath(addon.preferences.engine)
    return ""


def register() -> None:
    bpy.utils.register_class(FITFLARE_AP_preferences)


def unregister() -> None:
    bpy.utils.unregister_class(FITFLARE_AP_preferences)
