# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator Add Flare, which shows a look of the library over the camera view at once, and its menu entries."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

from ...core.errors import FlareFileError
from .. import cameras, lamp_drive, library, lights, looks
from ..objects import depsgraph_of, world_matrix
from ..reports import GuardedOperator, report_errors
from ..views import look_through_camera

FRAME_MARGIN = 0.25
"""How far outside the frame, as a part of its size, a light may be for Add Flare to choose it by itself."""
NEW_LIGHT_PLACE = 0.3, 0.3
"""Position of a new light in the frame: from the left and from the top, 0..1."""
NEW_LIGHT_DISTANCE = 10.0
"""Distance of a new light from the camera, camera units."""


def _look_items(_self: Any, _context: Any) -> list[tuple[str, str, str, int, int]]:
    """Return the entries of the library as menu items."""
    return library.menu_items()


class FITFLARE_OT_add_library_flare(GuardedOperator, bpy.types.Operator):
    """Show a flare over the camera view, at the selected lights or one in view, with the chosen look of the library"""

    bl_idname = "fit_flare.add_library_flare"
    bl_label = "Add Flare"
    bl_options = {"REGISTER", "UNDO"}

    look: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Look", description="The look of the library", items=_look_items, options={"SKIP_SAVE"})
    light: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Light", description="The light object that gets the flare", default="auto", options={"SKIP_SAVE"},
        items=(("auto", "Selected or in View", "The selected lights, else one that the camera sees, else a new one"),
               ("new", "New", "A new light object in the camera's view")))

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        return "" if library.files() else "The library is empty: save a flare to it first"

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if not self.properties.is_property_set("look") and not _has_look(context.scene):
            with report_errors(self) as outcome:
                self.look = library.chosen_path()
            if outcome.status == {"CANCELLED"}:
                return outcome.status
        return self.execute(context)

    def act(self, context: bpy.types.Context) -> None:
        """Add flares at the selected lights, else at one in view, else at a new one; add a camera if there is none."""
        scene = context.scene
        camera = _choose_camera(scene) or _add_camera(context)
        targets = [] if self.light == "new" else _selected_lights(context)
        if not targets and self.light != "new":
            targets = _lights_in_view(scene, camera)[:1]
        if not targets:
            targets = [_add_light(scene, camera)]
            self.report({"INFO"}, f"The flare is at the new light {targets[0].name}; move it, or choose another light "
                        "object in the panel Look")
        if self.properties.is_property_set("look"):
            path: Any = self.look
        else:
            path = looks.path_of(scene) if _has_look(scene) else library.chosen_path()
        is_first = not scene.fit_flare.lights
        targets_before = {item.target for item in scene.fit_flare.lights}
        looks.show_look(scene, Path(path), targets, add=True)
        if is_first:
            _remove_unplaced(scene)
        if already_placed := sorted(item.name for item in targets if item in targets_before):
            self.report({"INFO"}, f"{', '.join(already_placed)}: already has a flare, so none was added")
        scene.fit_flare.show = True
        lamp_drive.report_dark(self, scene)
        look_through_camera(context)


def _choose_camera(scene: Any) -> Any:
    """Return the scene's camera; without one, make the first camera object the scene's. None without any."""
    if scene.camera is None or scene.camera.type != "CAMERA":
        first = next((item for item in scene.objects if item.type == "CAMERA"), None)
        if first is not None:
            scene.camera = first
        return first
    return scene.camera


def _add_camera(context: Any) -> Any:
    """Add a camera that sees what the 3D view shows, make it the scene's, and return it."""
    scene = context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    region = getattr(context, "region_data", None)
    if region is not None:
        camera.matrix_world = region.view_matrix.inverted()
    else:
        # It looks at the origin along the world's +Y.
        camera.location, camera.rotation_euler = (0.0, -NEW_LIGHT_DISTANCE, 0.0), (1.5707963, 0.0, 0.0)
    scene.camera = camera
    return camera


def _selected_lights(context: Any) -> list[Any]:
    """Return the selected light objects: lamps and empties, or, where the scene has no lamp at all, any object but a
    camera."""
    selected = [item for item in context.selected_objects if item.type != "CAMERA"]
    lamps = [item for item in selected if item.type in ("LIGHT", "EMPTY") and not item.fit_flare.is_root]
    if lamps or any(item.type == "LIGHT" for item in context.scene.objects):
        return lamps
    return [item for item in selected if not item.fit_flare.is_root and not item.fit_flare.is_points]


def _lights_in_view(scene: Any, camera: Any) -> list[Any]:
    """Return the lamps of the scene in front of the camera and near its frame, the one nearest the centre first.

    Lamps that are hidden in renders are left out.
    """
    depsgraph = depsgraph_of(scene)
    evaluated = camera.evaluated_get(depsgraph)
    core_camera = cameras.core_camera(evaluated.data, evaluated.matrix_world, scene.render)
    candidates = []
    for item in scene.objects:
        if item.type != "LIGHT" or item.hide_render or not item.visible_get(view_layer=depsgraph.view_layer):
            continue
        position = lights.light_position(item, world_matrix(item, depsgraph), evaluated.matrix_world.translation)
        (pixel,), (depth,) = core_camera.project([list(position)])
        x, y = pixel[0] / core_camera.width - 0.5, pixel[1] / core_camera.height - 0.5
        if depth > 0 and max(abs(x), abs(y)) <= 0.5 + FRAME_MARGIN:
            candidates.append((float(x * x + y * y), item.name, item))
    return [item for _, _, item in sorted(candidates, key=lambda entry: entry[:2])]


def _add_light(scene: Any, camera: Any) -> Any:
    """Add an empty in the camera's view as a light object; return it."""
    depsgraph = depsgraph_of(scene)
    evaluated = camera.evaluated_get(depsgraph)
    core_camera = cameras.core_camera(evaluated.data, evaluated.matrix_world, scene.render)
    x, y = NEW_LIGHT_PLACE
    ray = Vector(core_camera.rays([[x * core_camera.width, y * core_camera.height]])[0].tolist())
    distance = NEW_LIGHT_DISTANCE * max(evaluated.matrix_world.to_scale())
    light = bpy.data.objects.new("Flare", None)
    light.empty_display_type, light.empty_display_size = "SPHERE", 0.02 * distance
    light.location = evaluated.matrix_world.translation + ray * distance
    light.fit_flare.is_placeholder = True
    scene.collection.objects.link(light)
    depsgraph_of(scene)  # updates its matrix_world
    return light


def _has_look(scene: Any) -> bool:
    """Return whether the scene shows a .flare that can be read; Add Flare keeps it."""
    try:
        return bool(looks.look_of(scene).lights)
    except FlareFileError:
        return False


def _remove_unplaced(scene: Any) -> None:
    """Remove the flares of a look's other lights, which have no light object."""
    for index in reversed(range(len(scene.fit_flare.lights))):
        if scene.fit_flare.lights[index].target is None:
            looks.remove_flare(scene, index)


def _draw_menu(self: Any, _context: Any) -> None:
    """Draw the entry of the menu Add > Light."""
    self.layout.separator()
    self.layout.operator(FITFLARE_OT_add_library_flare.bl_idname, text="Flare", icon="LIGHT_SUN")


def register() -> None:
    bpy.utils.register_class(FITFLARE_OT_add_library_flare)
    bpy.types.VIEW3D_MT_light_add.append(_draw_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_light_add.remove(_draw_menu)
    bpy.utils.unregister_class(FITFLARE_OT_add_library_flare)
