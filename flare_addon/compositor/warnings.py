# SPDX-License-Identifier: GPL-3.0-or-later
"""What of a composite that is set up will not be as somebody may expect, each in one sentence."""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ...core.bake.folder import LayerFolder
from ...core.conventions.frame_numbers import Frame, absent
from ...core.images.picture import are_one_shape
from . import drivers, flare_node, setup


def warnings(scene: Any, layers: LayerFolder, live: bool) -> Iterator[str]:
    """Sentences on a scene whose compositor shows `layers`; `live`: the panel's sliders act on it."""
    render = scene.render
    if not render.use_compositing:
        yield ("Compositing is switched off for this scene, so that renders are without the flare; switch it on in the "
               "output properties, under Post Processing.")
    if strips := _strips(scene):
        yield (f"Renders show the video sequencer, which has {strips[0].name!r}, in place of the compositor, without "
               "the flare; switch Sequencer off in the output properties, under Post Processing.")
    if render.film_transparent and setup.over_render(scene) and _loses_light(render.image_settings):
        yield (f"The film is transparent, and {render.image_settings.file_format} files have no light where nothing is "
               "but the flare; render to OpenEXR, or without alpha (RGB).")
    width, height = layers.size()
    if not are_one_shape((width, height), (render.resolution_x, render.resolution_y)):
        yield (f"The layers have {width} x {height} pixels and the scene renders {render.resolution_x} x "
               f"{render.resolution_y}, another shape, into which they are stretched; bake them again.")
    there = [Frame("", number, "") for number in layers.files]
    if bare := absent(there, f"{max(scene.frame_start, 0)}-{max(scene.frame_end, scene.frame_start, 0)}"):
        they = "Blender shows in magenta before 4.4" if flare_node.MISSING_IS_MAGENTA else "are without flare"
        yield (f"The scene has the frames {scene.frame_start}-{scene.frame_end}, and there are no layers of {bare}, "
               f"which {they}; bake them too.")
    if live and drivers.is_animated(scene):
        yield ("Sliders that act on it are animated: they stand still where this extension is not, on a farm say; bake "
               "without Keep Colours Live for that.")
    if misread := setup.misread(scene):
        yield misread


def _strips(scene: Any) -> Any:
    """What a render takes from the sequencer, if it does."""
    editor = scene.sequence_editor
    if not scene.render.use_sequencer or editor is None:
        return ()
    strips = editor.strips if hasattr(editor, "strips") else editor.sequences  # until 4.3
    return [strip for strip in strips if strip.type != "SOUND" and not strip.mute]


def _loses_light(settings: Any) -> bool:
    """Whether files have alpha, and no light where it is 0."""
    return settings.color_mode == "RGBA" and settings.file_format not in ("OPEN_EXR", "OPEN_EXR_MULTILAYER")
