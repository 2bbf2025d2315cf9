# SPDX-License-Identifier: GPL-3.0-or-later
"""The fit: started, gone on with, cancelled, its log and preview shown."""
from __future__ import annotations

from pathlib import Path

import bpy

from ...core.conventions.run_files import LOG, PREVIEW
from .. import engine, fits, jobs, shots
from ..paths import is_file, is_folder
from ..reports import NO_CAPTURE, Action

SHOWN_OF_A_LOG = 200_000  # bytes, its last

_keymaps: list[tuple[object, object]] = []


class FITFLARE_OT_fit(Action, bpy.types.Operator):
    """Learn the flare of every light from the footage, in the engine; Blender stays free meanwhile"""

    bl_idname = "fit_flare.fit"
    bl_label = "Fit"
    bl_options = {"UNDO"}  # the run that it names, or undoing what comes later would forget it

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return fits.why_not(context.scene)

    def act(self, context: bpy.types.Context) -> None:
        fits.start(context.scene)


class FITFLARE_OT_resume(Action, bpy.types.Operator):
    """Go on with the fit where it was stopped"""

    bl_idname = "fit_flare.resume"
    bl_label = "Resume"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if missing := engine.missing():
            return missing
        if fits.state_of(context.scene) != "resumable":
            return "There is no broken-off fit to go on with"
        return ""

    def act(self, context: bpy.types.Context) -> None:
        fits.resume(context.scene)


class FITFLARE_OT_clean_frames(Action, bpy.types.Operator):
    """Have the engine take the flares out of the frames: by the fit once it is finished, before that by a network"""

    bl_idname = "fit_flare.clean_frames"
    bl_label = "Make Clean Frames"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        capture = fits.capture_of(context.scene)
        if capture is None or not is_folder(capture / "images"):
            return NO_CAPTURE
        return engine.missing()

    def act(self, context: bpy.types.Context) -> None:
        fits.clean(context.scene)


class FITFLARE_OT_cancel(bpy.types.Operator):
    """Stop this; what is done is kept, and it can be gone on with (ESC with the mouse over this panel)"""

    bl_idname = "fit_flare.cancel"
    bl_label = "Cancel"

    folder: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return bool(jobs.running())

    def execute(self, _context: bpy.types.Context) -> set[str]:
        stopped = [job for job in jobs.running() if not self.folder or job.folder == Path(self.folder)]
        for job in stopped:
            job.stop()
        if not stopped:
            self.report({"INFO"}, "It has ended already")
            return {"CANCELLED"}
        self.report({"INFO"}, "Stopping; what is done is kept")
        return {"FINISHED"}


class FITFLARE_OT_cancel_by_key(bpy.types.Operator):
    """Stop what the engine does for this scene, where the mouse is over the panel and nothing plays"""

    bl_idname = "fit_flare.cancel_by_key"
    bl_label = "Cancel Fit Flare"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        region, screen = context.region, context.screen
        return (region is not None and region.type == "UI"
                and getattr(region, "active_panel_category", "") == "Fit Flare"
                and not (screen is not None and screen.is_animation_playing)  # which ESC is to stop then
                and bool(shots.jobs_of(context.scene)))

    def execute(self, context: bpy.types.Context) -> set[str]:
        for job in shots.jobs_of(context.scene):
            job.stop()
        self.report({"INFO"}, "Stopping; what is done is kept")
        return {"FINISHED"}


class FITFLARE_OT_show_log(bpy.types.Operator):
    """Open what the engine wrote in a text editor"""

    bl_idname = "fit_flare.show_log"
    bl_label = "Show Log"
    bl_options = {"REGISTER", "UNDO"}

    folder: bpy.props.StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        parts = []
        for name in (LOG, jobs.EVENTS, jobs.LOG):
            path = Path(self.folder, name)
            if is_file(path):
                parts.append(f"==== {path}\n{_end_of(path)}")
        if not parts:
            self.report({"ERROR"}, f"There is no log in {self.folder}.")
            return {"CANCELLED"}
        text = bpy.data.texts.get("Fit Flare Log") or bpy.data.texts.new("Fit Flare Log")
        text.from_string("\n".join(parts))
        _show(context, "TEXT_EDITOR", lambda space: setattr(space, "text", text))
        return {"FINISHED"}


def _end_of(path: Path) -> str:
    """The last of a log; why there is nothing to show where it may not be read."""
    try:
        with open(path, "rb") as file:
            file.seek(max(path.stat().st_size - SHOWN_OF_A_LOG, 0))
            return file.read().decode("utf-8", "replace")
    except OSError as problem:
        return f"(This cannot be read: {problem.strerror or problem}.)"


class FITFLARE_OT_show_preview(Action, bpy.types.Operator):
    """Open the fit's preview picture: frame, composite, scene, flare"""

    bl_idname = "fit_flare.show_preview"
    bl_label = "Show Preview"
    changes_scene = False

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        folder = fits.folder_of(context.scene)
        if folder is None or not is_file(folder / PREVIEW):
            return "The fit has not made a preview yet"
        return ""

    def execute(self, context: bpy.types.Context) -> set[str]:
        folder = fits.folder_of(context.scene)
        assert folder is not None
        image = bpy.data.images.load(str(folder / PREVIEW), check_existing=True)
        image.reload()
        _show(context, "IMAGE_EDITOR", lambda space: setattr(space, "image", image))
        return {"FINISHED"}


class FITFLARE_OT_use_result(Action, bpy.types.Operator):
    """Show the flare that this fit has learned"""

    bl_idname = "fit_flare.use_result"
    bl_label = "Use Result"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if fits.state_of(context.scene) != "finished":
            return "The fit is not finished"
        return ""

    def act(self, context: bpy.types.Context) -> None:
        folder = fits.folder_of(context.scene)
        assert folder is not None
        fits.show(context.scene, folder)


def _show(context: bpy.types.Context, kind: str, give: object) -> None:
    """Give something to an editor of that kind: one that is open, or a new window's."""
    assert callable(give)
    if context.window is None or bpy.app.background:
        return
    area = next((area for area in context.screen.areas if area.type == kind), None)
    if area is None:
        bpy.ops.wm.window_new()
        area = context.window_manager.windows[-1].screen.areas[0]
        area.type = kind
    give(area.spaces.active)


_CLASSES = (FITFLARE_OT_fit, FITFLARE_OT_resume, FITFLARE_OT_clean_frames, FITFLARE_OT_cancel,
            FITFLARE_OT_cancel_by_key, FITFLARE_OT_show_log, FITFLARE_OT_show_preview, FITFLARE_OT_use_result)


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
