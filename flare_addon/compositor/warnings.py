# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings about scene settings that keep a render from showing the composite."""
from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

from ...core.bake.folder import LayerFolder
from ...core.conventions.frame_numbers import NumberedFrame, missing_numbers
from ...core.errors import FrameError
from ...core.images.picture import same_aspect
from .. import stereo
from . import drivers, flare_node, footage, layer_nodes, setup, trees

_SPHERICAL = ("The camera has Spherical Stereo, with which the flares do not lie on the lights; switch it off in the "
              "camera's Stereoscopy settings.")


def warnings(scene: Any, layer_folders: Sequence[LayerFolder], live: bool) -> Iterator[str]:
    """Yield a warning for each problem of a scene whose compositor shows layers.

    layer_folders: that of each view of a stereo scene, else one. live: the sliders of the panel drive the compositor.
    """
    render = scene.render
    if not render.use_compositing:
        yield ("Compositing is switched off for this scene, so renders have no flare; switch it on in the output "
               "properties, under Post Processing.")
    if trees.is_off_in_renders(scene):
        yield ("The compositor effect with the flare is switched off for renders, so they have no flare; switch it on "
               "in the list of effects.")
    yield from stereo_warnings(scene)
    if footage.OBJECTS in trees.tree_of(scene).nodes and (note := footage_note(scene)):
        yield note
    if strips := _active_strips(scene):
        yield (f"Renders show the video sequencer, which has {strips[0].name!r}, in place of the compositor, without "
               "the flare; switch Sequencer off in the output properties, under Post Processing.")
    if render.film_transparent and setup.is_over_render(scene) and _loses_light(render.image_settings):
        yield (f"The film is transparent, and {render.image_settings.file_format} files lose the flare where alpha is "
               "0; render to OpenEXR, or without alpha (RGB).")
    width, height = layer_folders[0].size()
    if not same_aspect((width, height), (render.resolution_x, render.resolution_y)):
        yield (f"The layers have {width} x {height} pixels and the scene renders {render.resolution_x} x "
               f"{render.resolution_y}, another aspect ratio, to which they are stretched; bake them again.")
    baked = [NumberedFrame(view="", number=number, file="") for number in layer_folders[0].files
             if all(number in layers.files for layers in layer_folders)]
    first, last, step = scene.frame_start, max(scene.frame_end, scene.frame_start), scene.frame_step
    start = first if first >= 0 else first % step  # layers have no negative numbers
    if missing := missing_numbers(baked, f"{start}-{max(last, start)}:{step}"):
        effect = "this version of Blender shows in magenta" if flare_node.MISSING_IS_MAGENTA else "are without flare"
        steps = f" in steps of {step}" if step > 1 else ""
        yield (f"The scene has the frames {scene.frame_start}-{scene.frame_end}{steps}, and there are no layers of "
               f"{missing}, which {effect}; bake them too.")
    if live and drivers.is_animated(scene):
        yield ("Sliders that act on it are animated: without this extension, as on a farm, they do not move; bake "
               "without Keep Colours Live for that.")
    if warning := layer_nodes.colour_space_warning(scene):
        yield warning


def footage_note(scene: Any) -> str:
    """Return how a render over footage differs from the camera view, and what to do; "" where it does not."""
    tree, is_transparent = trees.tree_of(scene), scene.render.film_transparent
    nodes = () if tree is None else tree.nodes
    if footage.OBJECTS in nodes and not is_transparent:
        return ("The film is opaque, so the world hides the footage in renders; switch Transparent on in the render "
                "properties, under Film.")
    if scene.fit_flare.over == "plate" and not is_transparent:
        return ("The film is opaque, so renders over footage show no objects of the scene. To show them, switch "
                "Transparent on in the render properties, under Film, then set the compositor up.")
    if is_transparent and _lacks_objects(scene):
        how = ("bake, or import the footage again" if setup.shows_plate_alone(scene)
               else "press Set Up Compositor again")
        return f"Renders show the footage without the objects of the scene; {how}."
    for node in footage.footage_nodes(scene):
        with contextlib.suppress(FrameError):
            if footage.footage_behind_camera(scene)[0] != node.image:
                return ("Renders show the footage of another camera. To show that of the scene's camera, bake, or "
                        "press Set Up Compositor again.")
    return ""


def _lacks_objects(scene: Any) -> bool:
    """Return whether the compositor shows footage in place of the render, and a new set-up would show both."""
    tree = trees.tree_of(scene)
    if tree is None or footage.PLATE not in tree.nodes or setup.STATE_PROPERTY not in scene:
        return False
    if footage.is_artists_picture(tree.nodes.get(scene[setup.STATE_PROPERTY]["from"])):
        return False  # a set-up leaves the render to the artist's nodes
    ends = [node for node in tree.nodes if node.bl_idname == trees.OUTPUT_TYPE]
    return any(trees.depends_on(end, tree.nodes[footage.PLATE]) for end in ends) and not any(
        footage.shows_render(tree, end) for end in ends)


def stereo_warnings(scene: Any) -> Iterator[str]:
    """Yield a warning for each reason why views of a scene do not get their own flares."""
    views, shown = [view.name for view in stereo.rendered_views(scene.render)], layer_nodes.composited_views(scene)
    if not views and shown:
        yield ("This scene does not render stereo, and its compositor has the flare of one view; bake and composite "
               "again.")
    missing = [view for view in views if view not in shown]
    if missing and len(views) > 1 and flare_node.find_node(scene) is not None:
        yield (f"This scene renders stereo, and the compositor has no flare of its own for {' and '.join(missing)}; "
               "bake and composite again.")
    camera = scene.camera
    if views and camera is not None and camera.type == "CAMERA" and scene.render.views_format == "STEREO_3D" and \
            camera.data.stereo.use_spherical_stereo:
        yield _SPHERICAL


def _active_strips(scene: Any) -> Any:
    """Return the strips of the sequencer that a render shows."""
    editor = scene.sequence_editor
    if not scene.render.use_sequencer or editor is None:
        return ()
    strips = editor.strips if hasattr(editor, "strips") else editor.sequences  # until 4.3
    return [strip for strip in strips if strip.type != "SOUND" and not strip.mute]


def _loses_light(settings: Any) -> bool:
    """Return whether files of these settings have alpha, and cannot store light where it is 0, as an EXR can."""
    return settings.color_mode == "RGBA" and settings.file_format not in ("OPEN_EXR", "OPEN_EXR_MULTILAYER")
