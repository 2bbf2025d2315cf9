# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that bake layers and set the compositor up for them."""
from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import bpy

from ...core.bake.folder import LayerFolder
from ...core.errors import CaptureError, FitFlareError, RunError
from ...core.system.steps import PAUSE, Steps, finish
from .. import baking, jobs, render_settings, shots
from ..compositor import drivers, flare_node, setup, warnings
from ..compositor.footage import footage_behind_camera
from ..paths import absolute, is_folder
from ..reports import NO_CAMERA, NO_FLARE, GuardedOperator, report_errors

_scenes_to_set_up: set[str] = set()
"""The scenes whose bake sets the compositor up, also if it is set up already."""


class FITFLARE_OT_bake(GuardedOperator, bpy.types.Operator):
    """Render the flares to EXR layers, for the frames and the camera of the scene: in the engine, or slower without"""

    bl_idname = "fit_flare.bake"
    bl_label = "Bake Layers"
    bl_options = {"UNDO"}  # else undoing a later step would reset the folder that it sets

    selected: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Selected Cameras", description="Bake from every selected camera, each to its own folder",
        default=False)
    composite: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Composite", description="Set the compositor up for the layers when they are baked, even if it is set up "
        "already", default=False, options={"SKIP_SAVE"})
    replace: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Replace Others", description="Delete other frames in the folder that were baked with other settings",
        default=False, options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        scene = context.scene
        if not scene.fit_flare.flare:
            return NO_FLARE
        if scene.camera is None:
            return NO_CAMERA
        return baking.why_not_bake(scene)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask before layers are replaced, then bake."""
        replaced: list[int] = []
        with report_errors(self) as outcome:
            replaced = shots.frames_to_replace(context.scene, self._chosen_cameras(context))
        if outcome.status == {"CANCELLED"}:
            return outcome.status
        self.replace = True  # nothing is replaced, or the dialog below asks first
        if not replaced:
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self, event, title="Replace Layers", confirm_text="Replace",
            message=shots.replacement_warning(shots.layers_folder(context.scene), replaced))

    def act(self, context: bpy.types.Context) -> None:
        scene = context.scene
        _scenes_to_set_up.discard(scene.name)
        if self.composite:
            scene.fit_flare.bake_composite = True
            _scenes_to_set_up.add(scene.name)
        baking.start_bake(scene, self._chosen_cameras(context), replace_others=self.replace)

    def _chosen_cameras(self, context: bpy.types.Context) -> list[Any]:
        """Return the selected cameras; [] for the scene's camera. Raises CaptureError where none is selected."""
        if not self.selected:
            return []
        cameras = [item for item in context.selected_objects if item.type == "CAMERA"]
        if not cameras:
            raise CaptureError("No camera is selected; select those to bake from.")
        return cameras


class FITFLARE_OT_cancel_bake(bpy.types.Operator):
    """Stop reading the scene for the bake"""

    bl_idname = "fit_flare.cancel_bake"
    bl_label = "Cancel"

    def execute(self, _context: bpy.types.Context) -> set[str]:
        baking.cancel()
        return {"FINISHED"}


def set_up_compositor(operator: Any, scene: Any, folder: str, *, keep_image: bool, plate: bool,
                      match: bool = False) -> None:
    """Set the compositor up for the layers in a folder, and report warnings to the operator.

    folder: folder of a bake, or of one camera's layers in it, as the .blend stores it. The flare goes over the baked
    scene, the compositor's present output (`keep_image`), or the footage behind the camera (`plate`). match: set the
    frames and the size of the scene to the layers'. Raises FrameError.
    """
    finish(_set_up_in_steps(operator, lambda: scene, folder, keep_image=keep_image, plate=plate, match=match))


def _set_up_in_steps(operator: Any, scene_now: Callable[[], Any], folder: str, *, keep_image: bool, plate: bool,
                     match: bool = False) -> Steps[None]:
    """Set the compositor up as `set_up_compositor` does, in steps.

    scene_now: returns the scene, which an undo between two steps replaces.
    """
    views: dict[str, LayerFolder] = {}
    folders = yield from shots.view_folders_in_steps(scene_now, absolute(folder))
    for view, path in folders.items():
        views[view] = yield from LayerFolder.open_in_steps(path)
    yield PAUSE
    scene, layers = scene_now(), next(iter(views.values()))
    footage = footage_behind_camera(scene) if plate else None
    setup.set_up_nodes(scene, layers, keep_image=keep_image, plate=footage, views=views if len(views) > 1 else None)
    yield PAUSE
    scene = scene_now()
    if match:
        render_settings.match_scene(scene, layers, layers.size())
    live = "; Intensity and Tint of the panel act on it" if connect_sliders(scene, layers) else ""
    for warning in warnings.warnings(scene, list(views.values()), bool(live)):
        operator.report({"WARNING"}, warning)
    operator.report({"INFO"}, f"{len(layers.files)} frames of layers set up{live}")


class FITFLARE_OT_set_up_compositor(GuardedOperator, bpy.types.Operator):
    """Combine baked layers in the compositor of this scene; existing nodes are kept"""

    bl_idname = "fit_flare.set_up_compositor"
    bl_label = "Set Up Compositor"
    bl_options = {"REGISTER", "UNDO"}

    directory: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Layers",
        description="Folder of the baked EXR layers",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},  # else the last value would count as a dropped file
    )
    keep_image: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Over the Render",
        description="Put the flare over the render, or the output of your own nodes, instead of the baked scene",
        default=False,
    )
    plate: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Over the Footage",
        description="Put the flare over the frames behind the scene's camera",
        default=False,
    )
    match_scene: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Match Scene",
        description="Set the frame range and the size of the scene to those of the layers",
        default=True,
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if self.directory:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> None:
        set_up_compositor(self, context.scene, self.directory, keep_image=self.keep_image, plate=self.plate,
                          match=self.match_scene)


def connect_sliders(scene: Any, layers: LayerFolder) -> bool:
    """Drive the compositor by the sliders of the panel Look, for layers baked without them; return whether it was
    done."""
    flare_by_layer = shots.live_layers(scene.fit_flare, layers.folder)
    if flare_by_layer is None:
        return False
    drivers.connect_node(scene, flare_by_layer)
    return True


class FITFLARE_OT_remove_compositor(GuardedOperator, bpy.types.Operator):
    """Remove Fit Flare's nodes from the compositor and restore its previous state"""

    bl_idname = "fit_flare.remove_compositor"
    bl_label = "Remove from Compositor"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if flare_node.find_node(context.scene) is None and not setup.shows_plate_alone(context.scene):
            return "The compositor is not set up"
        return ""

    def act(self, context: bpy.types.Context) -> None:
        setup.remove_nodes(context.scene)


class FITFLARE_OT_set_up_baked(GuardedOperator, bpy.types.Operator):
    """Combine the layers baked from this scene in its compositor"""

    bl_idname = "fit_flare.set_up_baked"
    bl_label = "Set Up Compositor"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        state = context.scene.fit_flare
        if not state.layers:
            return "Bake layers first, or choose their folder"
        return "The bake is still running" if baking.is_baking(context.scene) else ""

    def act(self, context: bpy.types.Context) -> None:
        state = context.scene.fit_flare
        set_up_compositor(self, context.scene, state.layers, keep_image=state.over == "present",
                          plate=state.over == "plate")


class _JobReports:
    """Takes the reports of `set_up_compositor` after a bake, whose operator is gone: warnings go to the panel."""

    def __init__(self, job: jobs.Job) -> None:
        self._job = job

    def report(self, kinds: set[str], text: str) -> None:
        """Store a warning."""
        if kinds != {"INFO"}:
            self._job.warnings.append(text)


def _set_up_compositor_after_bake(job: jobs.Job, scene: Any) -> Steps[None] | None:
    """Return the steps that set the compositor of a scene up for new layers; None if Composite Too is off.

    A compositor that is set up already stays as it is, unless the bake was started to set it up again.
    """
    state, set_up_again = scene.fit_flare, scene.name in _scenes_to_set_up
    _scenes_to_set_up.discard(scene.name)
    if not state.bake_composite or scene.library is not None or (
            flare_node.find_node(scene) is not None and not set_up_again):
        return None
    reports = _JobReports(job)
    steps = _set_up_in_steps(reports, partial(_scene_of_name, scene.name), state.layers,
                             keep_image=state.over == "present", plate=state.over == "plate")
    return _finish_set_up(reports, steps)


def _finish_set_up(reports: _JobReports, steps: Steps[None]) -> Steps[None]:
    """Run the steps of a set-up, report its error, and store an undo step."""
    try:
        yield from steps
    except FitFlareError as problem:
        reports.report({"ERROR"}, f"The compositor was not set up: {problem}")
        return
    yield PAUSE
    with contextlib.suppress(RuntimeError):  # without a window there are no undo steps
        bpy.ops.ed.undo_push(message="Set Up Compositor")


def _scene_of_name(name: str) -> Any:
    """Return the scene of this name. Raises RunError where it was deleted."""
    scene = bpy.data.scenes.get(name)
    if scene is None:
        raise RunError(f"The scene {name!r} was deleted or renamed meanwhile.")
    return scene


class FITFLARE_OT_open_folder(bpy.types.Operator):
    """Open this folder in the system's file browser"""

    bl_idname = "fit_flare.open_folder"
    bl_label = "Open Folder"

    folder: bpy.props.StringProperty(options={"HIDDEN"})  # type: ignore[valid-type]

    def execute(self, _context: bpy.types.Context) -> set[str]:
        if not is_folder(Path(self.folder)):
            self.report({"ERROR"}, f"The folder {self.folder} does not exist any more.")
            return {"CANCELLED"}
        bpy.ops.wm.path_open(filepath=self.folder)
        return {"FINISHED"}


_CLASSES = (FITFLARE_OT_bake, FITFLARE_OT_set_up_compositor, FITFLARE_OT_set_up_baked, FITFLARE_OT_remove_compositor,
            FITFLARE_OT_cancel_bake, FITFLARE_OT_open_folder)


def register() -> None:
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    baking.ON_BAKED.append(_set_up_compositor_after_bake)


def unregister() -> None:
    baking.ON_BAKED.remove(_set_up_compositor_after_bake)
    baking.unregister()
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
