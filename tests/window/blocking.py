# SPDX-License-Identifier: GPL-3.0-or-later
"""How long an import and a fit block the window's thread, measured with a timer in Blender's real window.

    python tests/window/run.py --out DIR --script tests/window/blocking.py --size 640x400 …

Started as flow.py is; FIT_FLARE_CAMERAS (400) says how many cameras the made capture has, beside 100,000 points. The
smaller the window, the less of what is measured is Blender's own drawing. Without an engine only the import is
measured. Writes blocking.json.
"""
from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parent))
import blender as benchmark_inputs
import driver as ui
from measure import NAME, Gaps, Ours, Times, milliseconds, module, noted

ZIP, ENGINE, OUT = (os.environ[f"FIT_FLARE_{name}"] for name in ("ZIP", "ENGINE", "OUT"))
CAMERAS = int(os.environ.get("FIT_FLARE_CAMERAS", "400"))
WATCHED_S = 30.0
out = Path(OUT)


def steps():
    """Measure how long the window is blocked: imports, no fit, a fit, and the flare taken in at its end."""
    settings = bpy.context.preferences
    settings.view.show_splash = False
    settings.inputs.use_mouse_continuous = False
    bpy.ops.extensions.package_install_files(filepath=ZIP, repo="user_default", enable_on_install=True, overwrite=True)
    settings.addons[NAME].preferences.engine = ENGINE
    for item in list(bpy.data.objects):
        bpy.data.objects.remove(item)
    yield 1
    yield from ui.open_tab("Fit Flare")
    capture = benchmark_inputs.make_capture(out / f"capture_{CAMERAS}", CAMERAS)
    scene = bpy.context.scene
    figures: dict[str, object] = {"blender": bpy.app.version_string, "cameras": CAMERAS}
    steps: Times = []
    for name in ("import_in_steps", "link_objects_in_steps"):
        time_steps(module("operators.capture"), name, steps)
    for layout in ("each", "animated"):
        for item in list(bpy.data.objects):
            bpy.data.objects.remove(item)
        scene.fit_flare.capture = ""
        yield 1
        gaps = Gaps()
        with ui.override():
            bpy.ops.fit_flare.import_capture("INVOKE_DEFAULT", directory=str(capture), cameras=layout)
        while sum(item.type == "CAMERA" for item in scene.objects) < (CAMERAS if layout == "each" else 1):
            yield 0.1
        yield 1
        figures[f"import, {layout}"] = {**gaps.stop(), "longest_step_at_work_ms": milliseconds(
            max(work for _, work in steps))}
        steps.clear()
    if not ENGINE:  # the import alone
        save(figures)
        return
    ours = Ours()
    with ui.override():
        bpy.ops.view3d.view_all()
        ui.area().spaces.active.region_3d.view_perspective = "PERSP"
    yield 3
    figures["no fit"] = yield from measured(lambda: True)
    scene.fit_flare.preset = "high"  # outlasts the watching
    with ui.override():
        assert bpy.ops.fit_flare.fit() == {"FINISHED"}
    job = module("fits").fit_job(scene)
    while job.running and job.done < 1:
        yield 0.5
    assert job.running, job.error
    first = job.done
    ours.forget()
    figures["fit"] = yield from measured(lambda: job.running)
    figures["events"] = job.done - first
    job.stop()
    while job.running:
        yield 0.5
    assert job.state == "stopped", (job.state, job.error)
    flare = benchmark_inputs.make_flare(out / "made.flare")
    gaps = Gaps()
    yield 1
    module("looks").show_look(scene, flare)  # what the end of a fit does
    yield 2
    figures["a flare taken in"] = gaps.stop()
    figures.update(ours.longest())
    save(figures)


def time_steps(target, name: str, record: Times) -> None:
    """Replace a function in steps of the module `target`, so that `record` gets the time of each of its steps."""
    inner = getattr(target, name)

    def in_steps(*words):
        """Run the steps and note the time of each."""
        walk = inner(*words)
        while True:
            with noted(record):
                try:
                    pause = next(walk)
                except StopIteration as end:
                    return end.value
            yield pause

    setattr(target, name, in_steps)


def save(figures: dict[str, object]) -> None:
    (out / "blocking.json").write_text(json.dumps(figures, indent=2))
    print(json.dumps(figures, indent=2), flush=True)
    ui.screenshot(str(out / "last.png"))


def measured(on):
    """Watch the window twice, left alone and with the view turned again and again. Steps; their value is the figures.

    on: whether to go on watching.
    """
    still, turning = Gaps(), None
    began = time.perf_counter()
    while on() and time.perf_counter() - began < WATCHED_S:
        yield 0.5
    found = {"still": still.stop()}
    view = ui.region("WINDOW")
    middle = view.x + view.width * 0.3, view.y + view.height * 0.5
    turning = Gaps()
    while on() and time.perf_counter() - began < 2 * WATCHED_S:
        ui.drag(*middle, middle[0] + 40, middle[1] + 10, button="MIDDLEMOUSE")
        yield 0.5
    found["turned"] = turning.stop()
    return found


ui.FAILED = str(out / "failed.png")
ui.run(steps)
