# SPDX-License-Identifier: GPL-3.0-or-later
"""Fit Flare: takes lens flares out of footage, learns them, and gives them back as layers.

This folder is the Blender extension and the importable package at once, so nothing is imported here.
"""
from __future__ import annotations


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from . import flare_addon

    flare_addon.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
    from . import flare_addon

    flare_addon.unregister()
