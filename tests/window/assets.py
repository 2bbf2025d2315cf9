# SPDX-License-Identifier: GPL-3.0-or-later
"""A look dragged from the Asset Browser into the 3D viewport of Blender's real window.

Started by tests/window/run.py --engine "" --script tests/window/assets.py. Needs Blender 4.3.
"""
from __future__ import annotations

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driver as ui
import flow
from flow import done, shot, wait
from measure import NAME, module


def steps():
    """Show the looks in the asset browser, drag one into the view, and check that a lamp with its flare is there."""
    settings = bpy.context.preferences
    settings.view.show_splash = False
    yield 1
    bpy.ops.extensions.package_install_files(filepath=flow.ZIP, repo="user_default", enable_on_install=True,
                                             overwrite=True)
    assert NAME in settings.addons
    bpy.ops.fit_flare.list_assets()
    browser = ui.area("PROPERTIES")
    browser.ui_type = "ASSETS"
    yield 1
    browser.spaces.active.show_region_toolbar = False
    browser.spaces.active.params.asset_library_reference = module("asset_browser").NAME
    yield 15
    shot("01_asset_browser")
    scene = bpy.context.scene
    view, looks = ui.region("WINDOW"), ui.region("WINDOW", browser)
    ui.press("NUMPAD_0")
    for row in range(6):  # the first look is somewhere below the upper left corner
        ui.drag(looks.x + 60, looks.y + looks.height - 60 - 30 * row, view.x + 0.35 * view.width,
                view.y + 0.6 * view.height)
        yield 3
        if scene.fit_flare.lights:
            break
    yield from wait(lambda: scene.fit_flare.lights, 20)
    (item,) = scene.fit_flare.lights
    assert item.target is not None and item.target.name == Path(scene.fit_flare.flare).stem
    with ui.override():
        ui.area().spaces.active.region_3d.view_perspective = "CAMERA"
    yield 2
    shot("02_dropped")
    shot("last")
    done("all", look=Path(scene.fit_flare.flare).stem, place=list(item.target.location))


if __name__ == "__main__":
    ui.FAILED = str(flow.out / "failed.png")
    ui.run(steps)
