# SPDX-License-Identifier: GPL-3.0-or-later
"""A stranger's first minutes in Blender's real window, by mouse and keys, without an engine: install the zip, Add Flare
in the file that Blender starts with, another look, a slider, Bake Layers, render. A screenshot of each step.

Started by tests/window/run.py --engine "" --script tests/window/first_minutes.py.
"""
from __future__ import annotations

import shutil
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driver as ui
import flow
from flow import done, panel, shot, wait
from measure import module


def steps():
    """Install the extension without an engine, add a flare, change it, bake it and render."""
    settings = bpy.context.preferences
    settings.view.show_splash = False
    settings.inputs.use_mouse_continuous = False
    settings.view.filebrowser_display_type = "SCREEN"
    settings.view.render_display_type = "AREA"
    yield 1
    shot("00_start")
    area = ui.area()
    yield from ui.show_editor(area, "PREFERENCES")
    yield from flow.install(area)
    yield 0.5
    shot("01_installed")
    yield from ui.show_editor(area, "VIEW_3D")
    assert module("engine").find_engine() is None, "an engine is set up here"
    yield from add()
    yield from change()
    yield from bake()
    yield from render()
    shot("last")
    done("all")


def add():
    """Open the tab, press Add Flare, and see the flare in the camera view. Steps."""
    yield from ui.open_tab("Fit Flare")
    yield 1
    shot("02_library")
    scene = bpy.context.scene
    yield from ui.press_button("fit_flare.add_library_flare", panel())
    yield 1
    space = ui.area().spaces.active
    assert space.region_3d.view_perspective == "CAMERA"
    assert [item.target is not None for item in scene.fit_flare.lights] == [True]
    shot("03_added")
    done("added", look=Path(scene.fit_flare.flare).stem, lamp=scene.fit_flare.lights[0].target.name)


def change():
    """Choose another look from the previews, and drag the slider Intensity. Steps."""
    scene = bpy.context.scene
    view = ui.region("UI")
    ui.click(view.x + 0.45 * view.width, view.y + view.height - 110)
    yield 1
    shot("04_looks")
    ui.press("ESC")
    yield 0.5
    names = {item[1]: item[0] for item in module("library").menu_items()}
    bpy.context.window_manager.fit_flare_library = names["Vintage Ring"]
    yield from ui.press_button("fit_flare.apply_flare", panel(), across=0.3)
    yield 1
    assert Path(scene.fit_flare.flare).stem == "Vintage Ring"
    assert len(scene.fit_flare.lights) == 1
    shot("05_another_look")
    x, y = yield from ui.find("fit_flare.master.intensity", panel(), path=True, across=0.6)
    ui.drag(x, y, x + 40, y)
    yield 0.5
    assert scene.fit_flare.master.intensity > 1.05
    shot("06_brighter")
    done("changed", intensity=round(scene.fit_flare.master.intensity, 3))


def bake():
    """Bake the current frame into layers, without an engine. Steps."""
    scene = bpy.context.scene
    state = scene.fit_flare
    scene.render.resolution_percentage = 50  # the time of a test
    x, y = yield from ui.find("fit_flare.bake_range", panel(), path=True, across=0.65)
    yield from ui.choose_item(x, y, lambda: state.bake_range == "current")
    yield from ui.press_button("fit_flare.bake", panel(), below=y)
    jobs, shots = module("jobs"), module("shots")
    yield from wait(lambda: state.layers and jobs.find_job(shots.layers_folder(scene)) is not None, 20)
    job = jobs.find_job(shots.layers_folder(scene))
    yield 1
    shot("07_baking")
    took = yield from wait(lambda: not job.running, 300)
    assert job.state == "done", job.error
    yield from wait(lambda: module("compositor.flare_node").find_node(scene) is not None, 30)  # set up in steps
    yield 1
    shot("08_baked")
    done("baked", bake_s=round(took, 1), warnings=job.warnings)


def render():
    """Render by Render > Render Image, with the flare and at intensity 0, and check that the flare is in it. Steps."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 4, False  # some builds have no denoiser
    bright = yield from flow.render(flow.out / "first_render.png")
    shutil.copyfile(flow.out / "06_rendered.png", flow.out / "09_rendered.png")
    scene.fit_flare.master.intensity = 0.0
    dark = yield from flow.render(flow.out / "without_flare.png")
    assert bright > dark + 0.005, (bright, dark)
    done("rendered", with_flare=bright, without=dark)


if __name__ == "__main__":
    ui.FAILED = str(flow.out / "failed.png")
    ui.run(steps)
