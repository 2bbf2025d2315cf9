# SPDX-License-Identifier: GPL-3.0-or-later
"""The tab "Fit Flare" of the sidebar: the library, then the order of the work: Capture, Lights, Fit, Look, Bake,
Transfer.

Each panel shows what is missing and offers the next step; the buttons are in `operators`.
"""
from __future__ import annotations

from typing import Any

import bpy

from ..core.capture import REMOVED
from ..core.conventions.run_files import FLARE
from ..core.errors import FitFlareError
from ..core.look import Look
from . import baking, engine, fits, handbook, jobs, library, light_extents, lights, looks, overlay, panel_parts, shots
from .compositor import drivers, flare_node, setup
from .compositor.warnings import footage_note
from .layouts import draw_progress, label_lines, settings_column
from .operators import make_flare
from .paths import is_folder
from .render_settings import has_plain_view
from .user_settings import PACKAGE
from .views import camera_of, display_footage


class _SidebarPanel(handbook.LinkedPanel):
    """Mixin that puts a panel into the tab of the sidebar."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = jobs.SIDEBAR_TAB


class _FitPanel(_SidebarPanel):
    """Mixin for panels of a fit, which a scene without a capture, a run or lights of a capture does not need."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        state = context.scene.fit_flare
        return bool(state.capture or state.run or lights.scene_lights(context.scene))


class FITFLARE_PT_capture(_SidebarPanel, bpy.types.Panel):
    bl_label = "Capture"
    bl_idname = "FITFLARE_PT_capture"
    page = "first_fit"

    def draw(self, context: bpy.types.Context) -> None:
        layout, state = self.layout, context.scene.fit_flare
        folder = fits.capture_folder(context.scene)
        if folder is None:
            label_lines(layout, "Footage with a camera solve: a folder with images/ and sparse/0/ (COLMAP) or "
                        "transforms.json. Flare from Footage needs only a clip.", "INFO")
        elif not is_folder(folder):
            label_lines(layout, f"The capture {folder} does not exist any more: choose its present folder.", "ERROR")
        row = layout.row()
        row.scale_y = 1.3
        row.operator("fit_flare.import_capture", icon="IMPORT")
        if folder is not None:
            layout.prop(state, "capture", text="")
            settings_column(layout).prop(state, "plate_space")
            if fits.has_clean_frames(context.scene):
                layout.row().prop(state, "footage", expand=True)
        column = layout.column()
        column.operator("fit_flare.flare_from_footage", icon="FILE_MOVIE")
        column.operator("fit_flare.capture_from_camera", icon="CAMERA_DATA")


class FITFLARE_PT_lights(_FitPanel, bpy.types.Panel):
    bl_label = "Lights"
    bl_idname = "FITFLARE_PT_lights"
    page = "first_fit"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return super().poll(context) or not context.scene.fit_flare.flare

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the lights of the capture, the state of the search for lights, and the buttons that add lights."""
        layout, scene = self.layout, context.scene
        objects = lights.scene_lights(scene)
        if not objects:
            label_lines(layout, "No lights yet. The fit learns a flare for each light in the footage.", "INFO")
        column = layout.column(align=True)
        for light in objects:
            row = column.row(align=True)
            row.prop(light.fit_flare, "light", text="", icon=panel_parts.light_icon(scene, light))
            row.operator("fit_flare.remove_light", text="", icon="X").object = light.name
        panel_parts.draw_motion_note(layout, scene, objects)
        folder = fits.capture_folder(scene)
        job = jobs.find_job(folder / "lights") if folder is not None else None
        if job is not None and job.running:
            draw_progress(layout, job, "Searching for lights")
        elif job is not None and job.error:
            label_lines(layout, job.error, "ERROR")
        elif folder is not None and (names := lights.new_light_names(scene, folder)):
            label_lines(layout, f"Found, but not in the scene yet: {', '.join(names)}.", "INFO")
            layout.operator("fit_flare.use_lights", icon="IMPORT")
        column = layout.column(align=True)
        column.operator("fit_flare.find_lights", icon="VIEWZOOM")
        row = column.row(align=True)
        row.operator("fit_flare.add_light", icon="ADD")
        row.operator("fit_flare.lights_from_selected", icon="RESTRICT_SELECT_OFF")


class FITFLARE_PT_fit(_FitPanel, bpy.types.Panel):
    bl_label = "Fit"
    bl_idname = "FITFLARE_PT_fit"
    page = "first_fit"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw a running fit alone; else settings, clean frames, state of the last fit, and the button of a fit."""
        layout, scene = self.layout, context.scene
        state, fit_state, folder = scene.fit_flare, fits.fit_state(scene), fits.run_folder(scene)
        job = jobs.find_job(folder)
        for orphan in shots.orphaned_jobs():
            draw_progress(layout, orphan, f"{orphan.folder.name} (used by no scene)")
        if engine.find_engine() is None:
            draw_missing_engine(layout)
        if fit_state == "running" and job is not None:
            _draw_running_fit(layout, job)
            return
        panel_parts.draw_fit_settings(layout, state)
        capture = fits.capture_folder(scene)
        if capture is not None and (state.mode != "default" or fits.cleaning_job(capture) is not None):
            _draw_clean_frames(layout, state, capture, fit_state)
        _draw_last_fit(layout, scene, fit_state, job)
        reason = fits.why_not_fit(scene)
        if reason and engine.find_engine() is not None:
            label_lines(layout, f"{reason}.", "INFO")
        row = layout.row()
        row.scale_y = 1.3
        label = "Fit" if fit_state in ("none", "lost") else "New Fit"
        row.operator("fit_flare.fit", text=label, icon="RENDER_ANIMATION")
        if folder is not None and is_folder(folder):
            _draw_log_buttons(layout, folder)


def _draw_last_fit(layout: Any, scene: Any, fit_state: str, job: jobs.Job | None) -> None:
    """Draw the state of the last fit, which does not run, with the button that resumes it or the result.

    fit_state: of `fits.fit_state`. job: of the fit, None if it ran before Blender was started.
    """
    if fit_state == "lost":
        label_lines(layout, f"The folder of the run {fits.run_folder(scene)} does not exist any more: start a new fit.",
                    "ERROR")
    elif fit_state == "resumable":
        if job is not None and job.state == "failed":
            label_lines(layout, job.error, "ERROR")
        else:
            label_lines(layout, "The fit was stopped and can be resumed.", "INFO")
        layout.operator("fit_flare.resume", icon="PLAY")
    elif fit_state == "finished":
        _draw_finished_fit(layout, scene, job)
    elif job is not None and job.state in ("failed", "stopped"):
        label_lines(layout, job.error, "ERROR" if job.state == "failed" else "INFO")


def _draw_clean_frames(layout: Any, state: Any, capture: Any, fit_state: str) -> None:
    """Draw the state of the clean frames, their options, and the button that makes them.

    Clean frames of the network can be made again with other options, or with the fit once it is finished.
    """
    job = fits.cleaning_job(capture)
    if job is not None and job.running:
        draw_progress(layout, job, "Clean frames")
        return
    if job is not None and job.error:
        label_lines(layout, job.error, "INFO" if job.state == "stopped" else "ERROR")
    exists = is_folder(capture / REMOVED) and (job is None or job.state == "done")
    # Clean frames without a job were filmed or made elsewhere; they are not made again by the network.
    offers_network = fit_state != "finished" and (not exists or job is not None)
    if not exists:
        label_lines(layout, "The fit can remove its flare from the frames." if fit_state == "finished" else
                    "No clean frames: the fit separates scene and flare by parallax." if state.mode == "split" else
                    "No clean frames yet: the fit starts by making them.", "INFO")
    if offers_network:
        options = settings_column(layout)
        options.prop(state, "matte")
        options.prop(state, "keep_glow")
        if not exists and state.mode != "split" and (state.matte or state.keep_glow):
            label_lines(layout, "Press Make Clean Frames first: a fit makes them without these options.", "INFO")
    if exists and state.mode == "split":  # they were made while the .blend was closed
        label_lines(layout, "There are clean frames: choose them under Learn From to use them.", "INFO")
    offers_fit = fit_state == "finished" and (job is None or "--run" not in job.args)
    if not exists or offers_network or offers_fit:
        layout.operator("fit_flare.clean_frames", text="Make Clean Frames Again" if exists else "Make Clean Frames",
                        icon="BRUSH_DATA")


def _draw_running_fit(layout: Any, job: jobs.Job) -> None:
    """Draw progress, figures and preview of a fit."""
    draw_progress(layout, job, job.stage.capitalize())
    if job.figures:
        loss, count = job.figures.get("loss", job.figures.get("scene_loss")), job.figures.get("flare_gaussians")
        parts = [f"step {job.done} of {job.total}"]
        parts += [f"difference from the frames {loss:.4f}"] if loss is not None else []
        parts += [f"{count:,.0f} flare Gaussians"] if count else []
        label_lines(layout, ", ".join(parts))
    icon = fits.preview_icon(job.folder)
    if icon:
        _draw_preview(layout, icon)
    else:
        label_lines(layout, "The first preview appears after an eighth of the fit. You can use, save and close Blender "
                            "meanwhile.")
    _draw_log_buttons(layout, job.folder)


def _draw_preview(layout: Any, icon: int) -> None:
    """Draw a preview (composite above flare) as wide as the panel."""
    region, scale = bpy.context.region, bpy.context.preferences.system.ui_scale
    width = region.width / scale if region is not None else 260
    # The scale of an icon is in units of 20 px; the margins of the panel take 60 px.
    layout.template_icon(icon_value=icon, scale=max(min((width - 60) / 20, 16), 6))


def _draw_finished_fit(layout: Any, scene: Any, job: jobs.Job | None) -> None:
    """Draw the preview of a finished fit, and whether its flare is shown."""
    folder = fits.run_folder(scene)
    assert folder is not None
    icon = fits.preview_icon(folder)
    if icon:
        _draw_preview(layout, icon)
    shown_flare = looks.path_of(scene)
    if job is not None and job.error:
        label_lines(layout, job.error, "ERROR")
    if shown_flare is None or shown_flare != folder / FLARE:
        label_lines(layout, "The fit is finished.", "CHECKMARK")
        layout.operator("fit_flare.use_result", icon="LIGHT_SUN")
    else:
        label_lines(layout, "The fit is finished; its flare is shown in the camera view.", "CHECKMARK")


def _draw_log_buttons(layout: Any, folder: Any) -> None:
    """Draw the buttons that show preview, log and folder of a run."""
    row = layout.row(align=True)
    row.operator("fit_flare.show_preview", icon="IMAGE_DATA", text="Preview")
    row.operator("fit_flare.show_log", icon="TEXT", text="Log").folder = str(folder)
    row.operator("fit_flare.open_folder", icon="FILE_FOLDER", text="").folder = str(folder)


def draw_missing_engine(layout: Any) -> None:
    """Draw why there is no engine, and a button that opens the preferences."""
    box = layout.box()
    label_lines(box, f"{engine.missing_reason()}.", "ERROR")
    box.operator("preferences.addon_show", text="Open Preferences", icon="PREFERENCES").module = PACKAGE


class FITFLARE_PT_look(_SidebarPanel, bpy.types.Panel):
    bl_label = "Look"
    bl_idname = "FITFLARE_PT_look"
    page = "editing"

    def draw_header(self, context: bpy.types.Context) -> None:
        self.layout.prop(context.scene.fit_flare, "show", text="")

    def draw(self, context: bpy.types.Context) -> None:
        """Draw why the view shows no flare, if it shows none; then the sliders of all flares and of the chosen one."""
        layout, scene = self.layout, context.scene
        state = scene.fit_flare
        if not state.flare:
            label_lines(layout, "No flare yet: add one of the library, fit one, or open a .flare.", "INFO")
            layout.operator("fit_flare.open_flare", icon="FILE_FOLDER")
            return
        try:
            look = looks.look_of(scene)
        except FitFlareError as problem:
            label_lines(layout, str(problem), "ERROR")
            layout.operator("fit_flare.open_flare", icon="FILE_FOLDER")
            return
        if overlay.last_error:
            label_lines(layout, overlay.last_error, "ERROR")
        panel_parts.draw_dark_reason(layout, scene)
        _draw_view_hint(layout, context)
        if looks.duplicate_name(state):
            label_lines(layout, f"Two flares have the name {looks.duplicate_name(state)}: rename one.", "ERROR")
        layout.label(text="All Flares", icon="OUTLINER_OB_LIGHT")
        _draw_sliders(layout, state.master)
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
        if lost := looks.lost_flares(scene):
            layout.operator("fit_flare.remove_lost_flares", text=f"Remove Flares of Deleted Lights ({len(lost)})",
                            icon="TRASH")
        if 0 <= state.light < len(state.lights):
            _draw_flare(layout, scene, state.lights[state.light], look)
        row = layout.row(align=True)
        row.operator("fit_flare.reset_look", icon="LOOP_BACK")
        row.operator("fit_flare.open_flare", text="Open", icon="FILE_FOLDER")


def _draw_view_hint(layout: Any, context: bpy.types.Context) -> None:
    """Draw why this 3D view shows no flare, the baked one, or one over that of the frames, and a button that helps."""
    scene, state = context.scene, context.scene.fit_flare
    view = context.space_data if getattr(context.space_data, "type", "") == "VIEW_3D" else None
    if scene.camera is None:
        label_lines(layout, "The scene has no camera; add one to see the flare.", "ERROR")
    elif view is not None and view.region_3d.view_perspective != "CAMERA":
        layout.operator("view3d.view_camera", text="Look through the Camera", icon="VIEW_CAMERA")
    elif view is not None and not view.overlay.show_overlays:
        label_lines(layout, "Overlays are switched off in this view, and the flare with them.", "INFO")
    elif view is not None and overlay.is_composited(view, scene):
        label_lines(layout, "This view is composited: it shows the flare as it was baked.", "INFO")
    elif view is not None and not has_plain_view(scene) and (footage := display_footage(camera_of(view, scene))):
        panel_parts.draw_view_transform_note(layout, scene, footage)
    elif state.show and state.native and state.footage == "images" and fits.has_clean_frames(scene):
        label_lines(layout, "The frames behind the camera contain their own flare, and this one is drawn over it: "
                    "choose Clean under Capture to see this one alone.", "INFO")


def _draw_sliders(layout: Any, sliders: Any, streak: bool = True) -> None:
    """Draw the sliders of an edit; streak: also Streak Length."""
    column = layout.column()
    column.use_property_split = True
    for name in ("intensity", "scale", "spread", "rotation", "tint", "saturation", *(("streak",) if streak else ())):
        column.prop(sliders, name, slider=name in ("intensity", "scale", "spread", "saturation", "streak"))


def _draw_flare(layout: Any, scene: Any, item: Any, look: Look) -> None:
    """Draw the settings and elements of one flare."""
    box = layout.box()
    box.label(text=item.name, icon="LIGHT_SUN")
    column = box.column()
    column.use_property_split = True
    column.prop(item, "target")
    if item.target is None:
        label_lines(box, f"Choose the light object of {item.name}.", "ERROR")
    elif not looks.is_placed(item, scene):
        label_lines(box, f"{item.target.name} is not in this scene: choose another object.", "ERROR")
    if len(look.lights) > 1:
        label_lines(box, f"Look: {item.source}")
    _draw_sliders(box, item)
    column = box.column()
    column.use_property_split = True
    panel_parts.draw_switches(column, scene, item)
    column.prop(item, "extent")
    if item.extent == "point" or item.target is None or light_extents.is_point(item):
        column.prop(item, "radius")
    if not looks.present_elements(item):
        return
    row = box.row()
    row.alignment = "LEFT"
    row.prop(item, "show_elements", icon="TRIA_DOWN" if item.show_elements else "TRIA_RIGHT", emboss=False)
    row.operator("fit_flare.pick_element", text="Pick", icon="EYEDROPPER")
    if item.show_elements:
        box.template_list("FITFLARE_UL_elements", "", item, "elements", item, "element", rows=4)
        element = item.elements[item.element] if 0 <= item.element < len(item.elements) else None
        if element is not None and not element.is_absent:
            box.label(text=element.name.capitalize(), icon="DOT")
            _draw_sliders(box, element, element.kind == "streak")


class FITFLARE_PT_bake(_SidebarPanel, bpy.types.Panel):
    bl_label = "Bake"
    bl_idname = "FITFLARE_PT_bake"
    page = "editing"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw a running bake; else settings, result of the last bake, and the buttons; then the compositor."""
        layout, scene = self.layout, context.scene
        state = scene.fit_flare
        if not state.flare:
            label_lines(layout, "Nothing to bake yet: fit or open a flare first.", "INFO")
        job = jobs.find_job(shots.layers_folder(scene)) if state.layers else None
        reading = baking.preparation()
        if reading is not None:
            row = layout.row(align=True)
            row.progress(factor=reading.fraction_done, text=f"Reading the scene: {reading.fraction_done:.0%}")
            row.operator("fit_flare.cancel_bake", text="", icon="X")
        elif job is not None and job.running:
            draw_progress(layout, job, "Bake")
            _draw_bake_log(layout, job)
        else:
            panel_parts.draw_bake_settings(layout, state)
            panel_parts.draw_stereo_note(layout, scene)
            if state.flare and engine.find_engine() is None:
                label_lines(layout, "Without an engine, Blender's own Python draws the layers: some seconds per frame.",
                            "INFO")
            panel_parts.draw_last_bake(layout, scene, job)
            row = layout.row(align=True)
            row.scale_y = 1.3
            panel_parts.draw_bake_buttons(row, state)
            if job is not None:
                _draw_bake_log(layout, job)
        self._draw_compositor(layout, scene)

    def _draw_compositor(self, layout: Any, scene: Any) -> None:
        """Draw the set-up of the compositor, and its sliders where the panel Look does not drive them."""
        state, node = scene.fit_flare, flare_node.find_node(scene)
        box = layout.box().column()
        column = settings_column(box)
        column.prop(state, "over")
        if note := footage_note(scene):
            label_lines(box, note, "INFO")
        box.operator("fit_flare.set_up_baked", icon="NODE_COMPOSITING")
        if node is not None and node.node_tree is not None:
            # An artist may have renamed the inputs.
            sliders = [node.inputs[name] for name in ("Intensity", "Tint") if name in node.inputs]
            slider_drivers = drivers.node_drivers(scene)
            if not drivers.is_complete(scene):
                label_lines(box, "Some sliders of the panel Look do not act on it any more: set it up again.", "ERROR")
            elif slider_drivers or any(socket.is_linked for socket in sliders if socket.name == "Intensity"):
                label_lines(box, "Set up: the sliders of the panel Look act on it.", "CHECKMARK")
            else:
                column = box.column()
                column.use_property_split = True
                for socket in sliders:
                    column.prop(socket, "default_value", text=socket.name)
            box.operator("fit_flare.remove_compositor", icon="X")
        else:
            box.operator("fit_flare.set_up_compositor", text="Other Layers …", icon="FILE_FOLDER")
            if setup.shows_plate_alone(scene):
                box.operator("fit_flare.remove_compositor", icon="X")


def _draw_bake_log(layout: Any, job: jobs.Job) -> None:
    """Draw the buttons that show log and folder of a bake."""
    row = layout.row(align=True)
    row.operator("fit_flare.show_log", icon="TEXT", text="Log").folder = str(job.folder)
    row.operator("fit_flare.open_folder", icon="FILE_FOLDER", text="Folder").folder = str(job.folder)


class FITFLARE_PT_transfer(_SidebarPanel, bpy.types.Panel):
    bl_label = "Transfer"
    bl_idname = "FITFLARE_PT_transfer"
    page = "transfer"

    def draw(self, context: bpy.types.Context) -> None:
        layout, state = self.layout, context.scene.fit_flare
        column = layout.column(align=True)
        column.operator("fit_flare.save_flare", icon="FILE_TICK")
        column.operator("fit_flare.list_assets", icon="ASSET_MANAGER")
        column.operator("fit_flare.shot_from_picture", icon="IMAGE_DATA")
        column.operator("fit_flare.pick_light", icon="EYEDROPPER")
        if state.flare and not state.native and any(item.target for item in state.lights):
            label_lines(layout, "This flare was not learned from footage of this scene: its appearance is that of one "
                                "training view and does not follow the camera.", "INFO")


class FITFLARE_PT_library(_SidebarPanel, bpy.types.Panel):
    bl_label = "Library"
    bl_idname = "FITFLARE_PT_library"
    page = "first_flare"

    def draw(self, context: bpy.types.Context) -> None:
        layout, state, manager = self.layout, context.scene.fit_flare, context.window_manager
        if not library.files():
            label_lines(layout, "The library is empty: open a flare, then save it here.", "INFO")
            return
        layout.template_icon_view(manager, "fit_flare_library", show_labels=True, scale=6.0, scale_popup=5.0)
        if notes := library.notes(manager.fit_flare_library):
            label_lines(layout, notes)
        row = layout.row()
        row.scale_y = 1.3
        if state.flare:
            row.operator("fit_flare.apply_flare", text="Use This Look", icon="LIGHT_SUN").add = False
        row.operator("fit_flare.add_library_flare", icon="ADD" if state.flare else "LIGHT_SUN")
        job = make_flare.making_job()
        if job is not None and job.running:
            draw_progress(layout, job, job.stage.capitalize())
        elif engine.find_engine() is not None:
            if job is not None and job.error:
                label_lines(layout, job.error, "INFO" if job.state == "stopped" else "ERROR")
            layout.operator("fit_flare.make_flare", icon="CAMERA_STEREO")


_CLASSES = (FITFLARE_PT_library, FITFLARE_PT_capture, FITFLARE_PT_lights, FITFLARE_PT_fit, FITFLARE_PT_look,
            FITFLARE_PT_bake, FITFLARE_PT_transfer)


register, unregister = bpy.utils.register_classes_factory(_CLASSES)
