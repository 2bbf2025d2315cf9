# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole work in Blender's real window, from an empty profile: install, import, fit while orbiting, drag a
slider, bake, compositor, render, transfer. A screenshot of each step, and facts.json.

Started by tests/window/run.py, which names in the environment: the zip (FIT_FLARE_ZIP), a capture that may be
written to (FIT_FLARE_CAPTURE), the engine's Python (FIT_FLARE_ENGINE), the folder to write (FIT_FLARE_OUT).
"""
from __future__ import annotations

import importlib
import json
import math
import os
import sys
import time
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import driver as ui

ZIP, CAPTURE, ENGINE, OUT = (os.environ[f"FIT_FLARE_{name}"] for name in ("ZIP", "CAPTURE", "ENGINE", "OUT"))
NAME = "bl_ext.user_default.fit_flare"
out = Path(OUT)
facts: dict[str, object] = {"blender": bpy.app.version_string, "done": []}


def module(name: str):
    return importlib.import_module(f"{NAME}.flare_addon.{name}")


def shot(name: str) -> None:
    ui.screenshot(str(out / f"{name}.png"))


def done(step: str, **figures: object) -> None:
    facts["done"].append(step)
    facts.update(figures)
    (out / "facts.json").write_text(json.dumps(facts, indent=2))
    print("step:", step, figures, flush=True)


class Gaps:
    """The longest time between two calls of a 10 ms timer: what a mouse would have to wait."""

    def __init__(self) -> None:
        self.gaps: list[float] = []
        self.last = time.perf_counter()
        self.on, self.paused = True, False
        bpy.app.timers.register(self.tick, persistent=True)

    def tick(self):
        now = time.perf_counter()
        if not self.paused:
            self.gaps.append(now - self.last)
        self.last, self.paused = now, False
        return 0.01 if self.on else None

    def pause(self) -> None:
        """Leave out what comes now, a screenshot that this script itself takes."""
        self.paused = True

    def stop(self) -> dict[str, float]:
        self.on = False
        gaps = sorted(self.gaps[2:]) or [0.0]
        return {"longest_gap_ms": round(1e3 * gaps[-1]), "gap_99_percent_ms": round(1e3 * gaps[len(gaps) * 99 // 100])}


def timed(target, name: str, record: list[float]):
    """Measure each call of a function of the add-on."""
    inner = getattr(target, name)

    def call(*words, **named):
        began = time.perf_counter()
        try:
            return inner(*words, **named)
        finally:
            record.append(time.perf_counter() - began)
    setattr(target, name, call)


def timed_draw(panel, record: list[float]) -> None:
    """The same of a panel's drawing, with the signature that Blender asks for."""
    inner = panel.draw

    def draw(self, context):
        began = time.perf_counter()
        inner(self, context)
        record.append(time.perf_counter() - began)
    panel.draw = draw


def open_tab() -> None:
    space = ui.area().spaces.active
    space.show_region_ui = True
    ui.redraw()
    ui.region("UI").active_panel_category = "Fit Flare"
    ui.redraw()


def steps():
    bpy.context.preferences.view.show_splash = False
    bpy.context.preferences.inputs.use_mouse_continuous = False
    bpy.ops.extensions.package_install_files(filepath=ZIP, repo="user_default", enable_on_install=True, overwrite=True)
    yield 1
    assert NAME in bpy.context.preferences.addons, "the extension did not install"
    done("install")
    bpy.context.preferences.addons[NAME].preferences.engine = ENGINE
    chosen = ui.area()
    show_preferences(chosen)
    yield 1
    with bpy.context.temp_override(window=ui.window(), screen=ui.window().screen, area=chosen):
        bpy.ops.fit_flare.test_engine()
    test = module("engine").tested()
    while test.running:
        yield 0.3
    assert test.state == "done", test.error
    yield 0.5
    shot("01_preferences")
    done("engine", engine=test.result)
    chosen.type = "VIEW_3D"
    yield 0.5
    for item in list(bpy.data.objects):
        bpy.data.objects.remove(item)
    open_tab()
    yield 0.5
    shot("02_empty")
    began = time.perf_counter()
    with ui.override():
        assert bpy.ops.fit_flare.import_capture(directory=CAPTURE) == {"FINISHED"}
    scene = bpy.context.scene
    state = scene.fit_flare
    state.width = 240
    done("import", import_s=round(time.perf_counter() - began, 3))
    yield 0.5
    shot("03_imported")

    # Fit, by a click, while the view is turned.
    ui.area().spaces.active.region_3d.view_perspective = "PERSP"
    with ui.override():
        bpy.ops.view3d.view_all()
    ticks: list[float] = []
    timed(module("jobs").Job, "_read", ticks)
    draws: list[float] = []
    for name in ("capture", "lights", "fit", "look", "bake", "transfer"):
        timed_draw(getattr(module("panels"), f"FITFLARE_PT_{name}"), draws)
    began = time.perf_counter()
    ui.redraw()
    redraw_ms = round(1e3 * (time.perf_counter() - began))  # of Blender's whole window, before any fit
    taken: list[float] = []
    timed(module("looks"), "use", taken)
    panels, fits = module("panels"), module("fits")
    every = panels._CLASSES
    ui.only(panels.FITFLARE_PT_fit, panels.FITFLARE_PT_look)
    yield 0.5
    job = None
    for nudge in (0, 7, -7, 20, 27):
        ui.click(*ui.row(102 + nudge))
        yield 2
        job = fits.job_of(scene)
        if job is not None:
            break
    assert job is not None and job.running, f"the fit did not start: {fits.why_not(scene)}"
    ui.only(*every)
    gaps = Gaps()
    seen: set[int] = set()
    view = ui.region("WINDOW")
    middle = view.x + view.width * 0.35, view.y + view.height * 0.5
    before = ui.area().spaces.active.region_3d.view_rotation.copy()
    turned = shown = False
    began = time.perf_counter()
    while job.running and time.perf_counter() - began < 900:
        seen.add(job.done)
        if not turned and job.done > 20:
            ui.drag(*middle, middle[0] + 120, middle[1] + 30, button="MIDDLEMOUSE")
            turned = True
        if not shown and job.share > 0.4:
            gaps.pause()
            shot("04_fitting")
            shown = True
        yield 0.4
    assert job.state == "done", job.error
    orbit = before.rotation_difference(ui.area().spaces.active.region_3d.view_rotation).angle
    assert turned and orbit > 0.05, "the view did not turn during the fit"
    assert len(seen) > 5, "the bar did not move"
    done("fit", fit_s=round(time.perf_counter() - began, 1), bar_positions=len(seen), orbit_degrees=math.degrees(orbit),
         **gaps.stop(), longest_draw_ms=round(1e3 * max(draws), 2), redraw_alone_ms=redraw_ms,
         longest_read_ms=round(1e3 * max(ticks), 2),
         taken_in_ms=round(1e3 * max(taken), 2))
    assert state.flare, "the fit's flare is not shown"

    # Drag Intensity: the overlay brightens.
    state.footage = "removed"
    ui.area().spaces.active.region_3d.view_perspective = "CAMERA"
    yield 1
    shot("05_flare")
    overlay = module("overlay")
    depsgraph = bpy.context.evaluated_depsgraph_get()
    dim = overlay.picture(scene, depsgraph, scene.camera, 480, 270)
    np.save(out / "overlay.npy", dim)
    ui.only(panels.FITFLARE_PT_look)
    yield 0.5
    for nudge in (0, 7, -7, 20, 27):
        x, y = ui.row(30 + nudge)
        ui.drag(x, y, x + 50, y)
        yield 0.5
        if state.master.intensity != 1.0:
            break
    assert state.master.intensity > 1.1, f"Intensity is {state.master.intensity}"
    shot("06_brighter")
    bright = overlay.picture(scene, bpy.context.evaluated_depsgraph_get(), scene.camera, 480, 270)
    ui.only(*every)
    done("drag", intensity=round(state.master.intensity, 3), brightness=round(float(bright.sum() / dim.sum()), 3))
    np.testing.assert_allclose(bright.sum() / dim.sum(), state.master.intensity, rtol=0.01)

    # What the overlay costs.
    speeds = speed_of(overlay, scene)
    done("speed", **speeds)

    # Bake, and the overlay against it.
    state.master.intensity = 1.0
    state.layers, state.bake_range = str(out / "layers"), "custom"
    state.bake_first, state.bake_last = scene.frame_current, scene.frame_current + 2
    ui.area().spaces.active.region_3d.view_perspective = "CAMERA"
    with ui.override():
        assert bpy.ops.fit_flare.bake() == {"FINISHED"}
    job = module("jobs").find(Path(state.layers))
    began = time.perf_counter()
    while job.running and time.perf_counter() - began < 300:
        yield 0.3
    assert job.state == "done", job.error
    done("bake", bake_s=round(time.perf_counter() - began, 1), layers=str(out / "layers"))

    ui.only(panels.FITFLARE_PT_look, panels.FITFLARE_PT_bake)
    yield 0.5
    shot("06_look_and_bake")

    # The compositor, and a render through it.
    state.over = "plate"
    with ui.override():
        assert bpy.ops.fit_flare.set_up_baked() == {"FINISHED"}
    scene.render.engine = "BLENDER_WORKBENCH"
    figures = {}
    for factor in (0.0, 1.0, 2.0):
        state.master.intensity = factor
        scene.render.filepath = str(out / f"render_{factor:.0f}.png")
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(scene.render.filepath)
        pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
        image.pixels.foreach_get(pixels)
        figures[factor] = float(pixels.reshape(-1, 4)[:, :3].mean())
        bpy.data.images.remove(image)
    state.master.intensity = 1.0
    assert figures[0.0] < figures[1.0] < figures[2.0], figures
    done("render", render_means=figures)
    bpy.context.window.workspace = bpy.data.workspaces["Compositing"]
    yield 1
    try:
        with ui.override("NODE_EDITOR"):
            bpy.ops.node.view_all()
    except (ValueError, RuntimeError):
        pass
    yield 1
    shot("07_compositor")
    bpy.context.window.workspace = bpy.data.workspaces["Layout"]
    yield 1
    with ui.override():
        assert bpy.ops.fit_flare.remove_compositor() == {"FINISHED"}

    # Transfer: to the library, and on to another camera with a cube before one of the lights.
    with ui.override():
        assert bpy.ops.fit_flare.save_flare(name="Desk lamp", notes="From the sample") == {"FINISHED"}
    other = bpy.data.scenes.new("Another Shot")
    bpy.context.window.scene = other
    data = bpy.data.cameras.new("Second")
    camera = bpy.data.objects.new("Second", data)
    camera.rotation_euler = (math.pi / 2, 0, 0)
    lamp = bpy.data.objects.new("Sun lamp", bpy.data.lights.new("Sun lamp", "POINT"))
    lamp.location = (-1.2, 6, 0.9)
    for item in (camera, lamp):
        other.collection.objects.link(item)
    other.camera = camera
    bpy.context.view_layer.update()
    lamp.select_set(True)
    library = module("library")
    with ui.override():
        result = bpy.ops.fit_flare.apply_flare(filepath=str(library.files()[0]))
    assert result == {"FINISHED"}
    ui.area().spaces.active.region_3d.view_perspective = "CAMERA"
    ui.only(panels.FITFLARE_PT_look, panels.FITFLARE_PT_transfer)
    yield 1
    shot("08_transferred")
    free = overlay.picture(other, bpy.context.evaluated_depsgraph_get(), camera, 480, 270)
    mesh = bpy.data.meshes.new("Wall")
    mesh.from_pydata([(-3, 3, -3), (0, 3, -3), (0, 3, 3), (-3, 3, 3)], [], [(0, 1, 2, 3)])
    wall = bpy.data.objects.new("Wall", mesh)
    other.collection.objects.link(wall)
    bpy.context.view_layer.update()
    hidden = overlay.picture(other, bpy.context.evaluated_depsgraph_get(), camera, 480, 270)
    done("transfer", transferred=float(free.sum()), behind_a_wall=float(hidden.sum()))
    assert free.sum() > 1
    assert hidden.sum() < 0.01 * free.sum()
    yield 0.5
    shot("09_hidden")
    done("all")


def show_preferences(area) -> None:
    """The preferences of the extension in an area of the window."""
    import addon_utils

    area.type = "PREFERENCES"
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "Fit Flare"
    for other in addon_utils.modules(refresh=True):
        if other.__name__ == NAME:
            addon_utils.module_bl_info(other)["show_expanded"] = True


def speed_of(overlay, scene) -> dict[str, float]:
    """Milliseconds of a frame at 1080p: what numpy takes, and what the GPU (or what stands in for it) takes."""
    looks, cameras = module("looks"), module("cameras")
    depsgraph = bpy.context.evaluated_depsgraph_get()
    camera = scene.camera.evaluated_get(depsgraph)
    core = cameras.core_camera(camera.data, camera.matrix_world, scene.render)
    window = overlay.window_of(overlay.Frame(0, 0, 1920, 1080), (1920, 1080), core)
    look = looks.look_of(scene)
    numpy_ms, gpu_ms = [], []
    for _ in range(8):
        began = time.perf_counter()
        gaussians = overlay.joined(list(looks.seen(scene, depsgraph, scene.camera).values()))
        overlay.levels(gaussians, window, look.blend)
        middle = time.perf_counter()
        drawn = overlay.render(gaussians, window, look.blend)
        with drawn[-1].bind():  # reading back waits for the drawing
            wait_for_gpu()
        numpy_ms.append(middle - began)
        gpu_ms.append(time.perf_counter() - middle)
    return {"gaussians": len(gaussians), "numpy_ms": round(1e3 * min(numpy_ms), 1),
            "draw_ms": round(1e3 * min(gpu_ms), 1)}


def wait_for_gpu() -> None:
    """Reading a pixel of what is bound waits for all that was asked before."""
    import gpu

    gpu.state.active_framebuffer_get().read_color(0, 0, 1, 1, 4, 0, "FLOAT")


ui.FAILED = str(out / "failed.png")
ui.run(steps)
