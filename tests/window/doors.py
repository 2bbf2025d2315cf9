# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension from its repository in Blender's real window, the preferences without an engine, and the entries in
Blender's menus. A screenshot of each.

Started by tests/window/run.py --engine "" --script tests/window/doors.py. FIT_FLARE_REPOSITORY: the folder of a
repository that `headless/package.py --repository` wrote; without it, the zip is installed.
"""
from __future__ import annotations

import os
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driver as ui
import flow
from flow import done, shot, wait

REPOSITORY = os.environ.get("FIT_FLARE_REPOSITORY", "")


def steps():
    """Go through the ways into the extension: preferences, weights, menus, and a flare for a selected spot."""
    os.environ.pop("FIT_FLARE_WEIGHTS", None)  # as in a Blender that has nothing but the extension
    bpy.context.preferences.view.show_splash = False
    yield 1
    if REPOSITORY:
        yield from add_repository()
    else:
        bpy.ops.extensions.package_install_files(filepath=flow.ZIP, repo="user_default", enable_on_install=True,
                                                 overwrite=True)
    yield 1
    area = ui.area()
    yield from ui.show_editor(area, "PREFERENCES")
    yield from ui.go_to_section(area, "ADDONS")
    place = ui.region("WINDOW", area)
    yield from ui.fill(place.x + 0.2 * place.width, place.y + place.height - 19, "Fit Flare")
    yield from ui.press_button("preferences.addon_expand", place, across=24 / place.width)
    yield 0.5
    shot("20_preferences")
    if REPOSITORY:
        yield from ui.press_button("fit_flare.download_weights", place)
        weights = sys.modules[f"{package_name()}.flare_addon.weights"]
        yield from wait(lambda: weights.find_weights() is not None and not weights.download_job().running, 60)
        yield 0.5
        shot("21_weights")
    yield from ui.show_editor(area, "VIEW_3D")
    scene = bpy.context.scene
    lamp = next(item for item in scene.objects if item.type == "LIGHT")
    lamp.data.type = "SPOT"
    for item in scene.objects:
        item.select_set(item == lamp)
    bpy.context.view_layer.objects.active = lamp
    for number, menu in enumerate(("VIEW3D_MT_object_context_menu", "VIEW3D_MT_object", "TOPBAR_MT_file_import"), 22):
        with ui.override():
            bpy.ops.wm.call_menu(name=menu)
        yield 0.7
        shot(f"{number}_{menu}")
        ui.press("ESC")
        yield 0.5
    yield from ui.open_tab("Fit Flare")
    with ui.override():
        bpy.ops.fit_flare.add_library_flare()
    yield 1
    shot("25_spot_elsewhere")
    done("doors", lamp=lamp.name, follows=scene.fit_flare.lights[0].follow_direction)


def add_repository():
    """Add the repository by its address, and install the extension from it. Steps."""
    repositories = bpy.context.preferences.extensions.repos
    repositories.new(name="Fit Flare", module="ours", remote_url=(Path(REPOSITORY) / "index.json").as_uri())
    number = next(place for place, item in enumerate(repositories) if item.module == "ours")
    bpy.context.preferences.system.use_online_access = True
    with ui.override():
        bpy.ops.extensions.repo_sync("EXEC_DEFAULT", repo_index=number)
        yield 1
        bpy.ops.extensions.package_install("EXEC_DEFAULT", repo_index=number, pkg_id="fit_flare",
                                           enable_on_install=True)
    yield 2
    assert package_name() in bpy.context.preferences.addons


def package_name() -> str:
    return f"bl_ext.{'ours' if REPOSITORY else 'user_default'}.fit_flare"


if __name__ == "__main__":
    ui.FAILED = str(flow.out / "failed.png")
    ui.run(steps)
