# SPDX-License-Identifier: GPL-3.0-or-later
"""The values of the add-on's preferences: the engine and the library.

`preferences.py` declares and draws them. They are read here so that `engine` and `library` do not depend on the panel
of the preferences, which uses `engine` itself.
"""
from __future__ import annotations

from typing import Any

import bpy


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


def library_path() -> str:
    """Return the folder of the library that the preferences name; "" where they name none."""
    preferences = addon_preferences()
    return bpy.path.abspath(preferences.library) if preferences is not None and preferences.library else ""
