# SPDX-License-Identifier: GPL-3.0-or-later
"""The values of the add-on's preferences, the engine, the weights and the library, and the extension's user folder.

`preferences.py` declares and draws the preferences. They are read here so that `engine`, `weights` and `library` do not
depend on the panel of the preferences, which uses these modules itself.
"""
from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import EngineError

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
    return _stored_path("engine")


def library_path() -> str:
    """Return the folder of the library that the preferences name; "" where they name none."""
    return _stored_path("library")


def configured_path(variable: str, preference: str) -> tuple[str, str]:
    """Return the source and the path of what users configure: the environment variable, else the preference of that
    name, else ("", "")."""
    for source, path in ((variable, os.environ.get(variable, "")), ("the preferences", _stored_path(preference))):
        if path:
            return source, path
    return "", ""


def _stored_path(preference: str) -> str:
    """Return the absolute path in a preference; "" where it is empty."""
    preferences = addon_preferences()
    path = "" if preferences is None else getattr(preferences, preference)
    return bpy.path.abspath(path) if path else ""


def check_online_access(action: str) -> None:
    """Raise EngineError where Blender's online access is off. action: what to do once it is on, such as "download"."""
    if not bpy.app.online_access:
        raise EngineError(f"Blender's online access is off; allow it in Preferences > System > Network, then {action}.")
