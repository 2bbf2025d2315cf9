# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators of the buttons: they read properties, call the module that does the work, and report errors."""
from __future__ import annotations

from . import (
    add_flare,
    bake,
    capture,
    fit,
    library,
    light_paths,
    lights,
    make_flare,
    menus,
    pick_element,
    viewport_render,
)
from . import look as look_

_MODULES = (capture, lights, fit, look_, bake, library, add_flare, make_flare, light_paths,
            viewport_render, pick_element, menus)


def register() -> None:
    for module in _MODULES:
        module.register()


def unregister() -> None:
    for module in reversed(_MODULES):
        module.unregister()
