# SPDX-License-Identifier: GPL-3.0-or-later
"""The colour space of a capture's frames in the panel, and the options that pass it to the commands.

The field is `--plate-space` of `lights`, `fit` and `remove`, which keep it in the capture. A name of the scene's
OpenColorIO configuration goes with that configuration.
"""
from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

from ..core.capture.plate_space import AUTO, record_plate_space, recorded_name
from ..core.colour.spaces import is_plate_name, plate_names
from ..core.errors import FitFlareError
from .paths import absolute, is_file, is_folder


def search_names(_state: Any, _context: Any, text: str) -> list[str]:
    """Return the names that the field offers for a text: cameras, standards, and the scene's configuration."""
    names = dict.fromkeys([*plate_names(), *configured_names()])
    return [name for name in names if text.lower() in name.lower()]


def configured_names() -> list[str]:
    """Return the names of Blender's OpenColorIO configuration."""
    spaces = bpy.types.ColorManagedInputColorspaceSettings.bl_rna.properties["name"].enum_items
    return [item.identifier for item in spaces]


def configuration() -> Path | None:
    """Return the file of Blender's OpenColorIO configuration; None where it is not known."""
    if os.environ.get("OCIO"):
        return Path(os.environ["OCIO"])
    folder = bpy.utils.system_resource("DATAFILES", path="colormanagement")
    path = Path(folder) / "config.ocio" if folder else None
    return path if path is not None and is_file(path) else None


def command_args(scene: Any) -> list[object]:
    """Return the options of a command that reads the capture's frames: the name in the field, and the configuration
    that knows it unless Fit Flare does.

    [] where the field is empty, which leaves the colour space to the capture and the files.
    """
    name = scene.fit_flare.plate_space.strip()
    if not name:
        return []
    config = None if is_plate_name(name) else configuration()
    return ["--plate-space", name] if config is None else ["--plate-space", name, "--ocio", config]


def show_recorded(scene: Any, capture: Path) -> None:
    """Set the field to the space that a capture keeps."""
    scene.fit_flare.plate_space = recorded_name(capture)


def clear_recorded_space(state: Any, _context: Any) -> None:
    """Remove the colour space that a capture records if the artist has emptied the field `plate_space`.

    If it cannot be removed, the field shows it again. Blender calls this after each change of the field.
    """
    if state.plate_space.strip() or not state.capture:
        return
    capture = absolute(state.capture, state.id_data.library)
    if is_folder(capture) and recorded_name(capture):
        try:
            record_plate_space(capture, AUTO, None)
        except FitFlareError:
            state.plate_space = recorded_name(capture)
