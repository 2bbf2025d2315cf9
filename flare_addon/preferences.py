# SPDX-License-Identifier: GPL-3.0-or-later
"""The preferences: the engine, the weights of the removal network and the library of flares, with the buttons that
install, test and remove them.

`user_settings` reads the values.
"""
from __future__ import annotations

import sys
from typing import Any

import bpy

from . import engine, handbook, jobs, weights
from .layouts import draw_progress, label_lines
from .reports import GuardedOperator
from .user_settings import PACKAGE

NO_ONLINE_ACCESS = "Allow Online Access in Preferences > System > Network first"
"""The reason why a button that downloads is off."""
DOWNLOAD_SIZE = f"about {'3 GB, most of it CUDA,' if sys.platform == 'linux' else '1 GB'} to download once"


class FITFLARE_AP_preferences(bpy.types.AddonPreferences):
    bl_idname = PACKAGE

    engine: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Engine",
        description="The Python with torch, or the folder of its virtual environment. Empty: the engine that Set Up "
                    "Engine "
        "installed",
        subtype="FILE_PATH",
    )
    weights: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Removal Weights",
        description="File with the weights of the removal network, which makes clean frames. Empty: those that Set Up "
                    "Engine or Download Weights downloaded",
        subtype="FILE_PATH",
    )
    library: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Flare Library",
        description="Folder of the .flare files in the library. Empty: fit_flare/library in Blender's user folder, "
                    "which "
        "is kept when the extension is uninstalled",
        subtype="DIR_PATH",
    )

    def draw(self, _context: bpy.types.Context) -> None:
        """Draw the places of engine, weights and library, and the states of engine and weights."""
        layout = self.layout
        column = layout.column()
        column.use_property_split = True
        column.prop(self, "engine")
        column.prop(self, "weights")
        column.prop(self, "library")
        row = layout.row()
        row.operator("fit_flare.list_assets", icon="ASSET_MANAGER")
        row.operator("fit_flare.unlist_assets", icon="X")
        _draw_engine(layout)
        _draw_weights(layout)
        handbook.draw_button(layout, text="Handbook")


def _draw_engine(layout: Any) -> None:
    """Draw the state of the engine, of its set-up and of its test, and their buttons."""
    box = layout.box().column()
    python, test, set_up = engine.find_engine(), engine.last_test(), engine.set_up_job()
    if set_up is not None and set_up.running:
        draw_progress(box, set_up, "Setting up the engine")
        _draw_log_button(box, set_up)
        return
    if python is None:
        _, configured = engine.configured_engine()
        box.label(text="The configured engine is missing" if configured else "No engine yet", icon="ERROR")
        label_lines(box, f"{engine.missing_reason()}." if configured else
                    f"Set it up here ({DOWNLOAD_SIZE}), or name a Python with torch above.")
        if not bpy.app.online_access:
            label_lines(box, "Set Up Engine needs online access: allow it in System > Network.", "INTERNET_OFFLINE")
    else:
        box.label(text=f"Engine: {python}", icon="CHECKMARK")
    if set_up is not None and set_up.state in ("failed", "stopped"):
        label_lines(box, set_up.error, "ERROR")
        _draw_log_button(box, set_up)
    if test is not None and test.running:
        box.label(text="Testing …", icon="SORTTIME")
    elif test is not None and test.state == "done":
        result = test.result
        box.label(text=f"Fit Flare {result.get('version')}, torch {result.get('torch')}, {result.get('device')}",
                  icon="INFO")
    elif test is not None and test.error:
        label_lines(box, test.error, "ERROR")
    row = box.row()
    row.operator("fit_flare.test_engine", icon="PLAY")
    row.operator("fit_flare.set_up_engine", icon="IMPORT")
    row.operator("fit_flare.remove_engine", icon="TRASH")


def _draw_weights(layout: Any) -> None:
    """Draw whether the weights of the removal network are there, their download, and its button."""
    box, job, weights_path = layout.box().column(), weights.download_job(), weights.find_weights()
    if job is not None and job.running:
        draw_progress(box, job, "Downloading the weights")
        return
    if weights_path is not None:
        box.label(text=f"Removal weights: {weights_path}", icon="CHECKMARK")
        return
    box.label(text="No weights of the removal network", icon="INFO")
    _, configured = weights.configured_weights()
    if configured:
        label_lines(box, f"{weights.missing_reason()}.")
        return
    label_lines(box, "Clean frames by the network, and fits with Estimated Clean Frames, need them (20 MB). "
                + ("Set Up Engine downloads them too." if weights.published_url() else
                   "This extension was not installed from a repository that offers them: name their file above."))
    set_up = engine.set_up_job()
    error = job.error if job is not None else ""
    if not error and set_up is not None:
        error = str(set_up.result.get("weights_error", ""))
    if error:
        label_lines(box, error, "ERROR")
    if weights.published_url():
        box.row().operator("fit_flare.download_weights", icon="IMPORT")


def _draw_log_button(layout: Any, job: jobs.Job) -> None:
    """Draw the button that shows the log of a job."""
    row = layout.row()
    row.alignment = "LEFT"
    row.operator("fit_flare.show_log", icon="TEXT", text="Log").folder = str(job.folder)


class FITFLARE_OT_test_engine(GuardedOperator, bpy.types.Operator):
    """Start the engine and show its version and device"""

    bl_idname = "fit_flare.test_engine"
    bl_label = "Test"
    changes_scene = False

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        if engine.find_engine() is None:
            return "No engine is set up or configured"
        return ""

    def act(self, _context: bpy.types.Context) -> None:
        engine.test_engine()


class FITFLARE_OT_set_up_engine(GuardedOperator, bpy.types.Operator):
    """Install the engine (torch and its libraries; downloads 1 GB, on Linux 3 GB) into a folder of the extension"""

    bl_idname = "fit_flare.set_up_engine"
    bl_label = "Set Up Engine"
    changes_scene = False

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        if not bpy.app.online_access:
            return NO_ONLINE_ACCESS
        job = engine.set_up_job()
        if job is not None and job.running:
            return "The engine is being set up"
        return "The engine is running; wait for it, or cancel it" if jobs.running() else ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not engine.is_set_up():
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self, event, title="Set the engine up again?", message="The installed engine is removed first",
            confirm_text="Set Up Again")

    def act(self, _context: bpy.types.Context) -> None:
        engine.set_up_engine()


class FITFLARE_OT_download_weights(GuardedOperator, bpy.types.Operator):
    """Download the weights of the removal network (20 MB) from the repository of this extension"""

    bl_idname = "fit_flare.download_weights"
    bl_label = "Download Weights"
    changes_scene = False

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        if not bpy.app.online_access:
            return NO_ONLINE_ACCESS
        if weights.find_weights() is not None:
            return "The weights are installed already"
        return "" if weights.published_url() else "This extension was not installed from a repository that offers them"

    def act(self, _context: bpy.types.Context) -> None:
        weights.download_weights()


class FITFLARE_OT_remove_engine(GuardedOperator, bpy.types.Operator):
    """Delete the engine that Set Up Engine installed, and free its disk space"""

    bl_idname = "fit_flare.remove_engine"
    bl_label = "Remove"
    changes_scene = False

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        if not engine.is_set_up():
            return "No engine was installed here; an engine that is set by its path is not deleted"
        return ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(
            self, event, title="Remove the engine?", message="Set Up Engine installs it again", confirm_text="Remove")

    def act(self, _context: bpy.types.Context) -> None:
        engine.remove_engine()


_CLASSES = (FITFLARE_AP_preferences, FITFLARE_OT_test_engine, FITFLARE_OT_set_up_engine, FITFLARE_OT_remove_engine,
            FITFLARE_OT_download_weights)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
