# SPDX-License-Identifier: GPL-3.0-or-later
"""What the user sets once: the engine, and the library of flares."""
from __future__ import annotations

import sys
from typing import Any

import bpy

from . import engine, jobs
from .layouts import draw_progress, lines
from .reports import Action

DOWNLOAD = f"about {'3 GB, most of it CUDA,' if sys.platform == 'linux' else '1 GB'} to download once"


class FITFLARE_AP_preferences(bpy.types.AddonPreferences):
    bl_idname = engine.PACKAGE

    engine: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Engine",
        description="The Python that has torch, or the folder of its virtual environment. Empty: the one that Set Up "
        "Engine has made",
        subtype="FILE_PATH",
    )
    library: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Flare Library",
        description="Folder of .flare files to choose from. Empty: fit_flare/library among Blender's user files, which "
        "stays when the extension is uninstalled",
        subtype="DIR_PATH",
    )

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        column = layout.column()
        column.use_property_split = True
        column.prop(self, "engine")
        column.prop(self, "library")
        _draw_engine(layout)


def _draw_engine(layout: Any) -> None:
    box = layout.box().column()
    python, test, making = engine.find(), engine.tested(), engine.setting_up()
    if making is not None and making.running:
        draw_progress(box, making, "Setting up the engine")
        _log_of(box, making)
        return
    if python is None:
        _, named = engine.named()
        box.label(text="The engine that is named is not there" if named else "No engine yet", icon="ERROR")
        lines(box, f"{engine.missing()}." if named else
              f"Set it up here ({DOWNLOAD}), or name a Python above that has torch.")
        if not bpy.app.online_access:
            lines(box, "Set Up Engine needs online access: allow it in System > Network.", "INTERNET_OFFLINE")
    else:
        box.label(text=f"Engine: {python}", icon="CHECKMARK")
    if making is not None and making.state in ("failed", "stopped"):
        lines(box, making.error, "ERROR")
        _log_of(box, making)
    if test is not None and test.running:
        box.label(text="Testing …", icon="SORTTIME")
    elif test is not None and test.state == "done":
        result = test.result
        box.label(text=f"Fit Flare {result.get('version')}, torch {result.get('torch')}, {result.get('device')}",
                  icon="INFO")
    elif test is not None and test.error:
        lines(box, test.error, "ERROR")
    row = box.row()
    row.operator("fit_flare.test_engine", icon="PLAY")
    row.operator("fit_flare.set_up_engine", icon="IMPORT")
    row.operator("fit_flare.remove_engine", icon="TRASH")


def _log_of(layout: Any, job: jobs.Job) -> None:
    row = layout.row()
    row.alignment = "LEFT"
    row.operator("fit_flare.show_log", icon="TEXT", text="Log").folder = str(job.folder)


def own() -> Any:
    """The preferences; None where the extension is not enabled (loaded from source)."""
    for name, addon in bpy.context.preferences.addons.items():
        if name.rpartition(".")[2] == "fit_flare" and addon.preferences is not None:
            return addon.preferences
    return None


def engine_path() -> str:
    """The engine set in the preferences; "" where none is, or the extension is not enabled."""
    preferences = own()
    return bpy.path.abspath(preferences.engine) if preferences is not None and preferences.engine else ""


def library_path() -> str:
    """The library's folder as set; "" where none is."""
    preferences = own()
    return bpy.path.abspath(preferences.library) if preferences is not None and preferences.library else ""


class FITFLARE_OT_test_engine(Action, bpy.types.Operator):
    """Start the engine and ask for its version and device"""

    bl_idname = "fit_flare.test_engine"
    bl_label = "Test"
    changes_scene = False

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        if engine.find() is None:
            return "No engine is set up or named"
        return ""

    def act(self, _context: bpy.types.Context) -> None:
        engine.test()


class FITFLARE_OT_set_up_engine(Action, bpy.types.Operator):
    """Install the engine (torch and its libraries, 1 GB to download, 3 on Linux) into the extension's own folder"""

    bl_idname = "fit_flare.set_up_engine"
    bl_label = "Set Up Engine"
    changes_scene = False

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        if not bpy.app.online_access:
            return "Allow Online Access in Preferences > System > Network first"
        making = engine.setting_up()
        if making is not None and making.running:
            return "The engine is being set up"
        return "The engine is at work; wait for it, or cancel it" if jobs.running() else ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not engine.was_set_up():
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self, event, title="Set the engine up again?", message="The one that is there is removed first",
            confirm_text="Set Up Again")

    def act(self, _context: bpy.types.Context) -> None:
        engine.set_up()


class FITFLARE_OT_remove_engine(Action, bpy.types.Operator):
    """Delete the engine that Set Up Engine has installed, and free its disk space"""

    bl_idname = "fit_flare.remove_engine"
    bl_label = "Remove"
    changes_scene = False

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        if not engine.was_set_up():
            return "No engine was set up here; one that is named by its path is not touched"
        return ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(
            self, event, title="Remove the engine?", message="Set Up Engine installs it again", confirm_text="Remove")

    def act(self, _context: bpy.types.Context) -> None:
        engine.remove()


_CLASSES = (FITFLARE_AP_preferences, FITFLARE_OT_test_engine, FITFLARE_OT_set_up_engine, FITFLARE_OT_remove_engine)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
