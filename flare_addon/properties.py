# SPDX-License-Identifier: GPL-3.0-or-later
"""The properties that a .blend stores: the capture, the run, the look with its edits, the bake.

They belong to the scene (`scene.fit_flare`) and to objects (`object.fit_flare`), so each scene has a look of its own,
and every number can be animated and driven (`fit_flare.lights[0].intensity`).
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
from ..core.conventions.exposures import MIN_EXPOSURE
from ..core.look import Edit
from .plate_space import clear_recorded_space, search_names
from .views import redraw_viewports
from .working_space import picked_from_tint, tint_from_picked

# From 4.5 on this option permits paths relative to the .blend; earlier versions do not know it.
PATH_OPTIONS = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else set()

OVERRIDABLE = {"LIBRARY_OVERRIDABLE"}
"""Option for properties of linked objects, whose values would otherwise not be saved."""

PRESETS: tuple[tuple[Preset, str, str], ...] = (
    ("draft", "Draft", f"A first result in minutes: {ITERATIONS['draft']:,} iterations"),
    ("standard", "Standard", f"Good for most shots: {ITERATIONS['standard']:,} iterations"),
    ("high", "High", f"For final layers: {ITERATIONS['high']:,} iterations"),
)
MODES: tuple[tuple[Mode, str, str, int], ...] = (  # a .blend stores the numbers
    ("default", "Exact Clean Frames", "Use the clean frames in the capture's folder removed/ (or truth/scene/) and "
     "take them as exact", 0),
    ("estimated", "Estimated Clean Frames", "Use the clean frames of Make Clean Frames, or those that the "
     "removal network makes when the fit starts. Parallax separates their remaining flare. The fit takes longer", 2),
    ("split", "No Clean Frames", "Separate scene and flare by parallax alone. The fit takes longer", 1),
)


def _update_target(self: Any, context: Any) -> None:
    """Measure power and distance of a flare's new light object, set the flare's switches, and redraw."""
    from .lamp_drive import update_for_target

    update_for_target(self, context)
    redraw_viewports()


def _highlight_element(self: Any, _context: Any) -> None:
    """Highlight the chosen element in the camera view."""
    from .highlight import start_highlight

    start_highlight(self)


USUAL_WIDTH = 960
"""Width of a fit, pixels, when Limit Width is switched on."""


def _limits_width(self: Any) -> bool:
    """Return whether the fit is smaller than the frames."""
    return bool(self.width > 0)


def _limit_width(self: Any, value: bool) -> None:
    """Limit the width of the fit, or use the width of the frames."""
    self.width = (self.width or USUAL_WIDTH) if value else 0


def _update_footage(self: Any, _context: Any) -> None:
    """Show the frames as filmed, or the clean frames, behind the cameras."""
    from .capture.importer import show_footage

    show_footage(self.id_data, self.footage)


class Edits:
    """The sliders of a look, for all lights, one light, or one element (core.look.Edit)."""

    intensity: FloatProperty(  # type: ignore[valid-type]
        name="Intensity", description="Brightness: a factor on the linear light", default=1.0, min=0.0, soft_max=4.0,
        max=1000.0, update=redraw_viewports)
    scale: FloatProperty(  # type: ignore[valid-type]
        name="Scale", description="Size of each ghost, streak, ring and glare about its own centre", default=1.0,
        min=0.0, soft_max=4.0, max=100.0, update=redraw_viewports)
    spread: FloatProperty(  # type: ignore[valid-type]
        name="Spread", description="Distance of the ghosts from the light, along the line through the centre of the "
                                   "picture",
        default=1.0, min=0.0, soft_max=3.0, max=100.0, update=redraw_viewports)
    rotation: FloatProperty(  # type: ignore[valid-type]
        name="Rotation", description="Angle by which each ghost, streak, ring and glare turns about its own centre",
        default=0.0, subtype="ANGLE", update=redraw_viewports)
    tint: FloatVectorProperty(  # type: ignore[valid-type]
        name="Tint", description="Colour that multiplies the flare; white leaves it as filmed", default=(1.0, 1.0, 1.0),
        size=3, subtype="COLOR", min=0.0, soft_max=1.0, max=100.0, update=redraw_viewports)
    saturation: FloatProperty(  # type: ignore[valid-type]
        name="Saturation", description="Colour saturation of the flare: 0 is grey, 1 as filmed", default=1.0, min=0.0,
        soft_max=2.0, max=10.0, update=redraw_viewports)
    streak: FloatProperty(  # type: ignore[valid-type]
        name="Streak Length", description="Length of the streaks along their direction", default=1.0, min=0.0,
        soft_max=4.0, max=100.0, update=redraw_viewports)
    mute: BoolProperty(  # type: ignore[valid-type]
        name="Mute", description="Hide this flare or element", default=False, update=redraw_viewports)
    solo: BoolProperty(  # type: ignore[valid-type]
        name="Solo", description="Show only this flare or element, and others that are solo", default=False,
        update=redraw_viewports)
    moved_sliders: StringProperty()  # type: ignore[valid-type]  # names; another look does not set these sliders


EDIT_NAMES = tuple(entry.name for entry in dataclasses.fields(Edit))


def edit_of(sliders: Any) -> Edit:
    """Return the edit that a group of sliders makes; the tint is converted from Blender's working space."""
    red, green, blue = sliders.tint
    return Edit(intensity=sliders.intensity, tint=tint_from_picked((red, green, blue)), saturation=sliders.saturation,
                scale=sliders.scale, spread=sliders.spread, rotation=math.degrees(sliders.rotation),
                streak=sliders.streak, mute=sliders.mute, solo=sliders.solo)


def set_slider(sliders: Any, name: str, value: Any) -> None:
    """Set a slider to the value that an edit has for it: a rotation in degrees, a tint in linear Rec. 709."""
    if name == "tint":
        value = picked_from_tint(value)
    setattr(sliders, name, math.radians(value) if name == "rotation" else value)


class FITFLARE_PG_master(Edits, bpy.types.PropertyGroup):
    """The sliders of all lights together."""


class FITFLARE_PG_element(Edits, bpy.types.PropertyGroup):
    """The sliders of one element; `name` is the name of the element in the .flare."""

    kind: StringProperty()  # type: ignore[valid-type]
    # Whether the current look lacks it; the list hides it until a look has it again.
    is_absent: BoolProperty()  # type: ignore[valid-type]


class FITFLARE_PG_light(Edits, bpy.types.PropertyGroup):
    """One flare in the scene: the light of the .flare whose look it has, and its light object.

    `name` names its layer.
    """

    source: StringProperty(  # type: ignore[valid-type]
        name="Look", description="The light of the .flare that this flare looks like", update=redraw_viewports)
    # The light of the first look; later looks prefer a light of this name.
    first_source: StringProperty()  # type: ignore[valid-type]
    target: PointerProperty(  # type: ignore[valid-type]
        name="Light", description="The light object of this flare; the flare follows it",
        type=bpy.types.Object, update=_update_target)
    follow_power: BoolProperty(  # type: ignore[valid-type]
        name="Follow Power", description="Power and colour of the lamp brighten, dim and colour its flare: relative to "
        "the first frame of the scene if they are animated, else to the time when the lamp got its flare",
        default=True, update=redraw_viewports)
    follow_visibility: BoolProperty(  # type: ignore[valid-type]
        name="Follow Visibility", description="No flare while the light object is disabled in renders; for a lamp or a "
        "mesh, also while it is disabled in viewports or no collection of it is rendered", default=False,
        update=redraw_viewports)
    follow_direction: BoolProperty(  # type: ignore[valid-type]
        name="Follow Direction", description="The flare dims with the lamp's light in the direction of the camera: at "
        "the edge of a spot's cone, and beside an area light that flares as a point", default=False,
        update=redraw_viewports)
    follow_distance: BoolProperty(  # type: ignore[valid-type]
        name="Follow Distance", description="The flare dims with the square of the distance from the camera to the "
        "light", default=False, update=redraw_viewports)
    reference_distance: FloatProperty(  # type: ignore[valid-type]
        name="Reference", description="Distance from the camera to the light at which the flare has its own "
        "brightness; it is measured when the flare gets its light object", default=0.0, min=0.0, subtype="DISTANCE",
        update=redraw_viewports)
    is_at_artists_light: BoolProperty()  # type: ignore[valid-type]  # not at a light of the capture, nor without one
    # The lamp's linear RGB light at which the flare has its own brightness, and whether drivers moved it when measured.
    reference_light: FloatVectorProperty(size=3, default=(0.0, 0.0, 0.0))  # type: ignore[valid-type]
    reference_is_driven: BoolProperty()  # type: ignore[valid-type]
    extent: EnumProperty(  # type: ignore[valid-type]
        name="Extent", description="Whether the light flares as a point or as the sum over its visible part",
        items=(("auto", "Automatic", "Area lights as areas, other lights as points"),
               ("point", "Point", "A point at the origin of the object"),
               ("shape", "Shape", "The area of an area light, the radius of another lamp, the surface of a mesh, a "
                                  "curve. This is slower")),
        default="auto", update=redraw_viewports)
    identity: StringProperty()  # type: ignore[valid-type]  # stays when the flare is renamed; the baked layers store it
    elements: CollectionProperty(type=FITFLARE_PG_element)  # type: ignore[valid-type]
    element: IntProperty(  # type: ignore[valid-type]
        name="Element", description="The element whose sliders are shown", default=0, update=_highlight_element)
    show_elements: BoolProperty(  # type: ignore[valid-type]
        name="Elements", description="Show the sliders of single ghosts, streaks, rings and the glare", default=False)
    radius: FloatProperty(  # type: ignore[valid-type]
        name="Light Size", description="Radius of the light for occlusion, in scene units; 0 uses 2% of its distance. "
        "With a larger radius the flare fades more softly behind objects", default=0.0, min=0.0, subtype="DISTANCE",
        update=redraw_viewports)


class FITFLARE_PG_scene(bpy.types.PropertyGroup):
    """The properties of a scene."""

    capture: StringProperty(  # type: ignore[valid-type]
        name="Capture", description="Folder with images/, a camera solve and lights.json", subtype="DIR_PATH",
        options=PATH_OPTIONS)
    root: PointerProperty(  # type: ignore[valid-type]
        name="Root", description="The parent object of the imported capture; move, rotate or scale it to place the "
                                 "capture",
        type=bpy.types.Object, update=redraw_viewports)

    known_lights: StringProperty()  # type: ignore[valid-type]  # all lights that it ever had (lights.remember_names)
    footage: EnumProperty(  # type: ignore[valid-type]
        name="Footage", description="Which frames are shown behind the cameras",
        items=(("images", "As Filmed", "The frames as filmed, with their flare"),
               ("removed", "Clean", "The clean frames of removed/, so that only the fitted flare is visible")),
        update=_update_footage)

    plate_space: StringProperty(  # type: ignore[valid-type]
        name="Colour Space", description="Colour space of the frames, where their files do not declare it: a camera's "
        "logarithm (logc4, slog3, vlog, ...) or a colour space of Blender. If empty, the capture or the files declare "
        "it", search=search_names, search_options={"SUGGESTION"}, update=clear_recorded_space)
    matte: StringProperty(  # type: ignore[valid-type]
        name="Matte", description="Where the flares are, roughly painted in white on black: one picture for all "
        "frames, or a folder with one of the same name for each. In white areas, faint flares are removed too; in "
        "black areas, nothing is removed. Without a matte, the network finds the flares", subtype="FILE_PATH",
        options=PATH_OPTIONS)
    keep_glow: BoolProperty(  # type: ignore[valid-type]
        name="Keep Glow", description="Keep the glow around the lights in the clean frames: it becomes part of the "
        "scene, and the fit learns the flare without it", default=False)
    run: StringProperty(  # type: ignore[valid-type]
        name="Run", description="Folder of the fit: settings, checkpoint, preview and result", subtype="DIR_PATH",
        options=PATH_OPTIONS)
    preset: EnumProperty(  # type: ignore[valid-type]
        name="Preset", description="Length and size of the fit", items=PRESETS, default="draft")
    mode: EnumProperty(  # type: ignore[valid-type]
        name="Learn From", description="Where the fit gets clean frames, which show the scene without flare",
        items=MODES)
    width: IntProperty(  # type: ignore[valid-type]
        name="Width", description="Largest width in pixels of the frames in the fit; 0 uses the width of the frames",
        default=0, min=0, max=16384)
    limits_width: BoolProperty(  # type: ignore[valid-type]
        name="Limit Width", description="Fit smaller frames, which is faster; otherwise the fit uses the width of the "
        "frames", get=_limits_width, set=_limit_width)

    flare: StringProperty(  # type: ignore[valid-type]
        name="Flare", description="The .flare file that the scene shows", subtype="FILE_PATH",
        options=PATH_OPTIONS, update=redraw_viewports)
    file_edits: StringProperty()  # type: ignore[valid-type]  # the edits in the .flare when it was opened, as JSON
    native: BoolProperty(  # type: ignore[valid-type]
        name="Of This Capture", description="The flare was learned from the imported capture, so its appearance "
        "follows the camera; in another scene it keeps the appearance of one training view", default=False,
        update=redraw_viewports)
    lights: CollectionProperty(type=FITFLARE_PG_light)  # type: ignore[valid-type]
    light: IntProperty(name="Light", description="The light whose sliders are shown", default=0)  # type: ignore[valid-type]
    master: PointerProperty(type=FITFLARE_PG_master)  # type: ignore[valid-type]
    show: BoolProperty(  # type: ignore[valid-type]
        name="Show in Viewport", description="Draw the flare over the camera view", default=True,
        update=redraw_viewports)
    occlusion: BoolProperty(  # type: ignore[valid-type]
        name="Hide behind Objects", description="Fade the flare where an object is between camera and light",
        default=True, update=redraw_viewports)

    layers: StringProperty(  # type: ignore[valid-type]
        name="Layers", description="Folder for the EXR layers", subtype="DIR_PATH",
        options=PATH_OPTIONS)
    bake_range: EnumProperty(  # type: ignore[valid-type]
        name="Frames", description="Which frames are baked. Scene Range and Custom bake one frame per Step of Output > "
        "Frame Range",
        items=(("scene", "Scene Range", "The frames of the scene's range"),
               ("current", "Current", "The current frame alone"),
               ("custom", "Custom", "From a first to a last frame")))
    bake_first: IntProperty(name="First", description="First frame to bake", default=1)  # type: ignore[valid-type]
    bake_last: IntProperty(name="Last", description="Last frame to bake", default=1)  # type: ignore[valid-type]
    bake_scene: BoolProperty(  # type: ignore[valid-type]
        name="Fitted Scene Too", description="Also render the scene of the fit as a layer; without it, there are only "
        "layers of the flare", default=False)
    bake_live: BoolProperty(  # type: ignore[valid-type]
        name="Keep Colours Live", description="Do not bake Intensity, Tint, Mute and Solo of lights into the layers; "
        "the compositor applies them, so you can change them without baking again", default=True)
    bake_composite: BoolProperty(  # type: ignore[valid-type]
        name="Composite Too", description="Also set the compositor up when the layers are baked, so that "
        "renders show the flare over the picture chosen under Over", default=True)
    over: EnumProperty(  # type: ignore[valid-type]
        name="Over", description="The picture that the compositor adds the flare to",
        items=(("present", "Render", "The render, or the output of your own nodes in the compositor"),
               ("plate", "Footage", "The frames behind the camera. If the film is transparent, the objects of the "
                "scene are in front of them"),
               ("scene", "Baked Scene", "The fitted scene in the layers")))


class FITFLARE_PG_object(bpy.types.PropertyGroup):
    """The properties of a light object or a camera."""

    is_light: BoolProperty(  # type: ignore[valid-type]
        name="Light of the Capture", description="The fit learns a flare for this object", default=False,
        override=OVERRIDABLE)
    light: StringProperty(  # type: ignore[valid-type]
        name="Light Name", description="Name of the light in lights.json and in the .flare", override=OVERRIDABLE)
    asset_look: StringProperty()  # type: ignore[valid-type]  # the look of an asset that was not dropped yet
    is_points: BoolProperty()  # type: ignore[valid-type]  # the point cloud of a capture
    is_root: BoolProperty()  # type: ignore[valid-type]  # the root of an imported capture
    is_made: BoolProperty()  # type: ignore[valid-type]  # an empty that was made for a light; deleted with the light
    is_placeholder: BoolProperty()  # type: ignore[valid-type]  # a new light of Add Flare that Pick Light may move
    view: StringProperty(name="Frame", description="Name of the capture's frame that this camera belongs to")  # type: ignore[valid-type]
    exposure: FloatProperty(  # type: ignore[valid-type]
        name="Exposure", description="Exposure of this camera relative to the median frame: a factor on its flare. A "
        "fit sets and animates it for a capture whose exposure changes", default=1.0, min=MIN_EXPOSURE,
        max=1 / MIN_EXPOSURE, soft_min=0.1, soft_max=10.0, update=redraw_viewports, override=OVERRIDABLE)


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
