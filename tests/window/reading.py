# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a bake of a thousand frames holds Blender's window: the reading of the scene, the bake, the set-up of the
compositor, and the same once more over the layers that are there.

Started by tests/window/run.py --script tests/window/reading.py --size 640x400, with --engine "" for a bake by Blender's
own Python. FIT_FLARE_FRAMES (1000) says how many frames. Fails where the window's thread works for more than LIMIT_MS
between two calls of a timer. Writes facts.json.
"""
from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import driver as ui
import flow
from flow import done, wait
from measure import NAME, Gaps, Times, milliseconds, module, timed

FRAMES = int(os.environ.get("FIT_FLARE_FRAMES", "1000"))
LIMIT_MS = 50.0


def steps():
    """Bake a shot from the window and measure how long reading, bake and set-up of the compositor block it."""
    bpy.context.preferences.view.show_splash = False
    yield 1
    bpy.ops.extensions.package_install_files(filepath=flow.ZIP, repo="user_default", enable_on_install=True,
                                             overwrite=True)
    bpy.context.preferences.addons[NAME].preferences.engine = flow.ENGINE
    yield 1
    scene = bpy.context.scene
    scene.frame_end = FRAMES
    scene.render.resolution_percentage = 5
    library = {item[1]: item[0] for item in module("library").menu_items()}
    with ui.override():
        bpy.ops.fit_flare.add_library_flare(look=library["Clean Prime"], light="new")
    scene.camera.keyframe_insert("location", frame=1)
    scene.camera.location.x += 1
    scene.camera.keyframe_insert("location", frame=FRAMES)
    yield from ui.open_tab("Fit Flare")
    yield 1
    record = {"read": [], "follow": []}
    timed(module("baking"), "_read_scene", record["read"])
    timed(module("baking"), "_run_steps", record["follow"])
    for name in ("bake", "bake again"):
        yield from bake(scene, name, record)
    longest = {name: facts["longest_work_ms"] for name, facts in measured.items()}
    assert max(longest.values()) <= LIMIT_MS, f"the window's thread worked for {longest} ms in one go"


measured: dict[str, dict[str, float]] = {}
"""Figures of `Gaps` by what was measured."""


def bake(scene, name: str, record: dict[str, Times]):
    """Bake the scene from the window, set the compositor up by it, and measure both. Steps.

    record: the times of the calls of the add-on's timers.
    """
    baking, jobs, shots = module("baking"), module("jobs"), module("shots")
    for times in record.values():
        times.clear()
    gaps, began = Gaps(), time.perf_counter()
    with ui.override():
        bpy.ops.fit_flare.bake("INVOKE_DEFAULT", composite=True)
    yield from wait(lambda: baking.preparation() is None, 600)
    read_s = time.perf_counter() - began
    measured[f"{name}: reading"] = gaps.stop()
    assert not baking.last_error(scene), baking.last_error(scene)
    assert scene.frame_current == 1
    job = jobs.find_job(shots.layers_folder(scene))
    assert job is not None, "the bake did not start"
    gaps = Gaps()
    yield from wait(lambda: job.done > 0.95 * FRAMES or not job.running, 3000)
    measured[f"{name}: drawing"] = gaps.stop()
    gaps = Gaps()
    yield from wait(lambda: not job.running and is_set_up(scene), 600)
    yield 2
    measured[f"{name}: set-up"] = gaps.stop()
    assert job.state == "done" and not job.warnings, (job.state, job.error, job.warnings)
    done(name, frames=FRAMES, engine=bool(flow.ENGINE), read_s=round(read_s, 1),
         longest_call_ms={kind: milliseconds(max(work for _, work in times)) for kind, times in record.items()},
         median_call_ms={kind: milliseconds(float(np.median([work for _, work in times])))
                         for kind, times in record.items()}, window=measured)


def is_set_up(scene) -> bool:
    """Return whether the compositor shows layers."""
    return module("compositor.flare_node").find_node(scene) is not None


if __name__ == "__main__":
    ui.FAILED = str(flow.out / "failed.png")
    ui.run(steps)
