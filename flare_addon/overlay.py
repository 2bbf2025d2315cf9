# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the flare over the camera view: numpy evaluates the look, the GPU draws its Gaussians.

Each Gaussian is a quad. With the blend "add" it is drawn into the coarsest of five buffers (full size to 1/16) in which
its narrow side still has four texels, so the cost does not grow with the size of a glow. With "over" all are drawn back
to front at full size over black, as they are baked. The buffers are linear, of 32-bit floats. A last pass
adds them to the viewport's picture in scene-linear light, before Blender applies the view transform, as the compositor
does in a render. Blender draws footage behind the camera after the view transform, unless the image is viewed as a
render. Over such footage the pass adds to the viewport's overlay, which Blender blends in display-linear light.

Only the visible part of the frame is drawn, at the pixels of the region, so zooming in costs nothing.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.capture import Camera
from ..core.errors import FitFlareError
from ..core.look import Look, PlaneGaussians, to_pixels
from ..core.look.network import OffsetsBudget
from ..core.look.plane import concatenate
from . import baking, highlight, lamp_drive, looks, stereo
from .compositor.flare_node import find_node
from .compositor.trees import is_off_in_preview
from .overlay_buffers import PICTURE, BuffersByCanvas, CanvasBuffers, DrawnLevels, part_of_quads
from .overlay_quads import LEVELS, DrawnRegion, QuadMemory, Quads, quads_by_level
from .overlay_shaders import gaussian_shader, sum_shader
from .scene_changes import change_count
from .views import camera_of, has_display_footage, redraw_viewports, schedule_redraw
from .working_space import working_space

NETWORK_S, NETWORK_AT_REST_S = 0.02, 0.25
"""Seconds for the look's deformation network per redraw: on average while the camera moves, and at most at rest. If
there are more lights than the time allows, they take turns."""

Floats = NDArray[np.float32]

last_error = ""
"""Why the last drawing failed, for the panel; "" after a success."""

_handles: list[Any] = []
_scene_buffer: Any = None  # the framebuffer with the scene-linear picture of the region that is being drawn
_shaders: dict[str, Any] = {}
_buffers = BuffersByCanvas()
_budgets: dict[tuple[str, stereo.Eye], OffsetsBudget] = {}
"""By the camera's full name and the eye."""
_memory = QuadMemory()


@dataclass(frozen=True)
class CameraFrame:
    """The rectangle of the camera's frame in a region, in pixels from the lower left corner of the region."""

    left: float
    bottom: float
    width: float
    height: float


def drawn_region(frame: CameraFrame, region: tuple[int, int], camera: Camera) -> DrawnRegion | None:
    """Return the part of a frame that a region of (width, height) pixels shows; None where it shows nothing.

    camera: the core's camera of the render, whose intrinsics are scaled to the frame.
    """
    left, bottom = max(int(np.floor(frame.left)), 0), max(int(np.floor(frame.bottom)), 0)
    right = min(int(np.ceil(frame.left + frame.width)), region[0])
    top = min(int(np.ceil(frame.bottom + frame.height)), region[1])
    if right <= left or top <= bottom or frame.width < 1 or frame.height < 1:
        return None
    x, y = frame.width / camera.width, frame.height / camera.height
    cut_rows = frame.bottom + frame.height - top  # from the frame's upper edge down to the window's
    intrinsics = np.array([[camera.fx * x, 0, camera.cx * x + frame.left - left],
                           [0, camera.fy * y, camera.cy * y - cut_rows], [0, 0, 1.0]])
    return DrawnRegion(left, bottom, right - left, top - bottom, intrinsics)


def camera_frame(context: Any, camera: Camera) -> CameraFrame | None:
    """Return a camera's frame in the region of a 3D view that looks through it; None where it is behind the view.

    camera: the core's camera of the render, in Blender's world.
    """
    from bpy_extras.view3d_utils import location_3d_to_region_2d
    from mathutils import Vector

    rays = camera.rays([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]])
    corners = [location_3d_to_region_2d(context.region, context.region_data, Vector((camera.position + ray).tolist()))
               for ray in rays]
    if any(corner is None for corner in corners):
        return None
    xs, ys = [corner.x for corner in corners], [corner.y for corner in corners]
    return CameraFrame(min(xs), min(ys), max(xs) - min(xs), max(ys) - min(ys))


# ---- the GPU --------------------------------------------------------------------------------------


def _shader(name: str) -> Any:
    """Return a compiled shader, "gaussian" or "sum"."""
    if name not in _shaders:
        _shaders[name] = gaussian_shader() if name == "gaussian" else sum_shader(LEVELS)
    return _shaders[name]


def _upload_quads(vertices: Quads) -> Any:
    """Upload quads to the GPU."""
    import gpu

    vertex_format = gpu.types.GPUVertFormat()
    for name, size in (("place", 2), ("local", 2), ("light", 3), ("ring", 3), ("arc", 3)):
        vertex_format.attr_add(id=name, comp_type="F32", len=size, fetch_mode="FLOAT")
    buffer = gpu.types.GPUVertBuf(vertex_format, len(vertices.place))
    for name in ("place", "local", "light", "ring", "arc"):
        buffer.attr_fill(name, np.ascontiguousarray(getattr(vertices, name)))
    triangles = gpu.types.GPUIndexBuf(type="TRIS", seq=vertices.triangles)
    return gpu.types.GPUBatch(type="TRIS", buf=buffer, elem=triangles)


def render_levels(gaussians: PlaneGaussians | None, window: DrawnRegion, look: Look,
                  buffers: CanvasBuffers | None = None) -> DrawnLevels:
    """Draw Gaussians of a look into the offscreen buffers of a canvas, by default those of pictures; return the levels.

    A level without Gaussians is neither cleared nor drawn. Needs a GPU context.
    """
    import gpu

    buffers = buffers or _buffers.of(PICTURE)
    buffers.content = None  # they get another content
    if gaussians is None:
        return DrawnLevels({}, (0, 0, 0, 0))
    by_level = quads_by_level(gaussians, window, look, _memory)
    offscreens = {}
    for divisor, quads in by_level.items():
        offscreen = offscreens[divisor] = buffers.offscreen(divisor, window.width, window.height)
        with offscreen.bind():
            gpu.state.active_framebuffer_get().clear(color=(0.0, 0.0, 0.0, 0.0))
            gpu.state.blend_set("ADDITIVE" if look.blend == "add" else "ALPHA_PREMULT")
            gpu.state.depth_test_set("NONE")
            shader = _shader("gaussian")
            shader.bind()
            shader.uniform_float("is_over", 0.0 if look.blend == "add" else 1.0)
            # The size of the level, whose last pixels may reach past the edge of the region.
            shader.uniform_float("size", (offscreen.width, offscreen.height))
            _upload_quads(quads).draw(shader)
    return DrawnLevels(offscreens, part_of_quads(by_level, window))


def composite_levels(levels: DrawnLevels, box: tuple[float, float, float, float], blend: str, window: DrawnRegion,
                     space: NDArray[np.float64]) -> None:
    """Add rendered levels to the bound framebuffer, inside box (left, bottom, right, top; 0..1 of its size).

    levels: with the blend "over" they hold display values, which the shader converts to linear light. space: matrix
    (3, 3) from linear Rec. 709 to the framebuffer's space.
    """
    left, bottom, right, top = levels.part
    if not levels.offscreens or right <= left or top <= bottom:
        return
    import gpu
    from gpu_extras.batch import batch_for_shader
    from mathutils import Matrix

    shader = _shader("sum")
    shader.bind()
    shader.uniform_float("box", box)
    shader.uniform_float("extent", (window.width, window.height))
    shader.uniform_float("is_display", 1.0 if blend == "over" else 0.0)
    shader.uniform_float("working_space", Matrix(space.tolist()).to_4x4())
    shader.uniform_int("drawn", sum(1 << number for number, divisor in enumerate(LEVELS)
                                    if divisor in levels.offscreens))
    any_offscreen = next(iter(levels.offscreens.values()))  # the shader does not read the levels that were not drawn
    for number, divisor in enumerate(LEVELS):
        shader.uniform_sampler(f"level{number}", levels.offscreens.get(divisor, any_offscreen).texture_color)
    corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]], np.float32)
    gpu.state.blend_set("ADDITIVE")
    gpu.state.depth_test_set("NONE")
    batch_for_shader(shader, "TRIS", {"corner": corners}, indices=((0, 1, 2), (0, 2, 3))).draw(shader)
    gpu.state.blend_set("NONE")


def _remember_buffer() -> None:
    """Remember the framebuffer into which Blender draws the scene of this region, since `_draw` is called with the
    overlay's bound."""
    global _scene_buffer
    import gpu

    _scene_buffer = gpu.state.active_framebuffer_get()


def _draw() -> None:
    """Draw the overlay in the current 3D view; an error is stored in `last_error`."""
    _draw_in_camera_view(draw_region)


def _draw_outlines() -> None:
    """Draw the outline of the highlighted element in the current 3D view."""
    if highlight.current_highlight(bpy.context.scene) is not None:
        _draw_in_camera_view(draw_outline)


def _draw_in_camera_view(draw: Callable[[Any, Any, Any, stereo.Eye], None]) -> None:
    """Call `draw` with context, scene, camera and eye if the current 3D view shows the flare through a camera.

    Blender calls the handlers once for each eye where a view shows both. Nothing is drawn while a bake reads the scene,
    since that moves the timeline. A FitFlareError is stored in `last_error`.
    """
    global last_error
    context = bpy.context
    scene, space = context.scene, context.space_data
    if scene is None or context.region_data is None or context.region_data.view_perspective != "CAMERA":
        return
    state = scene.fit_flare
    camera = camera_of(space, scene)
    is_shown = (state.show and state.flare and space.overlay.show_overlays and baking.preparation() is None
                and not is_composited(space, scene))
    if not is_shown or camera is None or camera.type != "CAMERA":
        return
    camera, eye = stereo.view_camera(scene, camera, stereo.displayed_view(context, camera))
    lamp_drive.measure_soon(scene)
    try:
        draw(context, scene, camera, eye)
        last_error = ""
    except FitFlareError as error:
        last_error = str(error)


def is_composited(space: Any, scene: Any) -> bool:
    """Return whether a 3D view shows the baked flare already, by Blender's compositing of viewports."""
    shading = space.shading
    if shading.type not in ("MATERIAL", "RENDERED") or shading.use_compositor == "DISABLED":
        return False
    node = find_node(scene)
    return node is not None and not node.mute and not is_off_in_preview(scene)


def draw_region(context: Any, scene: Any, camera: Any, eye: stereo.Eye = "") -> None:
    """Draw the flares of the scene over the camera view of the region. Raises FitFlareError."""
    import gpu

    window = drawn_part(context, scene, camera, eye)
    if window is None:
        return
    region = context.region.width, context.region.height
    look = looks.look_of(scene)
    levels = _render_region(context, scene, camera, window, look, eye)
    if levels is None:
        return
    viewport = gpu.state.viewport_get()
    box = (window.x / region[0], window.y / region[1], (window.x + window.width) / region[0],
           (window.y + window.height) / region[1])
    if _scene_buffer is None or has_display_footage(camera):
        composite_levels(levels, box, look.blend, window, np.eye(3))  # Blender's overlays are linear Rec. 709
    else:
        with _scene_buffer.bind():
            gpu.state.viewport_set(*viewport)
            composite_levels(levels, box, look.blend, window, working_space())
    gpu.state.viewport_set(*viewport)


def _render_region(context: Any, scene: Any, camera: Any, window: DrawnRegion, look: Look, eye: stereo.Eye = ""
                   ) -> DrawnLevels | None:
    """Return the levels with the flares of a scene; None without a flare.

    They are rendered only if anything has changed since they were for this region and eye. Raises FitFlareError.
    """
    chosen = highlight.current_highlight(scene)
    key = (camera.name_full, eye, chosen, look, *_drawing_key(context, scene, window))
    buffers = _buffers.of((context.region.as_pointer() if context.region else 0, eye))
    if buffers.content is not None and buffers.content[0] == key:
        return buffers.content[1]
    edits = looks.edits_of(scene.fit_flare)
    if chosen is not None:
        names = {item.name: [element.name for element in looks.present_elements(item)]
                 for item in scene.fit_flare.lights}
        edits = highlight.emphasise(edits, chosen, names)
    budget = _budgets.setdefault((camera.name_full, eye), OffsetsBudget(NETWORK_S, NETWORK_AT_REST_S))
    budget.begin()
    flares = looks.evaluate_flares(scene, context.view_layer.depsgraph, camera, edits, budget, eye=eye)
    if not budget.is_complete:  # lights wait for their turn
        schedule_redraw()
    gaussians = concatenate(list(flares.values()))
    if gaussians is None:
        return None
    levels = render_levels(gaussians, window, look, buffers)
    if budget.is_complete:
        buffers.content = key, levels
    return levels


def _drawing_key(context: Any, scene: Any, window: DrawnRegion) -> tuple[Any, ...]:
    """Return what the flares of a scene in a region depend on besides camera and look, for a comparison.

    `change_count` stands for Blender's data. Names are full, with the library of linked data. The working space is that
    of the tints."""
    return (change_count(), scene.name_full, context.view_layer.name, window.x, window.y, window.width, window.height,
            window.intrinsics.tobytes(), working_space().tobytes())


def drawn_part(context: Any, scene: Any, camera: Any, eye: stereo.Eye = "") -> DrawnRegion | None:
    """Return the part of the camera's frame that the region of a context shows; None where it shows nothing."""
    core = stereo.eye_camera(camera.evaluated_get(context.view_layer.depsgraph), scene.render, eye)
    frame = camera_frame(context, core)
    return None if frame is None else drawn_region(frame, (context.region.width, context.region.height), core)


def draw_outline(context: Any, scene: Any, camera: Any, eye: stereo.Eye = "") -> None:
    """Draw a box around the highlighted element. Raises FitFlareError."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    window, chosen = drawn_part(context, scene, camera, eye), highlight.current_highlight(scene)
    if window is None or chosen is None:
        return
    edits = highlight.isolate(chosen, looks.edits_of(scene.fit_flare))
    flares = looks.evaluate_flares(scene, context.view_layer.depsgraph, camera, edits, eye=eye)
    gaussians = concatenate(list(flares.values()))
    if gaussians is None:
        return
    box = highlight.outline_box(gaussians, *to_pixels(gaussians, window.intrinsics, looks.look_of(scene).pixel_grid))
    if box is None:
        return
    (left, right), (top, bottom) = (np.clip(box[axis::2], 1, size - 1) for axis, size in (
        (0, window.width), (1, window.height)))
    x, y = (window.x + left, window.x + right), (window.y + window.height - bottom, window.y + window.height - top)
    corners = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    shader.uniform_float("color", (*context.preferences.themes[0].view_3d.object_active[:3], 1.0))
    batch_for_shader(shader, "LINES", {"pos": corners}, indices=((0, 1), (1, 2), (2, 3), (3, 0))).draw(shader)


def add_to_picture(target: Any, scene: Any, depsgraph: Any, camera: Any, width: int, height: int) -> None:
    """Add the flares of the scene to a picture of the whole frame. Needs a GPU context.

    target: offscreen buffer of (width, height) pixels, in Blender's working space.
    """
    core = stereo.eye_camera(camera.evaluated_get(depsgraph), scene.render)
    window = drawn_region(CameraFrame(0, 0, width, height), (width, height), core)
    assert window is not None
    look = looks.look_of(scene)
    levels = render_levels(concatenate(list(looks.evaluate_flares(scene, depsgraph, camera).values())), window, look)
    with target.bind():
        composite_levels(levels, (0, 0, 1, 1), look.blend, window, working_space())
    _buffers.free(PICTURE)


def render_picture(scene: Any, depsgraph: Any, camera: Any, width: int, height: int) -> Floats:
    """Render the overlay to pixels (height, width, 3) of Blender's working space, row 0 on top. Needs a GPU context."""
    import gpu

    target = gpu.types.GPUOffScreen(width, height, format="RGBA32F")
    try:
        with target.bind():
            gpu.state.active_framebuffer_get().clear(color=(0.0, 0.0, 0.0, 0.0))
        add_to_picture(target, scene, depsgraph, camera, width, height)
        with target.bind():
            buffer = gpu.state.active_framebuffer_get()
            rgba = buffer.read_color(0, 0, width, height, 4, 0, "FLOAT")
    finally:
        target.free()
    rgba.dimensions = width * height * 4
    return np.array(rgba, np.float32).reshape(height, width, 4)[::-1, :, :3]


def register() -> None:
    if not bpy.app.background:
        for function, when in ((_remember_buffer, "PRE_VIEW"), (_draw, "POST_VIEW"), (_draw_outlines, "POST_PIXEL")):
            _handles.append(bpy.types.SpaceView3D.draw_handler_add(function, (), "WINDOW", when))


def unregister() -> None:
    global _scene_buffer, last_error
    for handle in _handles:
        bpy.types.SpaceView3D.draw_handler_remove(handle, "WINDOW")
    _handles.clear()
    _scene_buffer = None
    _buffers.free()
    _shaders.clear()
    _budgets.clear()
    if bpy.app.timers.is_registered(redraw_viewports):
        bpy.app.timers.unregister(redraw_viewports)
    lamp_drive.unregister()
    last_error = ""
