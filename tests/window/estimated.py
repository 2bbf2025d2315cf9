# SPDX-License-Identifier: GPL-3.0-or-later
"""A fit in Blender's real window of a capture without clean frames: it makes some first, and then its own can be made.

Started by tests/window/run.py --script tests/window/estimated.py.
"""
from __future__ import annotations

import shutil
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driver as ui
import flow
from measure import module


def steps():
    """Fit a capture without clean frames: the fit makes them first and then takes them as estimates."""
    capture = Path(flow.CAPTURE)
    for name in ("removed", "truth"):
        shutil.rmtree(capture / name)
    yield from flow.begin()
    yield from flow.import_capture()
    scene, fits = bpy.context.scene, module("fits")
    assert scene.fit_flare.mode == "estimated"
    scene.fit_flare.width = 240
    yield 0.5
    flow.shot("01_no_clean_frames")
    yield from ui.press_button("fit_flare.fit", flow.panel())
    job = fits.fit_job(scene)
    assert job is not None and job.running, f"the fit did not start: {fits.why_not_fit(scene)}"
    yield from flow.wait(lambda: (job.stage == "remove" and job.done > 2) or not job.running, 300)
    flow.shot("02_cleaning")
    yield from flow.wait(lambda: (job.stage == "fit" and job.done > 2) or not job.running, 900)
    assert (capture / "removed").is_dir(), "the fit has not made clean frames"
    flow.shot("03_fitting")
    yield from flow.wait(lambda: not job.running, 900)
    assert job.state == "done", job.error
    yield 1
    flow.shot("04_fitted")
    yield from ui.find("fit_flare.clean_frames", flow.panel())
    flow.shot("last")
    flow.done("all")


if __name__ == "__main__":
    ui.FAILED = str(flow.out / "failed.png")
    ui.run(steps)
