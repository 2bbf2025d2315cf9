# SPDX-License-Identifier: GPL-3.0-or-later
"""The values of the add-on's preferences, the engine, the weights and the library, and the extension's user folder.

`preferences.py` declares and draws the preferences. They are read here so that `engine`, `weights` and `library` do not
depend on the panel of the preferences, which uses these modules itself.
"""
from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

PACKAGE = (__package__ or "").rpartition(".")[0]  # such as "bl_ext.user_default.fit_flare"


def user_folder(name: str, create: bool = False) -> Path:
    """Return a folder of the extension in Blender's user folder."""
    try:
        return Path(bpy.utils.extension_path_user(PACKAGE, path=name, create=create))
    except (ValueError, AttributeError):  # loaded from source, not installed as an extension
        folder = Path(bpy.utils.user_resource("CONFIG", path="fit_flare", create=create)) / name
        if create:
            folder.mkdir(parents=True, exist_ok=True)
        return folder


def addon_preferences() -> Any:
    """Return the preferences of the extension; None where it is not enabled (loaded from source)."""
    for name, addon in bpy.context.preferences.addons.items():
        if name.rpartition(".")[2] == "fit_flare" and addon.preferences is not None:
            return addon.preferences
    return None


def engine_path() -> str:
    """Return the engine that the preferences name; "" where they name none."""
    preferences = addon_preferences()
    return bpy.path.abspath(preferences.engine) if preferences is not None and preferences.engine else ""


def weights_path() -> str:
    """Return the weights that the preferences name; "" where they name none."""
    preferences = addon_preferences()
    return bpy.path.abspath(preferences.weights) if preferences is not None and preferences.weights else ""


def library_path() -> str:
    """Return the folder of the library that the preferences name; "" where they name none."""
    preferences = addon_preferences()
    return bpy.path.abspath(preferences.library) if preferences is not None and preferences.library else ""
