# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that import a capture, and that make one from a solved or animated camera of Blender."""
from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import bpy

from ...core.system.steps import PAUSE, Steps, finish
from .. import fits
from ..capture import exporter
from ..capture.importer import (
    ImportSettings,
    import_in_steps,
    link_objects_in_steps,
    show_frames_in_renders,
)
from ..reports import NO_CAMERA, GuardedOperator, report_errors
from ..turns import INTERVAL_S, run_turn
from ..views import look_through_camera


class FITFLARE_OT_import_capture(GuardedOperator, bpy.types.Operator):
    """Import a capture: its cameras with the frames behind them, its points and its lights"""

    bl_idname = "fit_flare.import_capture"
    bl_label = "Import Capture"
    bl_options = {"REGISTER", "UNDO"}

    directory: bpy.props.StringProperty(name="Folder", description="The capture's folder, or one inside it",  # type: ignore[valid-type]
                                        subtype="DIR_PATH", options={"SKIP_SAVE"})
    filepath: bpy.props.StringProperty(name="File", description="A file of the capture", subtype="FILE_PATH",  # type: ignore[valid-type]
                                       options={"SKIP_SAVE"})  # else the last value would count as a dropped file
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(default="*.json;*.bin;*.txt", options={"HIDDEN"})  # type: ignore[valid-type]
    cameras: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Cameras", description="How the cameras of the frames are imported",
        items=(("animated", "One, Animated", "One camera with a key for each frame; frames follow the timeline"),
               ("each", "One per Frame", "A camera object for each frame, with its picture")))
    up: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Up Axis", description="The axis that points up in the capture",
        items=(("Z", "+Z", "As in Blender, and in captures that Fit Flare solved"),
               ("-Y", "-Y", "As in many COLMAP models: y points down"), ("Y", "+Y", "As in many game engines")))
    scale: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Scale", description="Scene units per unit of the capture", default=1.0, min=1e-6, soft_max=100.0)
    frames: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Frames", description="Show the frames as background images of the cameras, in renders too, if the "
        "compositor has no nodes of your own", default=True)
    points: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Points", description="Import the point cloud as a mesh with colours", default=True)
    match_scene: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Match Scene", description="Set size, frame range and view transform of the scene to those of the frames. "
        "With Frames, also make the film of the scene transparent", default=True)

    _in_steps = False
    """Whether a person called the operator, who sees the window; a script waits for the end."""
    _is_complete = False
    """Whether all is imported, after which ESC cancels nothing."""
    _is_window_turn = False
    """Whether the present turn is the window's own."""
    _timer: Any = None
    """The timer of an import in steps; None before it and after its end."""

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        self._in_steps = True
        if self.filepath or self.directory:  # dropped into the window
            return self.execute(context)
        self.filepath = ""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        for name in ("cameras", "up", "scale", "frames", "points", "match_scene"):
            layout.prop(self, name)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Import at once for a script; for a person begin an import in steps, which `modal` goes on with."""
        with report_errors(self) as outcome:
            path = Path(bpy.path.abspath(self.filepath or self.directory))
            if not path.exists() and self.directory:
                path = Path(bpy.path.abspath(self.directory))
            settings = ImportSettings(self.cameras, self.up, self.scale, self.frames, self.points, self.match_scene)
            self._name, self._steps = path.name, self._import_and_show(context, path, settings)
            if not self._in_steps:
                finish(self._steps)
                return outcome.status
            manager = context.window_manager
            self._timer = manager.event_timer_add(INTERVAL_S, window=context.window)
            manager.modal_handler_add(self)
            context.workspace.status_text_set(f"Importing {self._name}; ESC to cancel")
            outcome.status = {"RUNNING_MODAL"}
        return outcome.status

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Go on with the import; other events wait, so that nothing else changes the scene meanwhile.

        Every other turn is left to the window, so that what Blender computes and draws after a step does not add to the
        next step. Raises ReferenceError or RuntimeError where another window deleted the scene or undid the import.
        """
        if self._timer is None:  # Blender calls an operator again whose turn raised an exception
            return {"CANCELLED", "PASS_THROUGH"}
        if event.type == "ESC" and not self._is_complete:
            self.cancel(context)
            self.report({"INFO"}, "The import was cancelled")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        self._is_window_turn = not self._is_window_turn
        if self._is_window_turn:
            return {"RUNNING_MODAL"}
        with report_errors(self) as outcome:
            try:
                if run_turn(self._steps):
                    return {"RUNNING_MODAL"}
            except (ReferenceError, RuntimeError):
                self.cancel(context)
                raise
        self.cancel(context)
        return outcome.status

    def cancel(self, context: bpy.types.Context) -> None:
        """End the import and the timer. An import that has not given the scene its camera yet leaves nothing; a later
        one is completed.

        An import that has ended is left as it is.
        """
        if self._timer is None:
            return
        context.window_manager.event_timer_remove(self._timer)
        self._timer = None
        context.workspace.status_text_set(None)
        self._steps.close()

    def _import_and_show(self, context: bpy.types.Context, path: Path, settings: ImportSettings) -> Steps[None]:
        """Import the capture at `path`, report it, and turn the view to its camera, in steps. Raises FitFlareError.

        Blender builds its dependency graph for the new camera, evaluates the compositor, loads the first picture, draws
        it, and stores an undo step at the end: each in a turn of its own. The scene gets most of the objects last.
        """
        imported = yield from import_in_steps(context.scene, path, settings)
        self._is_complete = True
        if self._in_steps:
            context.workspace.status_text_set(f"Importing {self._name}")
        try:
            fits.clear_other_run(context.scene)
            fits.expose_cameras(context.scene, fits.run_folder(context.scene))
            yield PAUSE
            for note in (*imported.notes, *show_frames_in_renders(context.scene, settings)):
                self.report({"WARNING"}, note)
            self.report({"INFO"}, f"{self._name}: cameras {len(imported.cameras)}, lights {len(imported.lights)}")
            yield PAUSE  # Blender evaluates the new compositor
            yield PAUSE
            if self._in_steps:
                _load_footage(context.scene)
                yield PAUSE
            look_through_camera(context)
            yield PAUSE
            yield from link_objects_in_steps(imported)
        except BaseException:  # GeneratorExit too: what is imported stays
            with contextlib.suppress(ReferenceError):  # deleted or undone meanwhile
                finish(link_objects_in_steps(imported))
            raise


def _load_footage(scene: bpy.types.Scene) -> None:
    """Load the picture behind the scene's camera at the current frame to the GPU; one that is missing is left out."""
    if scene.camera is None or scene.camera.type != "CAMERA":  # changed since the import's step before
        return
    for background in scene.camera.data.background_images:
        if background.image is not None:
            with contextlib.suppress(RuntimeError):
                background.image.gl_load(frame=scene.frame_current)


class FITFLARE_OT_capture_from_camera(GuardedOperator, bpy.types.Operator):
    """Make a capture from the scene's animated camera and the pictures of its background images or clip"""

    bl_idname = "fit_flare.capture_from_camera"
    bl_label = "Capture from This Camera"
    bl_options = {"REGISTER", "UNDO"}

    directory: bpy.props.StringProperty(name="Folder", description="Folder for the capture", subtype="DIR_PATH")  # type: ignore[valid-type]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if context.scene.camera is None:
            return NO_CAMERA
        if exporter.footage_of(context.scene.camera) is None:
            return "The camera has no background image sequence or movie clip to take the frames from"
        return ""

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> None:
        count = exporter.export_capture(context.scene, Path(bpy.path.abspath(self.directory)))
        fits.clear_other_run(context.scene)
        self.report({"INFO"}, f"A capture of {count} frames is in {self.directory}")


class FITFLARE_FH_capture(bpy.types.FileHandler):
    """Imports the capture when one of its files is dropped on a 3D view."""

    bl_idname = "FITFLARE_FH_capture"
    bl_label = "Fit Flare Capture"
    bl_import_operator = "fit_flare.import_capture"
    bl_file_extensions = ".json;.bin"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return bool(context.area and context.area.type == "VIEW_3D")


_CLASSES = (FITFLARE_OT_import_capture, FITFLARE_OT_capture_from_camera, FITFLARE_FH_capture)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
