# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole work in Blender's real window, from an empty profile, by mouse and keys: install, name the engine, import,
fit while orbiting, drag a slider, bake, compositor, render, transfer. A screenshot of each step, and facts.json.

Buttons are found as the mouse finds them: Ctrl-C over a button copies its operator (driver.py). Operators and
properties are called from here only to measure, or to make what an artist has before Fit Flare is used: another shot
with a camera and a lamp. Dropping a file on the window is left out: neither X nor Blender can simulate it.

Started by tests/window/run.py, which names in the environment: the zip (FIT_FLARE_ZIP), a capture that may be
written to (FIT_FLARE_CAPTURE), the engine's Python (FIT_FLARE_ENGINE), the folder to write (FIT_FLARE_OUT).
"""
from __future__ import annotations

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
from measure import NAME, Gaps, Ours, milliseconds, module

ZIP, CAPTURE, ENGINE, OUT = (os.environ[f"FIT_FLARE_{name}"] for name in ("ZIP", "CAPTURE", "ENGINE", "OUT"))
WIDTH = os.environ.get("FIT_FLARE_WIDTH", "240")  # of the fit; its quality is not the matter here
out = Path(OUT)
facts: dict[str, object] = {"blender": bpy.app.version_string, "done": []}


def shot(name: str) -> None:
    ui.screenshot(str(out / f"{name}.png"))


def done(step: str, **figures: object) -> None:
    facts["done"].append(step)
    facts.update(figures)
    (out / "facts.json").write_text(json.dumps(facts, indent=2))
    print("step:", step, figures, flush=True)


def wait(true, seconds: float):
    """Let Blender live until something is true. Steps; their value is how long it took."""
    began = time.perf_counter()
    while not true():
        assert time.perf_counter() - began < seconds, f"not within {seconds} s"
        yield 0.3
    return time.perf_counter() - began


def panel():
    return ui.region("UI")


def begin():
    """Go from the empty profile to a 3D viewport, with the extension installed and its engine named. Steps."""
    settings = bpy.context.preferences
    settings.view.show_splash = False
    settings.inputs.use_mouse_continuous = False
    settings.view.filebrowser_display_type = "SCREEN"  # the window that is driven is the only one
    settings.view.render_display_type = "AREA"
    yield 1
    area = ui.area()
    yield from ui.show_editor(area, "PREFERENCES")
    yield from install(area)
    yield from name_the_engine(area)
    yield from ui.show_editor(area, "VIEW_3D")


def steps():
    """Go the whole way of an artist: import, fit, overlay, bake, compositor, transfer."""
    yield from begin()
    yield from import_capture()
    yield from fit()
    yield from brighten()
    yield from bake()
    yield from compositor_and_render()
    yield from transfer()
    shot("last")
    done("all")


def install(area):
    """Install by Preferences > Get Extensions > the menu at the right > Install from Disk. Steps."""
    yield from ui.go_to_section(area, "EXTENSIONS")
    place = ui.region("WINDOW", area)
    top = place.y + place.height - 19
    yield from ui.press_along("wm.call_menu(name=\"USERPREF_MT_extensions_settings\"", place, top)
    shot("00_install")
    entry = yield from ui.find("extensions.package_install_files", place, across=1 - 16 / place.width, below=top - 4,
                               pages=1)
    ui.click(*entry)
    yield from ui.choose_file(*os.path.split(ZIP))
    yield from wait(lambda: NAME in bpy.context.preferences.addons, 30)
    done("install")


def name_the_engine(area):
    """In Preferences > Add-ons > Fit Flare type the engine's path into its field, and press Test. Steps."""
    yield from ui.go_to_section(area, "ADDONS")
    place = ui.region("WINDOW", area)
    yield from ui.fill(place.x + 0.2 * place.width, place.y + place.height - 19, "Fit Flare")
    # The first row of the list is the field's own result.
    yield from ui.press_button("preferences.addon_expand", place, across=24 / place.width)
    x, y = yield from ui.find(lambda text: text == "", place, across=0.6)
    yield from ui.fill(x, y, ENGINE)
    assert bpy.context.preferences.addons[NAME].preferences.engine == ENGINE
    yield from ui.press_button("fit_flare.test_engine", place, across=0.15, below=y)
    engine = module("engine")
    yield from wait(lambda: engine.last_test() is not None and not engine.last_test().running, 120)
    test = engine.last_test()
    assert test.state == "done", test.error
    yield 0.5
    shot("01_preferences")
    done("engine", engine=test.result)


def import_capture():
    """Delete the start file's objects, press Import Capture and choose the folder in the file browser. Steps."""
    view = ui.region("WINDOW")
    ui.point(view.x + 0.4 * view.width, view.y + 0.5 * view.height)
    ui.press("A")
    ui.press("DEL")
    yield 0.5
    assert not bpy.data.objects, "the start file's objects are still there"
    yield from ui.open_tab("Fit Flare")
    yield 0.5
    shot("02_empty")
    yield from ui.press_button("fit_flare.import_capture", panel())
    shot("02_file_browser")
    yield from ui.choose_file(CAPTURE + os.sep)
    import_s = yield from wait(lambda: bpy.context.scene.fit_flare.capture, 120)
    done("import", import_s=round(import_s, 3))
    yield 0.5
    shot("03_imported")


def fit():
    """Limit the width, press Fit, and turn the view while the engine works; print the gaps of the window. Steps."""
    scene = bpy.context.scene
    state, fits = scene.fit_flare, module("fits")
    x, y = yield from ui.find("fit_flare.limits_width", panel(), path=True, across=0.47)
    ui.click(x, y)
    yield 0.5
    assert state.limits_width
    x, y = yield from ui.find("fit_flare.width", panel(), path=True, across=0.75, below=y + 20)
    yield from ui.fill(x, y, WIDTH)
    assert state.width == int(WIDTH)
    view = ui.region("WINDOW")
    middle = view.x + view.width * 0.35, view.y + view.height * 0.5
    ui.drag(*middle, middle[0] + 10, middle[1], button="MIDDLEMOUSE")  # out of the camera's view
    ui.press("HOME")
    yield 0.5
    quiet = Gaps()
    yield 5
    before_the_fit = quiet.stop()
    began = time.perf_counter()
    ui.redraw()
    redraw_ms = milliseconds(time.perf_counter() - began)  # of Blender's whole window, before any fit
    ours = Ours()
    yield from ui.press_button("fit_flare.fit", panel(), below=y)
    job = fits.fit_job(scene)
    assert job is not None and job.running, f"the fit did not start: {fits.why_not_fit(scene)}"
    gaps = Gaps()
    seen: set[int] = set()
    before = ui.area().spaces.active.region_3d.view_rotation.copy()
    turned = shown = False
    began = time.perf_counter()
    while job.running and time.perf_counter() - began < 900:
        seen.add(job.done)
        if not turned and job.done > 20:
            ui.drag(*middle, middle[0] + 120, middle[1] + 30, button="MIDDLEMOUSE")
            turned = True
        if not shown and job.fraction_done > 0.4:
            gaps.pause()
            shot("04_fitting")
            shown = True
        yield 0.4
    assert job.state == "done", job.error
    orbit = before.rotation_difference(ui.area().spaces.active.region_3d.view_rotation).angle
    assert turned and orbit > 0.05, "the view did not turn during the fit"
    assert len(seen) > 5, "the bar did not move"
    done("fit", fit_s=round(time.perf_counter() - began, 1), bar_positions=len(seen), orbit_degrees=math.degrees(orbit),
         before_the_fit=before_the_fit, while_it_fits=gaps.stop(), redraw_alone_ms=redraw_ms, **ours.longest())
    assert state.flare, "the fit's flare is not shown"


def brighten():
    """Show the frames without flare in the camera's view and drag Intensity: the overlay brightens as much. Steps."""
    scene = bpy.context.scene
    state = scene.fit_flare
    x, y = yield from ui.find("fit_flare.footage", panel(), path=True, across=0.75)
    ui.click(x, y)
    yield 0.5
    assert state.footage == "removed"
    view = ui.region("WINDOW")
    ui.point(view.x + 0.35 * view.width, view.y + 0.5 * view.height)
    ui.press("NUMPAD_0")
    yield 1
    assert ui.area().spaces.active.region_3d.view_perspective == "CAMERA"
    shot("05_flare")
    overlay = module("overlay")
    dim = overlay.render_picture(scene, bpy.context.evaluated_depsgraph_get(), scene.camera, 480, 270)
    np.save(out / "overlay.npy", dim)
    x, y = yield from ui.find("fit_flare.master.intensity", panel(), path=True, across=0.6)
    ui.drag(x, y, x + 50, y)
    yield 0.5
    assert state.master.intensity > 1.1, f"Intensity is {state.master.intensity}"
    shot("06_brighter")
    bright = overlay.render_picture(scene, bpy.context.evaluated_depsgraph_get(), scene.camera, 480, 270)
    done("drag", intensity=round(state.master.intensity, 3), brightness=round(float(bright.sum() / dim.sum()), 3))
    np.testing.assert_allclose(bright.sum() / dim.sum(), state.master.intensity, rtol=0.01)
    yield from ui.fill(x, y, "1")
    done("speed", **speed_of(overlay, scene))


def bake():
    """Bake three frames into a folder that is typed, by the panel's fields and Bake Layers. Steps."""
    scene = bpy.context.scene
    state, now = scene.fit_flare, scene.frame_current
    x, y = yield from ui.find("fit_flare.bake_range", panel(), path=True, across=0.65)
    yield from ui.choose_item(x, y, lambda: state.bake_range == "custom")
    for name, text in (("bake_first", str(now)), ("bake_last", str(now + 2)), ("layers", str(out / "layers"))):
        x, y = yield from ui.find(f"fit_flare.{name}", panel(), path=True, across=0.55, below=y)
        yield from ui.fill(x, y, text)
    assert (state.bake_first, state.bake_last) == (now, now + 2)
    yield from ui.press_button("fit_flare.bake", panel(), below=y)
    job = module("jobs").find_job(Path(state.layers))
    assert job is not None, "the bake did not start"
    took = yield from wait(lambda: not job.running, 300)
    assert job.state == "done", job.error
    yield 0.5
    shot("06_look_and_bake")
    done("bake", bake_s=round(took, 1), layers=str(out / "layers"))


def compositor_and_render():
    """Set up the compositor over the footage, render at three intensities, and remove the nodes again. Steps."""
    scene = bpy.context.scene
    state = scene.fit_flare
    _, y = yield from ui.find("fit_flare.over", panel(), path=True, across=0.65)
    assert state.over == "plate", "an import chooses the footage"
    yield from ui.press_button("fit_flare.set_up_baked", panel(), below=y)
    flare_node = module("compositor.flare_node")
    assert flare_node.find_node(scene) is not None
    scene.render.engine = "BLENDER_WORKBENCH"  # the quickest; what it renders lies behind the plate
    figures = {}
    x, y = yield from ui.find("fit_flare.master.intensity", panel(), path=True, across=0.6)
    for factor in (0, 2, 1):
        yield from ui.fill(x, y, str(factor))
        assert state.master.intensity == factor
        figures[factor] = yield from render(out / f"render_{factor}.png")
    assert figures[0] < figures[1] < figures[2], figures
    done("render", render_means=figures)
    bpy.context.window.workspace = bpy.data.workspaces["Compositing"]  # only to look at the nodes
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
    yield from ui.press_button("fit_flare.remove_compositor", panel())
    assert flare_node.find_node(scene) is None


def render(path: Path):
    """Render by Render > Render Image, photograph the window, return to the view and save the picture. Steps.

    Their value is the picture's mean.
    """
    finished: list[bool] = []

    def note(*_words: object) -> None:
        finished.append(True)

    bpy.app.handlers.render_complete.append(note)
    yield from ui.press_in_top_bar("TOPBAR_MT_render")
    ui.press("HOME")  # Render Image
    ui.press("RET")
    yield from wait(lambda: finished, 120)
    bpy.app.handlers.render_complete.remove(note)
    yield 0.5
    shot("06_rendered")
    largest = max(ui.window().screen.areas, key=lambda area: area.width * area.height)
    ui.point(largest.x + 0.35 * largest.width, largest.y + 0.5 * largest.height)
    ui.press("ESC")
    yield 0.5
    assert any(area.type == "VIEW_3D" for area in ui.window().screen.areas)
    bpy.data.images["Render Result"].save_render(str(path))  # nobody else can read a render's pixels
    image = bpy.data.images.load(str(path))
    pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return float(pixels.reshape(-1, 4)[:, :3].mean())


def transfer():
    """Save the flare to the library and add it to another shot, first in sight, then with a wall before the lamp.
    Steps."""
    x, y = yield from ui.press_button("fit_flare.save_flare", panel())
    yield 1
    suggested = module("looks").path_of(bpy.context.scene).parent.name
    yield from ui.fill_above(x, y, suggested, "Desk lamp")
    shot("08_save")
    ui.press("RET")
    library, overlay = module("library"), module("overlay")
    yield from wait(library.user_files, 10)
    assert [path.stem for path in library.user_files()] == ["Desk lamp"]
    other, camera = another_shot()
    yield 0.5
    view = ui.region("WINDOW")
    if ui.area().spaces.active.region_3d.view_perspective != "CAMERA":
        ui.point(view.x + 0.35 * view.width, view.y + 0.5 * view.height)
        ui.press("NUMPAD_0")
    yield from ui.press_button("fit_flare.add_library_flare", panel())
    yield 1
    assert [item.target.name for item in other.fit_flare.lights if item.target] == ["Sun lamp"]
    shot("08_transferred")
    free = overlay.render_picture(other, bpy.context.evaluated_depsgraph_get(), camera, 480, 270)
    mesh = bpy.data.meshes.new("Wall")
    mesh.from_pydata([(-3, 3, -3), (0, 3, -3), (0, 3, 3), (-3, 3, 3)], [], [(0, 1, 2, 3)])
    wall = bpy.data.objects.new("Wall", mesh)
    other.collection.objects.link(wall)
    bpy.context.view_layer.update()
    hidden = overlay.render_picture(other, bpy.context.evaluated_depsgraph_get(), camera, 480, 270)
    done("transfer", transferred=float(free.sum()), behind_a_wall=float(hidden.sum()))
    assert free.sum() > 1
    assert hidden.sum() < 0.01 * free.sum()
    yield 0.5
    shot("09_hidden")


def another_shot():
    """Make and show another scene with a camera and a selected lamp; return scene and camera."""
    other = bpy.data.scenes.new("Another Shot")
    bpy.context.window.scene = other
    camera = bpy.data.objects.new("Second", bpy.data.cameras.new("Second"))
    camera.rotation_euler = (math.pi / 2, 0, 0)
    lamp = bpy.data.objects.new("Sun lamp", bpy.data.lights.new("Sun lamp", "POINT"))
    lamp.location = (-1.2, 6, 0.9)
    for item in (camera, lamp):
        other.collection.objects.link(item)
    other.camera = camera
    bpy.context.view_layer.update()
    lamp.select_set(True)
    return other, camera


def speed_of(overlay, scene) -> dict[str, float]:
    """Return milliseconds of the overlay of a frame at 1080p: of numpy's part, and of the drawing on the GPU."""
    looks, cameras = module("looks"), module("cameras")
    depsgraph = bpy.context.evaluated_depsgraph_get()
    camera = scene.camera.evaluated_get(depsgraph)
    core = cameras.core_camera(camera.data, camera.matrix_world, scene.render)
    window = overlay.drawn_region(overlay.CameraFrame(0, 0, 1920, 1080), (1920, 1080), core)
    look = looks.look_of(scene)
    numpy_ms, gpu_ms = [], []
    for _ in range(8):
        began = time.perf_counter()
        gaussians = overlay.concatenate(list(looks.evaluate_flares(scene, depsgraph, scene.camera).values()))
        overlay.quads_by_level(gaussians, window, look)
        middle = time.perf_counter()
        drawn = overlay.render_levels(gaussians, window, look)
        with list(drawn.offscreens.values())[-1].bind():  # reading back waits for the drawing
            wait_for_gpu()
        numpy_ms.append(middle - began)
        gpu_ms.append(time.perf_counter() - middle)
    return {"gaussians": len(gaussians), "numpy_ms": round(1e3 * min(numpy_ms), 1),
            "draw_ms": round(1e3 * min(gpu_ms), 1)}


def wait_for_gpu() -> None:
    """Reading a pixel of what is bound waits for all that was asked before."""
    import gpu

    gpu.state.active_framebuffer_get().read_color(0, 0, 1, 1, 4, 0, "FLOAT")


if __name__ == "__main__":
    ui.FAILED = str(out / "failed.png")
    ui.run(steps)
