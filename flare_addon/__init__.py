# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's side of Fit Flare. Each module registers its own classes; the last registered goes first."""
from __future__ import annotations

from . import operators, panels, preferences

_MODULES = (preferences, operators, panels)


def register() -> None:
    for module in _MODULES:
        module.register()


def unregister() -> None:
    for module in reversed(_MODULES):
        module.unregister()
