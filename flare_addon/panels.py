# SPDX-License-Identifier: GPL-3.0-or-later
"""The sidebar's "Fit Flare" tab, in the order of the work: Capture, Lights, Fit, Look, Bake, Transfer.

Each part says what is missing and offers the next step.
"""
from __future__ import annotations

from typing import Any

import bpy

from ..core.capture import REMOVED
from ..core.conventions.run_files import FLARE
from ..core.errors import FitFlareError
from . import engine, fits, jobs, library, lights, looks, overlay, shots
from .compositor import drivers, flare_node
from .layouts import draw_progress, lines
from .paths import is_folder


class _Part:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Fit Flare"


class FITFLARE_PT_capture(_Part, bpy.types.Panel):
    bl_label = "Capture"
    bl_idname = "FITFLARE_PT_capture"

    def draw(self, context: bpy.types.Context) -> None:
        layout, state = self.layout, context.scene.fit_flare
        folder = fits.capture_of(context.scene)
        if folder is None:
            lines(layout, "Footage with a camera solve: a folder with images/ and sparse/0/ (COLMAP) or "
                          "transforms.json.", "INFO")
        elif not is_folder(folder):
            lines(layout, f"The capture {folder} is not there any more: choose where it is now.", "ERROR")
        row = layout.row()
        row.scale_y = 1.3
        row.operator("fit_flare.import_capture", icon="IMPORT")
        if folder is not None:
            layout.prop(state, "capture", text="")
            if fits.has_clean_frames(context.scene):
                layout.row().prop(state, "footage", expand=True)
        column = layout.column()
        column.operator("fit_flare.capture_from_camera", icon="CAMERA_DATA")


class FITFLARE_PT_lights(_Part, bpy.types.Panel):
    bl_label = "Lights"
    bl_idname = "FITFLARE_PT_lights"

    def draw(self, context: bpy.types.Context) -> None:
        layout, scene = self.layout, context.scene
        found = lights.of_scene(scene)
        if not found:
            lines(layout, "No lights yet. The fit learns a flare for each light source of the footage.", "INFO")
        column = layout.column(align=True)
        for light in found:
            row = column.row(align=True)
            row.prop(light.fit_flare, "light", text="", icon="LIGHT_POINT")
            row.operator("fit_flare.remove_light", text="", icon="X").object = light.name
        folder = fits.capture_of(scene)
        job = jobs.find(folder / "lights") if folder is not None else None
        if job is not None and job.running:
            draw_progress(layout, job, "Looking for lights")
        elif job is not None and job.error:
            lines(layout, job.error, "ERROR")
        elif folder is not None and (names := lights.unknown(scene, folder)):
            lines(layout, f"Found, and not in the scene yet: {', '.join(names)}.", "INFO")
            layout.operator("fit_flare.use_lights", icon="IMPORT")
        column = layout.column(align=True)
        column.operator("fit_flare.find_lights", icon="VIEWZOOM")
        row = column.row(align=True)
        row.operator("fit_flare.add_light", icon="ADD")
        row.operator("fit_flare.lights_from_selected", icon="RESTRICT_SELECT_OFF")


class FITFLARE_PT_fit(_Part, bpy.types.Panel):
    bl_label = "Fit"
    bl_idname = "FITFLARE_PT_fit"

    def draw(self, context: bpy.types.Context) -> None:
        layout, scene = self.layout, context.scene
        state, stage, folder = scene.fit_flare, fits.state_of(scene), fits.folder_of(scene)
        job = jobs.find(folder)
        for other in shots.unnamed():
            draw_progress(layout, other, f"{other.folder.name}, of no scene")
        if engine.find() is None:
            draw_engine(layout)
        if stage == "running" and job is not None:
            _fitting(layout, job)
            return
        settings = layout.column()
        settings.use_property_split = True
        settings.use_property_decorate = False
        settings.prop(state, "preset")
        settings.prop(state, "mode")
        settings.prop(state, "width")
        capture = fits.capture_of(scene)
        if capture is not None and (state.mode != "default" or fits.cleaning_of(capture) is not None):
            _cleaning(layout, state, capture, stage)
        if stage == "lost":
            lines(layout, f"The run's folder {folder} is gone: start a new fit.", "ERROR")
        elif stage == "resumable":
            if job is not None and job.state == "failed":
                lines(layout, job.error, "ERROR")
            else:
                lines(layout, "The fit was stopped and can go on where it was.", "INFO")
            layout.operator("fit_flare.resume", icon="PLAY")
        elif stage == "finished":
            _finished(layout, scene, job)
        elif job is not None and job.state in ("failed", "stopped"):
            lines(layout, job.error, "ERROR" if job.state == "failed" else "INFO")
        why = fits.why_not(scene)
        if why and engine.find() is not None:
            lines(layout, f"{why}.", "INFO")
        row = layout.row()
        row.scale_y = 1.3
        row.operator("fit_flare.fit", text="Fit" if stage in ("none", "lost") else "New Fit", icon="RENDER_ANIMATION")
        if folder is not None and is_folder(folder):
            _reading(layout, folder)


def _cleaning(layout: Any, state: Any, capture: Any, stage: str) -> None:
    """The frames without flare: made, being made, or to be made; those of a network can be made again, otherwise or by
    the fit that was made since."""
    job = fits.cleaning_of(capture)
    if job is not None and job.running:
        draw_progress(layout, job, "Clean frames")
        return
    if job is not None and job.error:
        lines(layout, job.error, "INFO" if job.state == "stopped" else "ERROR")
    there = is_folder(capture / REMOVED) and (job is None or job.state == "done")
    by_network = stage != "finished" and (not there or job is not None)
    if not there:
        lines(layout, "The fit can take its flare out of the frames." if stage == "finished" else
              "No frames without flare: scene and flare are told apart by how they move." if state.mode == "split" else
              "No frames without flare: the fit begins by making some.", "INFO")
    if by_network:
        given = layout.column()
        given.use_property_split = True
        given.use_property_decorate = False
        given.prop(state, "matte")
        given.prop(state, "keep_glow")
        if not there and state.mode != "split" and (state.matte or state.keep_glow):
            lines(layout, "Press Make Clean Frames first: a fit makes them without these.", "INFO")
    if there and state.mode == "split":  # they were made while the .blend was closed
        lines(layout, "There are clean frames: choose them as Supervision to learn from them.", "INFO")
    by_fit = stage == "finished" and (job is None or "--run" not in job.words)
    if not there or by_network or by_fit:
        layout.operator("fit_flare.clean_frames", text="Make Clean Frames Again" if there else "Make Clean Frames",
                        icon="BRUSH_DATA")


def _fitting(layout: Any, job: jobs.Job) -> None:
    draw_progress(layout, job, job.stage.capitalize())
    if job.figures:
        loss, count = job.figures.get("loss", job.figures.get("scene_loss")), job.figures.get("flare_gaussians")
        parts = [f"step {job.done} of {job.total}"]
        parts += [f"loss {loss:.4f}"] if loss is not None else []
        parts += [f"{count:,.0f} in the flare"] if count else []
        lines(layout, ", ".join(parts))
    icon = fits.preview_icon(job.folder)
    if icon:
        _picture(layout, icon)
    else:
        lines(layout, "A preview comes after an eighth of the way. Blender can be used, saved and closed meanwhile.")
    _reading(layout, job.folder)


def _picture(layout: Any, icon: int) -> None:
    """A preview, composite above flare, as wide as the panel."""
    region, scale = bpy.context.region, bpy.context.preferences.system.ui_scale
    width = region.width / scale if region is not None else 260
    layout.template_icon(icon_value=icon, scale=max(min((width - 60) / 20, 16), 6))


def _finished(layout: Any, scene: Any, job: jobs.Job | None) -> None:
    folder = fits.folder_of(scene)
    assert folder is not None
    icon = fits.preview_icon(folder)
    if icon:
        _picture(layout, icon)
    used = looks.path_of(scene)
    if job is not None and job.error:
        lines(layout, job.error, "ERROR")
    if used is None or used != folder / FLARE:
        lines(layout, "The fit is finished.", "CHECKMARK")
        layout.operator("fit_flare.use_result", icon="LIGHT_SUN")
    else:
        lines(layout, "The fit is finished; its flare is shown in the camera view.", "CHECKMARK")


def _reading(layout: Any, folder: Any) -> None:
    row = layout.row(align=True)
    row.operator("fit_flare.show_preview", icon="IMAGE_DATA", text="Preview")
    row.operator("fit_flare.show_log", icon="TEXT", text="Log").folder = str(folder)
    row.operator("fit_flare.open_folder", icon="FILE_FOLDER", text="").folder = str(folder)


def draw_engine(layout: Any) -> None:
    """That there is no engine, and the way to one."""
    box = layout.box()
    lines(box, f"{engine.missing()}.", "ERROR")
    box.operator("preferences.addon_show", text="Open Preferences", icon="PREFERENCES").module = engine.PACKAGE


class FITFLARE_PT_look(_Part, bpy.types.Panel):
    bl_label = "Look"
    bl_idname = "FITFLARE_PT_look"

    def draw_header(self, context: bpy.types.Context) -> None:
        self.layout.prop(context.scene.fit_flare, "show", text="")

    def draw(self, context: bpy.types.Context) -> None:
        layout, scene = self.layout, context.scene
        state = scene.fit_flare
        if not state.flare:
            lines(layout, "No flare yet: fit one above, or open a .flare.", "INFO")
            layout.operator("fit_flare.open_flare", icon="FILE_FOLDER")
            return
        try:
            looks.look_of(scene)
        except FitFlareError as problem:
            lines(layout, str(problem), "ERROR")
            layout.operator("fit_flare.open_flare", icon="FILE_FOLDER")
            return
        if overlay.problem:
            lines(layout, overlay.problem, "ERROR")
        if scene.camera is None:
            lines(layout, "The scene has no camera to see the flare from.", "ERROR")
        elif not _through_camera(context):
            layout.operator("view3d.view_camera", text="Look through the Camera", icon="VIEW_CAMERA")
        elif state.show and state.native and state.footage == "images" and fits.has_clean_frames(scene):
            lines(layout, "The frames behind the camera have their own flare, and this one is over it: choose Without "
                          "Flare under Capture to see one alone.", "INFO")
        if looks.twice(state):
            lines(layout, f"Two flares have the name {looks.twice(state)}: rename one.", "ERROR")
        _sliders(layout, state.master)
        if scene.camera is not None:
            column = layout.column()
            column.use_property_split = True
            column.prop(scene.camera.fit_flare, "exposure")
        layout.prop(state, "occlusion")
        row = layout.row()
        rows = max(min(len(state.lights), 6), 2)
        row.template_list("FITFLARE_UL_lights", "", state, "lights", state, "light", rows=rows)
        column = row.column(align=True)
        column.operator("fit_flare.add_flare", text="", icon="ADD")
        column.operator("fit_flare.remove_flare", text="", icon="REMOVE")
        if 0 <= state.light < len(state.lights):
            _light(layout, scene, state.lights[state.light])
        row = layout.row(align=True)
        row.operator("fit_flare.reset_look", icon="LOOP_BACK")
        row.operator("fit_flare.open_flare", text="Open", icon="FILE_FOLDER")


def _through_camera(context: bpy.types.Context) -> bool:
    space = context.space_data
    return space is None or space.type != "VIEW_3D" or space.region_3d.view_perspective == "CAMERA"


def _sliders(layout: Any, sliders: Any, streak: bool = True) -> None:
    column = layout.column()
    column.use_property_split = True
    for name in ("intensity", "scale", "spread", "rotation", "tint", "saturation", *(("streak",) if streak else ())):
        column.prop(sliders, name, slider=name in ("intensity", "scale", "spread", "saturation", "streak"))


def _light(layout: Any, scene: Any, item: Any) -> None:
    box = layout.box()
    column = box.column()
    column.use_property_split = True
    column.prop(item, "target")
    if item.target is None:
        lines(box, f"Choose the object that {item.name} comes from.", "ERROR")
    elif not looks.is_placed(item, scene):
        lines(box, f"{item.target.name} is not in this scene: choose another object.", "ERROR")
    lines(box, f"Look: {item.source}")
    _sliders(box, item)
    column = box.column()
    column.use_property_split = True
    column.prop(item, "radius")
    if not item.elements:
        return
    row = box.row()
    row.alignment = "LEFT"
    row.prop(item, "show_elements", icon="TRIA_DOWN" if item.show_elements else "TRIA_RIGHT", emboss=False)
    if item.show_elements:
        box.template_list("FITFLARE_UL_elements", "", item, "elements", item, "element", rows=4)
        if 0 <= item.element < len(item.elements):
            _sliders(box, item.elements[item.element], item.elements[item.element].kind == "streak")


class FITFLARE_PT_bake(_Part, bpy.types.Panel):
    bl_label = "Bake"
    bl_idname = "FITFLARE_PT_bake"

    def draw(self, context: bpy.types.Context) -> None:
        layout, scene = self.layout, context.scene
        state = scene.fit_flare
        if not state.flare:
            lines(layout, "Nothing to bake yet: fit or open a flare first.", "INFO")
        job = jobs.find(shots.layers_folder(scene)) if state.layers else None
        if job is not None and job.running:
            draw_progress(layout, job, "Bake")
            _baked_log(layout, job)
        else:
            column = layout.column()
            column.use_property_split = True
            column.use_property_decorate = False
            column.prop(state, "bake_range")
            if state.bake_range == "custom":
                column.prop(state, "bake_first")
                column.prop(state, "bake_last")
            column.prop(state, "layers")
            column.prop(state, "bake_live")
            column.prop(state, "bake_scene")
            if job is not None and job.error:
                lines(layout, job.error, "INFO" if job.state == "stopped" else "ERROR")
            elif job is not None and job.state == "done":
                lines(layout, f"{job.result.get('frames', 0)} frames of layers are baked.", "CHECKMARK")
            row = layout.row(align=True)
            row.scale_y = 1.3
            row.operator("fit_flare.bake", icon="RENDER_ANIMATION").selected = False
            row.operator("fit_flare.bake", text="", icon="OUTLINER_OB_CAMERA").selected = True
            if job is not None:
                _baked_log(layout, job)
        self._compositor(layout, scene)

    def _compositor(self, layout: Any, scene: Any) -> None:
        state, node = scene.fit_flare, flare_node.find_node(scene)
        box = layout.box().column()
        column = box.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.prop(state, "over")
        box.operator("fit_flare.set_up_baked", icon="NODE_COMPOSITING")
        if node is not None and node.node_tree is not None:
            sliders = [node.inputs[name] for name in ("Intensity", "Tint") if name in node.inputs]  # not renamed ones
            slider_drivers = drivers.drivers(scene)
            if not drivers.complete(scene):
                lines(box, "Some sliders of the panel Look act on it no longer: set it up again.", "ERROR")
            elif slider_drivers or any(socket.is_linked for socket in sliders if socket.name == "Intensity"):
                lines(box, "Set up: the sliders of the panel Look act on it.", "CHECKMARK")
            else:
                column = box.column()
                column.use_property_split = True
                for socket in sliders:
                    column.prop(socket, "default_value", text=socket.name)
            box.operator("fit_flare.remove_compositor", icon="X")
        else:
            box.operator("fit_flare.set_up_compositor", text="Other Layers …", icon="FILE_FOLDER")


def _baked_log(layout: Any, job: jobs.Job) -> None:
    row = layout.row(align=True)
    row.operator("fit_flare.show_log", icon="TEXT", text="Log").folder = str(job.folder)
    row.operator("fit_flare.open_folder", icon="FILE_FOLDER", text="Folder").folder = str(job.folder)


class FITFLARE_PT_transfer(_Part, bpy.types.Panel):
    bl_label = "Transfer"
    bl_idname = "FITFLARE_PT_transfer"

    def draw(self, context: bpy.types.Context) -> None:
        layout, state = self.layout, context.scene.fit_flare
        if library.files():
            layout.template_icon_view(context.window_manager, "fit_flare_library", show_labels=True, scale=6.0,
                                      scale_popup=5.0)
            lines(layout, "Select the objects that are to flare, then apply.")
            layout.operator("fit_flare.apply_flare", icon="LIGHT_SUN")
        else:
            lines(layout, "The library is empty. Save a flare, then apply it to other cameras and lights.", "INFO")
        column = layout.column(align=True)
        column.operator("fit_flare.save_flare", icon="FILE_TICK")
        column.operator("fit_flare.shot_from_picture", icon="IMAGE_DATA")
        column.operator("fit_flare.pick_light", icon="EYEDROPPER")
        if state.flare and not state.native and any(item.target for item in state.lights):
            lines(layout, "A flare of another shot: it keeps the look of the middle of its own footage.", "INFO")


_CLASSES = (FITFLARE_PT_capture, FITFLARE_PT_lights, FITFLARE_PT_fit, FITFLARE_PT_look, FITFLARE_PT_bake,
            FITFLARE_PT_transfer)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
