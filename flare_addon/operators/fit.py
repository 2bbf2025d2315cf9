# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that start, resume and cancel a fit, make clean frames, and show log, preview and result."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from ...core.conventions.run_files import LOG, PREVIEW
from ...core.system.reading import open_regular
from .. import engine, fits, jobs, shots
from ..paths import is_file
from ..reports import GuardedOperator

MAX_LOG_BYTES = 200_000

_keymaps: list[tuple[object, object]] = []


class FITFLARE_OT_fit(GuardedOperator, bpy.types.Operator):
    """Learn the flare of every light from the footage, in the engine; you can use Blender meanwhile"""

    bl_idname = "fit_flare.fit"
    bl_label = "Fit"
    bl_options = {"UNDO"}  # else undoing a later step would reset the run that it sets

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return fits.why_not_fit(context.scene)

    def act(self, context: bpy.types.Context) -> None:
        fits.start_fit(context.scene)


class FITFLARE_OT_resume(GuardedOperator, bpy.types.Operator):
    """Resume the fit from where it was stopped"""

    bl_idname = "fit_flare.resume"
    bl_label = "Resume"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if missing := engine.missing_reason():
            return missing
        if fits.fit_state(context.scene) != "resumable":
            return "There is no stopped fit to resume"
        return ""

    def act(self, context: bpy.types.Context) -> None:
        fits.resume_fit(context.scene)


class FITFLARE_OT_flare_from_footage(GuardedOperator, bpy.types.Operator):
    """Learn the flare of a clip or a folder of frames: finds the lights, cleans the frames, fits and bakes"""

    bl_idname = "fit_flare.flare_from_footage"
    bl_label = "Flare from Footage"
    bl_options = {"UNDO"}

    filepath: bpy.props.StringProperty(name="Clip", description="A video, or a frame of a folder of frames",  # type: ignore[valid-type]
                                       subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_movie: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_image: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return engine.missing_reason() or ("A fit is running" if fits.fit_state(context.scene) == "running" else "")

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> None:
        fits.start_from_footage(context.scene, Path(bpy.path.abspath(self.filepath)))


class FITFLARE_OT_clean_frames(GuardedOperator, bpy.types.Operator):
    """Remove the flares from the frames: with the fit if it is finished, else with the removal network"""

    bl_idname = "fit_flare.clean_frames"
    bl_label = "Make Clean Frames"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return fits.why_not_clean(context.scene)

    def act(self, context: bpy.types.Context) -> None:
        fits.start_cleaning(context.scene)


class FITFLARE_OT_cancel(bpy.types.Operator):
    """Stop this job; finished work is kept, and it can be resumed (ESC with the mouse over this panel)"""

    bl_idname = "fit_flare.cancel"
    bl_label = "Cancel"

    folder: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return bool(jobs.running())

    def execute(self, _context: bpy.types.Context) -> set[str]:
        """Stop the job in `folder`; without a folder all running jobs."""
        stopped = [job for job in jobs.running() if not self.folder or job.folder == Path(self.folder)]
        for job in stopped:
            job.stop()
        if not stopped:
            self.report({"INFO"}, "The job has ended already")
            return {"CANCELLED"}
        self.report({"INFO"}, "Stopping; what is done is kept")
        return {"FINISHED"}


class FITFLARE_OT_cancel_by_key(bpy.types.Operator):
    """Stop the jobs of this scene while the mouse is over the panel and no animation plays"""

    bl_idname = "fit_flare.cancel_by_key"
    bl_label = "Cancel Fit Flare"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        region, screen = context.region, context.screen
        return (region is not None and region.type == "UI"
                and getattr(region, "active_panel_category", "") == jobs.SIDEBAR_TAB
                and not (screen is not None and screen.is_animation_playing)  # which ESC stops
                and bool(shots.running_jobs(context.scene)))

    def execute(self, context: bpy.types.Context) -> set[str]:
        for job in shots.running_jobs(context.scene):
            job.stop()
        self.report({"INFO"}, "Stopping; what is done is kept")
        return {"FINISHED"}


class FITFLARE_OT_show_log(bpy.types.Operator):
    """Open the log of the engine in a text editor"""

    bl_idname = "fit_flare.show_log"
    bl_label = "Show Log"
    bl_options = {"REGISTER", "UNDO"}

    folder: bpy.props.StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Show the logs in `folder` one below the other: the run's log, the events, and the engine's other output."""
        parts = []
        for name in (LOG, jobs.EVENTS, jobs.LOG):
            path = Path(self.folder, name)
            if is_file(path):
                parts.append(f"==== {path}\n{_tail(path)}")
        if not parts:
            self.report({"ERROR"}, f"There is no log in {self.folder}.")
            return {"CANCELLED"}
        text = bpy.data.texts.get("Fit Flare Log") or bpy.data.texts.new("Fit Flare Log")
        text.from_string("\n".join(parts))
        _show_in_editor(context, "TEXT_EDITOR", lambda space: setattr(space, "text", text))
        return {"FINISHED"}


def _tail(path: Path) -> str:
    """Return the end of a log; the reason in brackets where it cannot be read."""
    try:
        with open_regular(path) as file:
            file.seek(max(path.stat().st_size - MAX_LOG_BYTES, 0))
            return file.read().decode("utf-8", "replace")
    except OSError as problem:
        return f"(This cannot be read: {problem.strerror or problem}.)"


class FITFLARE_OT_show_preview(GuardedOperator, bpy.types.Operator):
    """Open the preview of the fit: frame, composite, scene, flare"""

    bl_idname = "fit_flare.show_preview"
    bl_label = "Show Preview"
    changes_scene = False

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        folder = fits.run_folder(context.scene)
        if folder is None or not is_file(folder / PREVIEW):
            return "The fit has no preview yet"
        return ""

    def execute(self, context: bpy.types.Context) -> set[str]:
        folder = fits.run_folder(context.scene)
        assert folder is not None
        image = bpy.data.images.load(str(folder / PREVIEW), check_existing=True)
        image.reload()
        _show_in_editor(context, "IMAGE_EDITOR", lambda space: setattr(space, "image", image))
        return {"FINISHED"}


class FITFLARE_OT_use_result(GuardedOperator, bpy.types.Operator):
    """Show the flare that this fit learned"""

    bl_idname = "fit_flare.use_result"
    bl_label = "Use Result"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if fits.fit_state(context.scene) != "finished":
            return "The fit is not finished"
        return ""

    def act(self, context: bpy.types.Context) -> None:
        folder = fits.run_folder(context.scene)
        assert folder is not None
        fits.show_result(context.scene, folder)


def _show_in_editor(context: bpy.types.Context, kind: str, show: Callable[[Any], None]) -> None:
    """Call `show` with the space of an editor of that kind, an open one or one in a new window."""
    if context.window is None or bpy.app.background:
        return
    area = next((area for area in context.screen.areas if area.type == kind), None)
    if area is None:
        bpy.ops.wm.window_new()
        area = context.window_manager.windows[-1].screen.areas[0]
        area.type = kind
    show(area.spaces.active)


_CLASSES = (FITFLARE_OT_fit, FITFLARE_OT_resume, FITFLARE_OT_flare_from_footage, FITFLARE_OT_clean_frames,
            FITFLARE_OT_cancel, FITFLARE_OT_cancel_by_key, FITFLARE_OT_show_log, FITFLARE_OT_show_preview,
            FITFLARE_OT_use_result)


def register() -> None:
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    keyconfig = bpy.context.window_manager.keyconfigs.addon
    if keyconfig is not None:  # None in the background
        keymap = keyconfig.keymaps.new("3D View Generic", space_type="VIEW_3D")
        _keymaps.append((keymap, keymap.keymap_items.new(FITFLARE_OT_cancel_by_key.bl_idname, "ESC", "PRESS")))


def unregister() -> None:
    for keymap, item in _keymaps:
        keymap.keymap_items.remove(item)  # type: ignore[attr-defined]
    _keymaps.clear()
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
