# SPDX-License-Identifier: GPL-3.0-or-later
"""What a .blend remembers of Fit Flare: the capture, the run, the look with its edits, the bake.

All of it hangs on the scene (`scene.fit_flare`) and on light objects (`object.fit_flare`), so two scenes
keep two looks, and every number can be animated and driven (`fit_flare.lights[0].intensity`).
"""
from __future__ import annotations

import dataclasses
import math
from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..core.choices import ITERATIONS, Mode, Preset
from ..core.conventions.exposures import LEAST
from ..core.look import Edit

# From 4.5 on a path that may be relative to the .blend has to say so; before, the word is unknown.
PATH = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else set()

OVERRIDABLE = {"LIBRARY_OVERRIDABLE"}
"""For what a .blend may say of an object that is linked into it: without, it would be forgotten when it is saved."""

PRESETS: tuple[tuple[Preset, str, str], ...] = (
    ("draft", "Draft", f"A first look in minutes: {ITERATIONS['draft']:,} iterations"),
    ("standard", "Standard", f"Good for most shots: {ITERATIONS['standard']:,} iterations"),
    ("high", "High", f"For final layers: {ITERATIONS['high']:,} iterations"),
)
MODES: tuple[tuple[Mode, str, str, int], ...] = (  # files hold the numbers
    ("default", "Clean Frames", "The capture has the frames without flare in its folder removed/ (or truth/scene/), "
     "and they are taken for exact", 0),
    ("estimated", "Estimated Frames", "Those that Make Clean Frames makes, or the fit itself before it begins: "
     "they help to find the scene, and by parallax it is told from what they leave of the flare, in a fit that is a "
     "fifth longer", 2),
    ("split", "No Clean Frames", "Without frames without flare: scene and flare are told apart by parallax alone, in "
     "a fit that is a fifth longer", 1),
)


def redraw(_self: Any = None, _context: Any = None) -> None:
    """Have every 3D viewport drawn again: the overlay shows what was changed."""
    manager = getattr(bpy.context, "window_manager", None)
    for window in manager.windows if manager else ():
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def _footage(self: Any, _context: Any) -> None:
    """Show the frames as filmed or without flare behind the cameras."""
    from .capture.importer import show_footage

    show_footage(self.id_data, self.footage)


class Edits:
    """The sliders of a look, for all lights, one light, or one element (core.look.Edit)."""

    intensity: FloatProperty(  # type: ignore[valid-type]
        name="Intensity", description="How bright: a factor on the linear light", default=1.0, min=0.0, soft_max=4.0,
        max=1000.0, update=redraw)
    scale: FloatProperty(  # type: ignore[valid-type]
        name="Scale", description="Size of each ghost, glare and streak about its own centre", default=1.0, min=0.0,
        soft_max=4.0, max=100.0, update=redraw)
    spread: FloatProperty(  # type: ignore[valid-type]
        name="Spread", description="Distance of the ghosts from the light, along the line through the picture's centre",
        default=1.0, min=0.0, soft_max=3.0, max=100.0, update=redraw)
    rotation: FloatProperty(  # type: ignore[valid-type]
        name="Rotation", description="Turns each ghost, glare and streak about its own centre", default=0.0,
        subtype="ANGLE", update=redraw)
    tint: FloatVectorProperty(  # type: ignore[valid-type]
        name="Tint", description="Colour on the flare; white leaves it as it was filmed", default=(1.0, 1.0, 1.0),
        size=3, subtype="COLOR", min=0.0, soft_max=1.0, max=100.0, update=redraw)
    saturation: FloatProperty(  # type: ignore[valid-type]
        name="Saturation", description="0 is grey, 1 as it was filmed", default=1.0, min=0.0, soft_max=2.0, max=10.0,
        update=redraw)
    streak: FloatProperty(  # type: ignore[valid-type]
        name="Streak Length", description="Stretches the streaks along themselves", default=1.0, min=0.0, soft_max=4.0,
        max=100.0, update=redraw)
    mute: BoolProperty(  # type: ignore[valid-type]
        name="Mute", description="Leave this out", default=False, update=redraw)
    solo: BoolProperty(  # type: ignore[valid-type]
        name="Solo", description="Leave out all the others", default=False, update=redraw)


EDIT_NAMES = tuple(entry.name for entry in dataclasses.fields(Edit))


def edit_of(sliders: Any) -> Edit:
    """The edit that sliders (an `Edits` group) stand for."""
    red, green, blue = sliders.tint
    return Edit(intensity=sliders.intensity, tint=(red, green, blue), saturation=sliders.saturation,
                scale=sliders.scale, spread=sliders.spread, rotation=math.degrees(sliders.rotation),
                streak=sliders.streak, mute=sliders.mute, solo=sliders.solo)


class FITFLARE_PG_master(Edits, bpy.types.PropertyGroup):
    """Sliders of all lights together."""


class FITFLARE_PG_element(Edits, bpy.types.PropertyGroup):
    """Sliders of one element; `name` is the element's in the .flare."""

    kind: StringProperty()  # type: ignore[valid-type]


class FITFLARE_PG_light(Edits, bpy.types.PropertyGroup):
    """One flare in the scene: which light of the .flare it shows, and where. `name` is its layer's."""

    source: StringProperty(  # type: ignore[valid-type]
        name="Look", description="The light of the .flare whose look this is")
    target: PointerProperty(  # type: ignore[valid-type]
        name="Light", description="The object that the flare comes from: move it and the flare follows",
        type=bpy.types.Object, update=redraw)
    identity: StringProperty()  # type: ignore[valid-type]  # by which its baked layers know it under any name
    elements: CollectionProperty(type=FITFLARE_PG_element)  # type: ignore[valid-type]
    element: IntProperty(name="Element", description="The element whose sliders are shown", default=0)  # type: ignore[valid-type]
    show_elements: BoolProperty(  # type: ignore[valid-type]
        name="Elements", description="Show the sliders of single ghosts, streaks and rings", default=False)
    radius: FloatProperty(  # type: ignore[valid-type]
        name="Light Size", description="Radius of the light for occlusion, in scene units; 0 takes 2% of its distance. "
        "The larger, the softer the flare fades behind things", default=0.0, min=0.0, subtype="DISTANCE", update=redraw)


class FITFLARE_PG_scene(bpy.types.PropertyGroup):
    """Everything of one scene."""

    capture: StringProperty(  # type: ignore[valid-type]
        name="Capture", description="Folder with images/, a camera solve and lights.json", subtype="DIR_PATH",
        options=PATH)
    root: PointerProperty(  # type: ignore[valid-type]
        name="Root", description="The empty that carries the imported capture: move, turn or scale it as you like",
        type=bpy.types.Object, update=redraw)

    known_lights: StringProperty()  # type: ignore[valid-type]
    footage: EnumProperty(  # type: ignore[valid-type]
        name="Footage", description="Which frames are shown behind the cameras",
        items=(("images", "As Filmed", "The frames with their own flare"),
               ("removed", "Without Flare", "The frames of removed/, to see the flare over a clean plate")),
        update=_footage)

    matte: StringProperty(  # type: ignore[valid-type]
        name="Matte", description="Where the flares are, white on black, roughly painted: a picture for all frames, or "
        "a folder with one for each, of its name. Faint flares are taken too then, and nothing elsewhere. Empty has "
        "them found", subtype="FILE_PATH", options=PATH)
    keep_glow: BoolProperty(  # type: ignore[valid-type]
        name="Keep Glow", description="Leave the glow round the lights in the clean frames: it stays with the scene, "
        "and the flare is learned without it", default=False)
    run: StringProperty(  # type: ignore[valid-type]
        name="Run", description="Folder of the fit: settings, checkpoint, preview and result", subtype="DIR_PATH",
        options=PATH)
    preset: EnumProperty(  # type: ignore[valid-type]
        name="Quality", description="How long and how fine the fit is", items=PRESETS, default="draft")
    mode: EnumProperty(  # type: ignore[valid-type]
        name="Supervision", description="What there is of frames without flare, from which the scene is learned",
        items=MODES)
    width: IntProperty(  # type: ignore[valid-type]
        name="Width", description="Work at this width in pixels at most; 0 takes the frames' own", default=0, min=0,
        max=16384)

    flare: StringProperty(  # type: ignore[valid-type]
        name="Flare", description="The .flare file that is shown", subtype="FILE_PATH",
        options=PATH, update=redraw)
    native: BoolProperty(  # type: ignore[valid-type]
        name="Of This Capture", description="The flare was learned from the imported capture, so its appearance "
        "follows the camera; in another scene it keeps its middle look", default=False, update=redraw)
    lights: CollectionProperty(type=FITFLARE_PG_light)  # type: ignore[valid-type]
    light: IntProperty(name="Light", description="The light whose sliders are shown", default=0)  # type: ignore[valid-type]
    master: PointerProperty(type=FITFLARE_PG_master)  # type: ignore[valid-type]
    show: BoolProperty(  # type: ignore[valid-type]
        name="Show in Viewport", description="Draw the flare over the camera view", default=True, update=redraw)
    occlusion: BoolProperty(  # type: ignore[valid-type]
        name="Hide behind Objects", description="Fade the flare where an object stands between camera and light",
        default=True, update=redraw)

    layers: StringProperty(  # type: ignore[valid-type]
        name="Layers", description="Folder for the EXR layers", subtype="DIR_PATH",
        options=PATH)
    bake_range: EnumProperty(  # type: ignore[valid-type]
        name="Frames", description="Which frames are baked",
        items=(("scene", "Scene Range", "All frames of the scene"), ("current", "Current", "This frame alone"),
               ("custom", "Custom", "From one frame to another")))
    bake_first: IntProperty(name="First", description="First frame to bake", default=1)  # type: ignore[valid-type]
    bake_last: IntProperty(name="Last", description="Last frame to bake", default=1)  # type: ignore[valid-type]
    bake_scene: BoolProperty(  # type: ignore[valid-type]
        name="Fitted Scene Too", description="Render the scene that the fit learned as a layer; else there are layers "
        "of the flare alone", default=False)
    bake_live: BoolProperty(  # type: ignore[valid-type]
        name="Keep Colours Live", description="Leave Intensity, Tint, Mute and Solo of whole lights out of the layers: "
        "the compositor applies them, so they can be changed without baking again", default=True)
    over: EnumProperty(  # type: ignore[valid-type]
        name="Over", description="What the flare is laid over in the compositor",
        items=(("present", "Present Image", "What the compositor shows now, or the render"),
               ("plate", "Footage", "The capture's frames"),
               ("scene", "Baked Scene", "The fitted scene in the layers")))


class FITFLARE_PG_object(bpy.types.PropertyGroup):
    """Of a light object, or a camera's."""

    is_light: BoolProperty(  # type: ignore[valid-type]
        name="Light of the Capture", description="The fit learns a flare for this object", default=False,
        override=OVERRIDABLE)
    light: StringProperty(  # type: ignore[valid-type]
        name="Light Name", description="Name of the light in lights.json and the .flare", override=OVERRIDABLE)
    is_points: BoolProperty()  # type: ignore[valid-type]
    is_root: BoolProperty()  # type: ignore[valid-type]
    is_made: BoolProperty()  # type: ignore[valid-type]
    view: StringProperty(name="Frame", description="Name of the frame of the capture that this camera is")  # type: ignore[valid-type]
    exposure: FloatProperty(  # type: ignore[valid-type]
        name="Exposure", description="Light on this camera's frame, in parts of a usual one's: its flare is as much "
        "brighter. A fit sets and animates it for a capture whose exposure changes", default=1.0, min=LEAST,
        max=1 / LEAST, soft_min=0.1, soft_max=10.0, update=redraw, override=OVERRIDABLE)


_CLASSES = (FITFLARE_PG_master, FITFLARE_PG_element, FITFLARE_PG_light, FITFLARE_PG_scene, FITFLARE_PG_object)


def register() -> None:
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.fit_flare = PointerProperty(type=FITFLARE_PG_scene)
    bpy.types.Object.fit_flare = PointerProperty(type=FITFLARE_PG_object, override=OVERRIDABLE)


def unregister() -> None:
    del bpy.types.Object.fit_flare
    del bpy.types.Scene.fit_flare
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
