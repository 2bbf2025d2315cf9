# SPDX-License-Identifier: GPL-3.0-or-later
"""The power and colour of a lamp as a factor on its flare, relative to a reference.

`looks.place_lights` multiplies flares with it, so the overlay, bakes and transfers follow the lamp alike. The reference
is the lamp's light in the first frame of the scene:

    keyed lamp     computed from its curves, so it follows them
    driven lamp    measured at the first frame, when the flare gets the lamp or when a bake reads the scene
    other lamp     measured when the flare gets the lamp, so that a change by hand dims the flare

An empty or a mesh has no power; its factor is 1.
"""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from . import fcurves
from .objects import view_layer_of

Gain = tuple[float, float, float]

WHITE: Gain = (1.0, 1.0, 1.0)
MIN_CHANNEL = 1e-3
"""Smallest reference of a colour channel relative to the largest: a red lamp that turns blue has a finite factor."""
MAX_FACTOR = 1e6
_PATHS = ("energy", "exposure", "color")


def is_lamp(target: Any) -> bool:
    """Return whether a light object has power of its own."""
    return target is not None and target.type == "LIGHT"


def factor(scene: Any, depsgraph: Any, item: Any) -> Gain:
    """Return the linear RGB factor of a flare at the current frame; 1 where it does not follow its lamp's power."""
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


def light_of(data: Any) -> NDArray[np.float64]:
    """Return energy times colour (3,) of a lamp's data: W, or W/m² of a sun."""
    colour = np.array(data.color, np.float64)
    if getattr(data, "use_temperature", False):
        colour = colour * np.array(data.temperature_color)
    return colour * float(data.energy) * 2.0 ** float(getattr(data, "exposure", 0.0))


def keyed_reference(scene: Any, data: Any) -> NDArray[np.float64] | None:
    """Return the light (3,) of a lamp in the first frame of the scene, by its curves; None for a lamp without curves.

    For a lamp that is off in the first frame it is its light at the brightest key.
    """
    curves = [curve for curve in _curves(data) if curve.data_path in _PATHS]
    if not curves:
        return None
    frames = [float(scene.frame_start), *(float(key.co[0]) for curve in curves for key in curve.keyframe_points)]
    lights = [_light_at(data, curves, frame) for frame in frames]
    return lights[0] if lights[0].any() else max(lights, key=lambda light: float(light.sum()))


def _curves(data: Any) -> Iterator[Any]:
    for group in fcurves.fcurves_of(data):
        yield from group


def _light_at(data: Any, curves: list[Any], frame: float) -> NDArray[np.float64]:
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
    """Return whether drivers move the power or colour of a lamp."""
    animation = target.data.animation_data if is_lamp(target) else None
    return animation is not None and any(curve.data_path in _PATHS for curve in animation.drivers)


def measure(scene: Any, item: Any) -> None:
    """Store the reference of a flare's lamp: its light in the first frame of the scene for a driven lamp, else now.

    For a driven lamp this moves the timeline to the first frame and back.
    """
    target = item.target
    if not is_lamp(target):
        return
    layer = view_layer_of(scene)
    before, subframe = scene.frame_current, scene.frame_subframe
    driven = is_driven(target) and before != scene.frame_start
    if driven:
        scene.frame_set(scene.frame_start)
    light = light_of(target.evaluated_get(layer.depsgraph).data)
    if driven:
        scene.frame_set(before, subframe=subframe)
    item.reference_light = light.tolist()
    item.reference_is_driven = is_driven(target)


def measure_driven(scene: Any) -> None:
    """Measure the references of driven lamps that were not driven when they were measured; a bake begins with it."""
    for item in scene.fit_flare.lights:
        if item.follow_power and is_lamp(item.target) and is_driven(item.target) and not item.reference_is_driven:
            measure(scene, item)


def on_target(item: Any, _context: Any) -> None:
    """Measure the reference when a flare gets another light object."""
    scene = item.id_data
    if isinstance(scene, bpy.types.Scene) and is_lamp(item.target):
        item.reference_light = light_of(item.target.data).tolist()
        item.reference_is_driven = False
