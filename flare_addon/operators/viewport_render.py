# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that renders the camera view with its flare, as a picture or as the frames of the scene."""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy

from ...core.errors import SettingsError
from .. import lamp_drive, viewport_render
from ..reports import GuardedOperator, report_errors
from ..views import largest_view

INTERVAL_S = 0.005
"""Pause between two frames of an animation."""


class FITFLARE_OT_viewport_render(GuardedOperator, bpy.types.Operator):
    """Render the camera view with its flare and the shading of the 3D viewport to the path in Output"""

    bl_idname = "fit_flare.viewport_render"
    bl_label = "Viewport Render with Flare"
    changes_scene = False

    animation: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Animation", description="Render all frames of the scene instead of the current one", default=False,
        options={"SKIP_SAVE"})

    _frames: Iterator[int]
    """Renders the frames one after the other."""

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if bpy.app.background:
            return "Viewport renders need Blender's window"
        return "" if largest_view(context) is not None else "There is no 3D viewport in this window"

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Render one frame at once, an animation frame by frame in `modal`."""
        with report_errors(self) as outcome:
            self._prepare_frames(context)
            if not self.animation:
                for _ in self._frames:
                    pass
                self._report_result(context)
                return outcome.status
            manager = context.window_manager
            self._timer = manager.event_timer_add(INTERVAL_S, window=context.window)
            manager.modal_handler_add(self)
            context.workspace.status_text_set("Viewport render with flare; ESC to cancel")
            outcome.status = {"RUNNING_MODAL"}
        return outcome.status

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Render all frames at once, for a script."""
        with report_errors(self) as outcome:
            self._prepare_frames(context)
            try:
                for _ in self._frames:
                    pass
                self._report_result(context)
            finally:
                self._restore_frame(context.scene)
        return outcome.status

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Render the next frame; other events wait, so that nothing changes the scene meanwhile."""
        if event.type == "ESC":
            self.cancel(context)
            self.report({"INFO"}, f"The viewport render was cancelled after {self._frame_count} frames")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        with report_errors(self) as outcome:
            if next(self._frames, None) is not None:
                return {"RUNNING_MODAL"}
            self._report_result(context)
        self.cancel(context)
        return outcome.status

    def cancel(self, context: bpy.types.Context) -> None:
        """End the timer, and move the timeline back."""
        self._restore_frame(context.scene)
        if getattr(self, "_timer", None) is not None:
            context.window_manager.event_timer_remove(self._timer)
            context.workspace.status_text_set(None)

    def _prepare_frames(self, context: bpy.types.Context) -> None:
        """Check the scene, note the current frame, and prepare the frames to render. Raises SettingsError."""
        scene = context.scene
        viewport_render.check_scene(scene)
        lamp_drive.measure_driven(scene)
        self._frame_before = scene.frame_current, scene.frame_subframe
        self._frame_count, self._timer = 0, None
        numbers = (list(range(scene.frame_start, scene.frame_end + 1, scene.frame_step)) if self.animation
                   else [scene.frame_current])
        self._frames = self._render_frames(context, numbers)

    def _render_frames(self, context: Any, numbers: list[int]) -> Iterator[int]:
        """Render and save each frame; yield its number."""
        scene = context.scene
        for number in numbers:
            if number != scene.frame_current:
                scene.frame_set(number)
            view = largest_view(context)
            if view is None:
                raise SettingsError("The 3D viewport was closed while it was rendered; open one, and render again.")
            area, region, space = view
            with context.temp_override(area=area, region=region, space_data=space, region_data=space.region_3d):
                pixels = viewport_render.draw_frame(bpy.context, space, region)
            viewport_render.save_picture(scene, pixels, viewport_render.output_path(scene, number))
            self._frame_count += 1
            yield number

    def _restore_frame(self, scene: Any) -> None:
        """Move the timeline back to where it was."""
        frame, subframe = self._frame_before
        if (scene.frame_current, scene.frame_subframe) != (frame, subframe):
            scene.frame_set(frame, subframe=subframe)

    def _report_result(self, context: bpy.types.Context) -> None:
        """Report what was rendered, and that it is pictures where the scene's output is a video."""
        scene = context.scene
        path = viewport_render.output_path(scene, scene.frame_current)
        subject = f"{self._frame_count} frames are" if self.animation else f"{path.name} is"
        hint = (". Viewport renders with the flare are PNG pictures; to make a video of them, use Add > "
                "Image/Sequence in the Video Sequencer" if scene.render.is_movie_format else "")
        self.report({"INFO"}, f"{subject} in {path.parent}{hint}")


def _draw_menu(self: Any, _context: Any) -> None:
    """Draw the entries of the menu View."""
    layout = self.layout
    layout.separator()
    image = layout.operator("fit_flare.viewport_render", text="Viewport Render Image with Flare", icon="RENDER_STILL")
    image.animation = False
    frames = layout.operator("fit_flare.viewport_render", text="Viewport Render Animation with Flare",
                             icon="RENDER_ANIMATION")
    frames.animation = True


def register() -> None:
    bpy.utils.register_class(FITFLARE_OT_viewport_render)
    bpy.types.VIEW3D_MT_view.append(_draw_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_view.remove(_draw_menu)
    bpy.utils.unregister_class(FITFLARE_OT_viewport_render)
