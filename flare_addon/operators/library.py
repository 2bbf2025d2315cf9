# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that save a flare to the library, and apply one to other cameras, lights and single pictures."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

from ...core.capture import Camera
from ...core.errors import FlareFileError
from .. import asset_browser, lamp_drive, library, lights, looks, overlay, render_settings, stereo
from ..compositor import setup
from ..reports import NO_CAMERA, NO_FLARE, GuardedOperator, report_errors
from ..views import look_through_camera, view_region_at

SENSOR = 36.0  # mm, width of the sensor of a picture's camera


class FITFLARE_OT_save_flare(GuardedOperator, bpy.types.Operator):
    """Save this scene's flare to the library, with a thumbnail and notes"""

    bl_idname = "fit_flare.save_flare"
    bl_label = "Save to Library"

    name: bpy.props.StringProperty(name="Name", description="Name of the flare in the library", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    notes: bpy.props.StringProperty(name="Notes", description="Lens, aperture, camera, use",  # type: ignore[valid-type]
                                    options={"SKIP_SAVE"})
    licence: bpy.props.StringProperty(name="Licence", description="Terms of use for others",  # type: ignore[valid-type]
                                      options={"SKIP_SAVE"})

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if not context.scene.fit_flare.flare:
            return NO_FLARE
        return ""

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        path = looks.path_of(context.scene)
        self.name = self.name or (path.parent.name if path and path.stem == "flare" else path.stem if path else "")
        return context.window_manager.invoke_props_dialog(self, width=360, confirm_text="Save")

    def act(self, context: bpy.types.Context) -> None:
        look = looks.look_of(context.scene)
        edits = looks.edits_to_store(context.scene.fit_flare, look)
        path = library.save_look(look, edits, self.name, self.notes or look.notes, self.licence or look.licence)
        asset_browser.update_assets()
        sliders = "" if edits.is_neutral else ", with the sliders of the panel Look as they are now"
        unstored = looks.unstored_settings(context.scene, edits)
        note = f". Not stored: {', '.join(unstored)}" if unstored else ""
        self.report({"WARNING"} if unstored else {"INFO"}, f"{path.stem} is in the library{sliders}{note}")


class FITFLARE_OT_list_assets(GuardedOperator, bpy.types.Operator):
    """Offer the looks of the library in Blender's Asset Browser, from where they can be dragged into a scene"""

    bl_idname = "fit_flare.list_assets"
    bl_label = "Show in Asset Browser"
    changes_scene = False

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        return asset_browser.why_not()

    def act(self, _context: bpy.types.Context) -> None:
        count = asset_browser.add_asset_library()
        self.report({"INFO"}, f"{count} looks are in the asset library {asset_browser.NAME}: open an Asset Browser and "
                    "drag one into the view")


class FITFLARE_OT_unlist_assets(GuardedOperator, bpy.types.Operator):
    """Take the looks out of Blender's Asset Browser; the library of the panel keeps them"""

    bl_idname = "fit_flare.unlist_assets"
    bl_label = "Remove from Asset Browser"
    changes_scene = False

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        return "" if asset_browser.library_entry() is not None else "The looks are not in the Asset Browser"

    def act(self, _context: bpy.types.Context) -> None:
        asset_browser.remove_asset_library()


class FITFLARE_OT_apply_flare(GuardedOperator, bpy.types.Operator):
    """Show the chosen flare of the library in this scene, at the selected objects or the lights of the same names"""

    bl_idname = "fit_flare.apply_flare"
    bl_label = "Use This Look"
    bl_options = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]
    add: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Add at Selected", description="Give each selected object without a flare one", default=True,
        options={"SKIP_SAVE"})

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        if not library.files():
            return "The library is empty: save a flare to it first"
        return ""

    def act(self, context: bpy.types.Context) -> None:
        """Show `filepath`, else the look that is chosen in the panel Library; warn of flares without a light object."""
        path = self.filepath or library.chosen_path()
        selected = [item for item in context.selected_objects if item.type != "CAMERA"]
        looks.show_look(context.scene, Path(path), selected, add=self.add)
        missing = [item.name for item in context.scene.fit_flare.lights if not looks.is_placed(item, context.scene)]
        if missing:
            self.report({"WARNING"}, f"{', '.join(missing)}: choose the light object in the panel Look")
        lamp_drive.report_dark(self, context.scene)


class FITFLARE_OT_pick_light(GuardedOperator, bpy.types.Operator):
    """Click on the light in the camera view to place the flare there"""

    bl_idname = "fit_flare.pick_light"
    bl_label = "Pick Light in Picture"
    bl_options = {"REGISTER", "UNDO"}

    x: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="X", description="Horizontal position in the picture, 0 left to 1 right", default=-1.0)
    y: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Y", description="Vertical position in the picture, 0 top to 1 bottom", default=-1.0)
    distance: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Distance", description="Distance from the camera where no object is hit; 0 uses ten units", default=0.0,
        min=0.0, subtype="DISTANCE")
    view: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="View", description="View of a stereo render that X and Y are positions in; empty for the camera itself",
        options={"SKIP_SAVE"})

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if context.scene.camera is None or context.scene.camera.type != "CAMERA":
            return NO_CAMERA
        if not context.scene.fit_flare.flare:
            return "Open a flare, or apply one of the library, first"
        return ""

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Turn the largest 3D view to the camera, and wait for a click."""
        areas = [area for area in context.screen.areas if area.type == "VIEW_3D"]
        if not areas:
            self.report({"ERROR"}, "There is no 3D viewport to pick in.")
            return {"CANCELLED"}
        area = max(areas, key=lambda area: area.width * area.height)
        self._area = area.as_pointer()  # the area may be closed before the click
        area.spaces.active.region_3d.view_perspective = "CAMERA"
        context.window_manager.modal_handler_add(self)
        context.window.cursor_modal_set("EYEDROPPER")
        context.workspace.status_text_set("Click on the light in the picture; ESC or right click to cancel")
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Take the first click in the picture; other events go on to Blender, so that the view can be zoomed."""
        # The view may have been closed or maximised meanwhile, and the camera deleted.
        area = next((area for area in context.screen.areas if area.as_pointer() == self._area), None)
        if event.type in {"ESC", "RIGHTMOUSE"} or area is None or self.why_not(context):
            self.cancel(context)
            return {"CANCELLED"}
        if event.type != "LEFTMOUSE" or event.value != "PRESS":
            return {"PASS_THROUGH"}
        with report_errors(self) as outcome:
            if not self._store_position(context, area, event):
                return {"PASS_THROUGH"}
        if outcome.status == {"CANCELLED"}:
            self.cancel(context)
            return outcome.status
        self.cancel(context)
        return self.execute(context)

    def _store_position(self, context: bpy.types.Context, area: Any, event: Any) -> bool:
        """Store the position of the mouse in the picture; return whether it is over the picture.

        area: the 3D view, as `invoke` turned it to the camera. Raises CaptureError.
        """
        space = area.spaces.active
        region = view_region_at(area, event.mouse_x, event.mouse_y) if space.type == "VIEW_3D" else None
        if region is None:
            return False
        x, y = event.mouse_x - region.x, event.mouse_y - region.y
        with context.temp_override(area=area, region=region, space_data=space, region_data=space.region_3d):
            self.view = stereo.displayed_view(bpy.context, context.scene.camera)
            core_camera = _core_camera(context.scene, bpy.context.view_layer.depsgraph, self.view)
            frame = overlay.camera_frame(bpy.context, core_camera)
        if frame is None:
            return False
        self.x, self.y = (x - frame.left) / frame.width, 1 - (y - frame.bottom) / frame.height
        return 0 <= self.x <= 1 and 0 <= self.y <= 1

    def cancel(self, context: bpy.types.Context) -> None:
        """Restore cursor and status line; Blender also calls this when it closes the window."""
        if context.window is not None:  # the window may be closed
            context.window.cursor_modal_restore()
            context.workspace.status_text_set(None)

    def act(self, context: bpy.types.Context) -> None:
        """Place a light on the surface at (x, y) of the picture, or at a distance where there is none.

        The new light that Add Flare made is moved there, if it was not placed yet. Else a light is added, for the first
        flare without a light object or for a new flare.
        """
        scene = context.scene
        depsgraph = context.evaluated_depsgraph_get()
        core_camera = _core_camera(scene, depsgraph, self.view)
        ray = Vector(core_camera.rays([[self.x * core_camera.width, self.y * core_camera.height]])[0].tolist())
        camera_position = Vector(core_camera.position.tolist())
        hit, position, *_ = scene.ray_cast(depsgraph, camera_position, ray)
        if not hit:
            position = camera_position + ray * (self.distance or 10.0 * max(scene.camera.matrix_world.to_scale()))
        look, state = looks.look_of(scene), scene.fit_flare
        placeholder = next((flare.target for flare in state.lights if looks.is_placed(flare, scene)
                            and flare.target.fit_flare.is_placeholder), None)
        if placeholder is not None:
            placeholder.location, placeholder.fit_flare.is_placeholder = position, False
            placeholder.empty_display_size = 0.02 * (position - camera_position).length
            return
        item = next((flare for flare in state.lights if flare.target is None), None)
        light = lights.add_to_scene(scene, position, item.name if item is not None else "light1")
        light.fit_flare.is_light = state.root is not None
        light.empty_display_size = 0.02 * (position - camera_position).length
        if item is None:
            item = looks.add_flare(scene, light, state.lights[state.light].source if state.lights
                                   else look.names[0])
        item.target = light


def _core_camera(scene: Any, depsgraph: Any, view: str) -> Camera:
    """Return the core's camera of a view of the scene by its name, "" for the scene's camera. Raises CaptureError."""
    camera, eye = stereo.view_camera(scene, scene.camera, view)
    return stereo.eye_camera(camera.evaluated_get(depsgraph), scene.render, eye)


class FITFLARE_OT_shot_from_picture(GuardedOperator, bpy.types.Operator):
    """Set the scene up for a single picture: a camera of its size, the picture behind it and in renders"""

    bl_idname = "fit_flare.shot_from_picture"
    bl_label = "Single Picture"
    bl_options = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(name="Picture", description="The picture to put the flare over",  # type: ignore[valid-type]
                                       subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_image: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if self.filepath:  # of the Image Editor
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> None:
        """Add a camera for the picture, with the lens of the scene's flare, and match size, frames and view to it."""
        scene = context.scene
        try:
            image = bpy.data.images.load(bpy.path.abspath(self.filepath), check_existing=True)
        except RuntimeError as problem:
            raise FlareFileError(f"{self.filepath} is not a picture that Blender can open.") from problem
        if 0 in image.size:
            raise FlareFileError(f"{self.filepath} is not a picture that Blender can open.")
        lens = None
        if scene.fit_flare.flare:  # the lens of the flare, to which its shapes belong
            flare_camera = looks.look_of(scene).camera
            lens = SENSOR * flare_camera.fx * flare_camera.pixel_ratio(*image.size) / image.size[0]
        scene.camera = _add_camera(scene, Path(self.filepath).stem, image, lens)
        scene.render.resolution_x, scene.render.resolution_y = image.size
        scene.render.resolution_percentage = 100
        scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1.0
        scene.frame_start = scene.frame_end = scene.frame_current
        scene.fit_flare.over = "plate"
        scene.render.film_transparent = True  # else the world hides the picture in a rendered view
        if note := render_settings.set_plain_view(scene):
            self.report({"WARNING"}, note)
        if not setup.show_plate(scene):
            self.report({"WARNING"}, setup.ARTISTS_COMPOSITOR)
        look_through_camera(context)


def _add_camera(scene: Any, name: str, image: Any, lens: float | None) -> Any:
    """Add a camera with a picture behind it; return it. lens: mm on a sensor 36 mm wide, None for the default."""
    data = bpy.data.cameras.new(name)
    data.sensor_fit, data.sensor_width, data.lens = "HORIZONTAL", SENSOR, lens or SENSOR
    camera = bpy.data.objects.new(name, data)
    scene.collection.objects.link(camera)
    camera.rotation_euler = (1.5707963, 0, 0)  # looks along the world's +Y, with +Z up
    data.show_background_images = True
    background = data.background_images.new()
    background.image, background.alpha, background.frame_method = image, 1.0, "STRETCH"
    image.use_view_as_render = True  # through the view transform, as in a render
    return camera


_CLASSES = (FITFLARE_OT_save_flare, FITFLARE_OT_list_assets, FITFLARE_OT_unlist_assets, FITFLARE_OT_apply_flare,
            FITFLARE_OT_pick_light, FITFLARE_OT_shot_from_picture)


def register() -> None:
    library.register()
    for cls in _CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
    library.unregister()
