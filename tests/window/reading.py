# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a bake of a thousand frames holds Blender's window, without an engine: the reading of the scene, its start.

Started by tests/window/run.py --engine "" --script tests/window/reading.py --size 640x400.
"""
from __future__ import annotations

import sys
import time
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import driver as ui
import flow
from flow import done, wait
from measure import Gaps, milliseconds, module

FRAMES = 1000


def steps():
    """Bake a shot from the window and measure how long reading the scene, frame by frame, blocks it; stop the bake."""
    bpy.context.preferences.view.show_splash = False
    yield 1
    bpy.ops.extensions.package_install_files(filepath=flow.ZIP, repo="user_default", enable_on_install=True,
                                             overwrite=True)
    yield 1
    baking, jobs, shots = module("baking"), module("jobs"), module("shots")
    scene = bpy.context.scene
    scene.frame_end = FRAMES
    scene.render.resolution_percentage = 10
    library = {item[1]: item[0] for item in module("library").menu_items()}
    with ui.override():
        bpy.ops.fit_flare.add_library_flare(look=library["Clean Prime"], light="new")
    scene.camera.keyframe_insert("location", frame=1)
    scene.camera.location.x += 1
    scene.camera.keyframe_insert("location", frame=FRAMES)
    yield 1
    times: list[float] = []
    tick = baking._read_scene

    def timed():
        began = time.thread_time()
        result = tick()
        times.append(time.thread_time() - began)
        return result

    baking._read_scene = timed
    gaps = Gaps()
    began = time.perf_counter()
    with ui.override():
        bpy.ops.fit_flare.bake("EXEC_DEFAULT")
    yield from wait(lambda: baking.preparation() is None, 600)
    took = time.perf_counter() - began
    measured = gaps.stop()
    assert not baking.last_error(scene), baking.last_error(scene)
    job = jobs.find_job(shots.layers_folder(scene))
    assert job is not None, "the bake did not start"
    job.stop()
    yield from wait(lambda: not job.running, 60)
    assert scene.frame_current == 1
    done("reading", frames=FRAMES, steps=len(times), took_s=round(took, 1), longest_step_ms=milliseconds(max(times)),
         median_step_ms=milliseconds(float(np.median(times))), window=measured)


if __name__ == "__main__":
    ui.FAILED = str(flow.out / "failed.png")
    ui.run(steps)
