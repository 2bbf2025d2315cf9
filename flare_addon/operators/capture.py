# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that import a capture, and that make one from a solved or animated camera of Blender."""
from __future__ import annotations

from pathlib import Path

import bpy

from .. import fits
from ..capture import exporter
from ..capture.importer import ImportSettings, import_capture
from ..reports import NO_CAMERA, GuardedOperator


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
        name="Frames", description="Show the frames as background images of the cameras", default=True)
    points: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Points", description="Import the point cloud as a mesh with colours", default=True)
    match_scene: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Match Scene", description="Set size, frame range and view transform of the scene to those of the frames",
        default=True)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
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

    def act(self, context: bpy.types.Context) -> None:
        chosen = Path(bpy.path.abspath(self.filepath or self.directory))
        if not chosen.exists() and self.directory:
            chosen = Path(bpy.path.abspath(self.directory))
        settings = ImportSettings(self.cameras, self.up, self.scale, self.frames, self.points, self.match_scene)
        imported = import_capture(context.scene, chosen, settings)
        fits.clear_other_run(context.scene)
        fits.expose_cameras(context.scene, fits.run_folder(context.scene))
        for note in imported.notes:
            self.report({"WARNING"}, note)
        self.report({"INFO"}, f"{chosen.name}: cameras {len(imported.cameras)}, lights {len(imported.lights)}")
        _look_through_camera(context)


def _look_through_camera(context: bpy.types.Context) -> None:
    """Switch the largest 3D view to the camera, so that the footage is visible."""
    screen = context.screen
    views = [area for area in screen.areas if area.type == "VIEW_3D"] if screen is not None else []
    if views:
        space = max(views, key=lambda area: area.width * area.height).spaces.active
        space.region_3d.view_perspective = "CAMERA"


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
