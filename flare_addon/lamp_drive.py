# SPDX-License-Identifier: GPL-3.0-or-later
"""What a light object does to the brightness of its flare, each by a switch of the flare.

    follow_power         power and colour of a lamp, relative to a reference
    follow_visibility    no flare where the object is disabled in renders, or a lamp or mesh in viewports
    follow_direction     the cone of a spot, and the side and angle of an area light that flares as a point
    follow_distance      inverse square fall-off, relative to a reference distance (core.look.placed_light computes it)

`looks.place_light` applies them, so the overlay, bakes and transfers follow the lamp alike. A flare at an object that
the artist has placed has all of them, one at a light of the capture none: its flare was fitted as it was filmed.

The reference of the power is the lamp's light in the first frame of the scene:

    keyed lamp     computed from its curves, so it follows them
    driven lamp    measured at the first frame when the flare gets the lamp. If the driver is added later, it is
                   measured soon after a redraw of the camera view in that frame, or before a bake, a transfer or a
                   viewport render. A lamp with a keyed temperature counts as driven
    other lamp     measured when the flare gets the lamp, so that a change by hand dims the flare

An empty or a mesh has no power; its factor is 1. The reference distance is the one from the camera to the object when
the flare gets it; the artist can change it.
"""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from . import fcurves
from .objects import depsgraph_of, enabled_collections
from .views import redraw_viewports

Gain = tuple[float, float, float]

WHITE: Gain = (1.0, 1.0, 1.0)
MIN_CHANNEL = 1e-3
"""Smallest reference of a colour channel relative to the largest: a red lamp that turns blue has a finite factor."""
MAX_FACTOR = 1e6
_POWER_PATHS = ("energy", "exposure", "color")
_TEMPERATURE_PATHS = ("temperature", "use_temperature")
SWITCHES = ("follow_power", "follow_visibility", "follow_direction", "follow_distance")
"""The switches of a flare."""
DARK: Gain = (0.0, 0.0, 0.0)
_MIN_BLEND = 1e-4
"""Smallest soft edge of a spot's cone, cosines."""
RENDER_WAIT_S = 0.5
"""Pause until it is checked again whether a render has ended."""


def is_lamp(target: Any) -> bool:
    """Return whether a light object has power of its own."""
    return target is not None and target.type == "LIGHT"


def power_factor(scene: Any, depsgraph: Any, item: Any) -> Gain:
    """Return the linear RGB factor of a flare (`item`) at the current frame: the light of its lamp over the reference.

    It is 1 where the flare does not follow its lamp's power, and where the reference is dark.
    """
    target = item.target
    if not item.follow_power or not is_lamp(target):
        return WHITE
    reference = keyed_reference(scene, target.data)
    if reference is None:
        reference = np.array(item.reference_light)
    strongest = float(reference.max())
    if not strongest > 0:
        return WHITE
    present = light_of(target.evaluated_get(depsgraph).data)
    red, green, blue = np.clip(present / np.maximum(reference, MIN_CHANNEL * strongest), 0, MAX_FACTOR).tolist()
    return red, green, blue


def flare_gain(scene: Any, depsgraph: Any, item: Any, matrix: Any, eye: Any) -> Gain:
    """Return the linear RGB factor of a flare by the power and the direction of its lamp.

    matrix: matrix_world of the lamp. eye: position of the camera in the world.
    """
    red, green, blue = power_factor(scene, depsgraph, item)
    share = direction_factor(item, depsgraph, matrix, eye) if item.follow_direction else 1.0
    return red * share, green * share, blue * share


def is_sun(target: Any) -> bool:
    """Return whether a light object is a sun, which has no distance."""
    return is_lamp(target) and target.data.type == "SUN"


def has_direction(item: Any) -> bool:
    """Return whether a flare's lamp shines in some directions only, which `direction_factor` is for."""
    return is_lamp(item.target) and item.target.data.type in ("SPOT", "AREA")


def rendered_collections(scene: Any) -> set[Any]:
    """Return the collections that renders of the scene show, in any view layer."""
    return {collection for layer in scene.view_layers
            for collection in enabled_collections(layer.layer_collection, "hide_render")}


def is_visible(target: Any, depsgraph: Any, rendered: set[Any]) -> bool:
    """Return whether a light object shines at the current frame.

    It does not if it is disabled in renders or in viewports, nor if no collection of it is rendered. For an empty,
    which no render shows, only Disable in Renders counts. rendered: the collections that renders show.
    """
    evaluated = target.evaluated_get(depsgraph)
    if evaluated.hide_render or target.type == "EMPTY":
        return not evaluated.hide_render
    return not evaluated.hide_viewport and any(collection in rendered for collection in target.users_collection)


def direction_factor(item: Any, depsgraph: Any, matrix: Any, eye: Any) -> float:
    """Return the part of a lamp's light that goes to `eye`, 0..1: 0 outside the cone of a spot and behind an area
    light.

    matrix: matrix_world of the lamp. It is 1 for an area light that flares as an area, whose extent computes it.
    """
    if not has_direction(item):
        return 1.0
    data = item.target.evaluated_get(depsgraph).data
    if data.type == "AREA":
        return 1.0 if item.extent != "point" else _cosine(matrix.to_3x3(), eye - matrix.translation)
    local = matrix.inverted_safe() @ eye  # in the axes of the spot, which shines along -Z
    if local.length < 1e-9:
        return 1.0
    edge = float(np.cos(data.spot_size / 2))
    # 0 at the edge of the cone, 1 where its soft border ends, measured in cosines.
    border_position = (-local.z / local.length - edge) / max((1 - edge) * data.spot_blend, _MIN_BLEND)
    clamped = min(max(border_position, 0.0), 1.0)
    return clamped * clamped * (3 - 2 * clamped)  # as Blender's renderers soften the edge


def _cosine(rotation: Any, offset: Any) -> float:
    """Return the cosine of the angle between a lamp's -Z and an offset in the world; 0 behind the lamp, 1 at it."""
    normal = -rotation.col[2]
    length = normal.length * offset.length
    return max(float(normal.dot(offset)) / length, 0.0) if length > 0 else 1.0


def dark_reason(scene: Any, depsgraph: Any, item: Any, rendered: set[Any] | None = None) -> str:
    """Return why a flare is dark at the current frame by its switches, and what to do; "" where it is not.

    rendered: the collections that renders show; None to find them here.
    """
    target = item.target
    rendered = rendered_collections(scene) if rendered is None else rendered
    if item.follow_visibility and not is_visible(target, depsgraph, rendered):
        return f"{target.name} is disabled, and its flare with it: enable it, or switch Follow Visibility off."
    if item.follow_direction and scene.camera is not None and has_direction(item):
        matrix, eye = target.evaluated_get(depsgraph).matrix_world, scene.camera.matrix_world.translation
        if direction_factor(item, depsgraph, matrix, eye) <= 0:
            return f"{target.name} does not shine at the camera: turn it, or switch Follow Direction off."
    return ""


def report_dark(operator: Any, scene: Any) -> None:
    """Report the first flare that is dark by its switches; operators that add flares call it."""
    depsgraph = depsgraph_of(scene)
    for item in scene.fit_flare.lights:
        is_placed = item.target is not None and scene.objects.get(item.target.name) == item.target
        if is_placed and (reason := dark_reason(scene, depsgraph, item)):
            operator.report({"WARNING"}, reason)
            return


def light_of(data: Any) -> NDArray[np.float64]:
    """Return energy times colour (3,) of a lamp's data: W, or W/m² of a sun."""
    colour = np.array(data.color, np.float64)
    if getattr(data, "use_temperature", False):
        colour = colour * np.array(data.temperature_color)
    return colour * float(data.energy) * 2.0 ** float(getattr(data, "exposure", 0.0))


def keyed_reference(scene: Any, data: Any) -> NDArray[np.float64] | None:
    """Return the light (3,) of a lamp in the first frame of the scene, by its curves; at the brightest key for a lamp
    that is off in the first frame.

    None for a lamp without curves of power or colour, and for one that counts as driven.
    """
    curves = [curve for curve in _curves(data) if curve.data_path in _POWER_PATHS]
    if not curves or _is_data_driven(data):
        return None
    frames = [float(scene.frame_start), *(float(key.co[0]) for curve in curves for key in curve.keyframe_points)]
    lights = [_light_at_frame(data, curves, frame) for frame in frames]
    return lights[0] if lights[0].any() else max(lights, key=lambda light: float(light.sum()))


def _curves(data: Any) -> Iterator[Any]:
    for group in fcurves.fcurves_of(data):
        yield from group


def _light_at_frame(data: Any, curves: list[Any], frame: float) -> NDArray[np.float64]:
    """Return the light of a lamp at a frame by its curves; properties without a curve have their present value."""
    energy, exposure, colour = float(data.energy), float(getattr(data, "exposure", 0.0)), list(data.color)
    for curve in curves:
        value = float(curve.evaluate(frame))
        if curve.data_path == "color":
            colour[curve.array_index] = value
        elif curve.data_path == "energy":
            energy = value
        else:
            exposure = value
    if getattr(data, "use_temperature", False):
        colour = (np.array(colour) * np.array(data.temperature_color)).tolist()
    return np.array(colour, np.float64) * energy * 2.0**exposure


def is_driven(target: Any) -> bool:
    """Return whether the power or colour of a lamp is moved by drivers, or by keys of its temperature."""
    return is_lamp(target) and _is_data_driven(target.data)


def _is_data_driven(data: Any) -> bool:
    """Return whether drivers move the power, colour or temperature of a lamp's data, or keys its temperature.

    Only Blender can compute the light of such a lamp.
    """
    animation = data.animation_data
    return animation is not None and (
        any(curve.data_path in (*_POWER_PATHS, *_TEMPERATURE_PATHS) for curve in animation.drivers)
        or any(curve.data_path in _TEMPERATURE_PATHS for curve in _curves(data)))


def measure_references(scene: Any, item: Any) -> None:
    """Store the references of a flare: the distance of its light at the current frame, and the power of its lamp."""
    item.reference_distance = _camera_distance(scene, item.target)
    _measure_power(scene, item)


def _measure_power(scene: Any, item: Any) -> None:
    """Store the light of a flare's lamp as its reference; do nothing for an object that is no lamp.

    It is the light of the current frame, for a driven lamp that of the scene's first frame: the timeline moves to it
    and back.
    """
    target = item.target
    if not is_lamp(target):
        return
    current_frame, subframe = scene.frame_current, scene.frame_subframe
    is_at_other_frame = is_driven(target) and current_frame != scene.frame_start
    if is_at_other_frame:
        scene.frame_set(scene.frame_start)
    light = light_of(target.evaluated_get(depsgraph_of(scene)).data)
    if is_at_other_frame:
        scene.frame_set(current_frame, subframe=subframe)
    item.reference_light = light.tolist()
    item.reference_is_driven = is_driven(target)


def _camera_distance(scene: Any, target: Any) -> float:
    """Return the distance from the scene's camera to a light object; 0 without a camera, and for a sun."""
    if scene.camera is None or is_sun(target):
        return 0.0
    depsgraph = depsgraph_of(scene)
    camera, light = (item.evaluated_get(depsgraph).matrix_world.translation for item in (scene.camera, target))
    return float((light - camera).length)


def _is_outdated(item: Any) -> bool:
    """Return whether the lamp of a flare is driven, and its power was measured before it was driven."""
    return bool(item.follow_power and not item.reference_is_driven and is_driven(item.target))


def measure_driven(scene: Any) -> None:
    """Measure the power of driven lamps that were not driven when it was measured.

    Bakes, transfers and viewport renders call it first.
    """
    for item in scene.fit_flare.lights:
        if _is_outdated(item):
            _measure_power(scene, item)


def reference_note(scene: Any, item: Any) -> str:
    """Return where a flare gets the reference of its driven lamp, and how; "" for a flare that has it."""
    if not _is_outdated(item):
        return ""
    return (f"The driven power of {item.target.name} gets its reference in frame {scene.frame_start}: go to that "
            "frame, or bake.")


def _is_measurable(scene: Any) -> bool:
    """Return whether a reference is outdated and the scene is at its first frame.

    To move the timeline there would discard a pose that is not keyed yet.
    """
    return (scene.frame_current == scene.frame_start and not scene.frame_subframe
            and any(map(_is_outdated, scene.fit_flare.lights)))


def measure_soon(scene: Any) -> None:
    """Start a timer that calls `measure_driven`, if a reference is outdated and the scene is at its first frame.

    A redraw itself must not change the scene.
    """
    if _is_measurable(scene) and not bpy.app.timers.is_registered(measure_in_windows):
        bpy.app.timers.register(measure_in_windows, first_interval=0.0)


def measure_in_windows() -> float | None:
    """Call `measure_driven` for the scene of each window, and redraw. During a render, return the seconds to wait."""
    if bpy.app.is_job_running("RENDER"):
        return RENDER_WAIT_S
    for scene in {window.scene for window in bpy.context.window_manager.windows}:
        if _is_measurable(scene):
            measure_driven(scene)
            scene.update_tag()  # so that the flares are drawn anew
    redraw_viewports()
    return None


def unregister() -> None:
    """Stop the timer of `measure_soon`."""
    if bpy.app.timers.is_registered(measure_in_windows):
        bpy.app.timers.unregister(measure_in_windows)


def update_for_target(item: Any, _context: Any) -> None:
    """Measure the references of a flare that gets another light object, and set its switches.

    At a light of the capture they are switched off. At an object of the artist they are switched on, unless the flare
    was at one before: then they stay as the artist set them.
    """
    scene, target = item.id_data, item.target
    if not isinstance(scene, bpy.types.Scene) or target is None:
        return
    is_capture_light = target.fit_flare.is_light
    if is_capture_light or not item.is_at_artists_light:
        for name in SWITCHES:
            setattr(item, name, not is_capture_light)
    item.is_at_artists_light = not is_capture_light
    item.reference_distance = _camera_distance(scene, target)
    if is_lamp(target):
        item.reference_light = light_of(target.data).tolist()
        item.reference_is_driven = False  # `measure_driven` measures a driven lamp at the first frame
