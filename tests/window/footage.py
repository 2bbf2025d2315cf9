# SPDX-License-Identifier: GPL-3.0-or-later
"""Flare from Footage in Blender's real window, by mouse and keys: install, name the engine, press the button, choose a
clip in the file browser, and wait until its flare is shown. A screenshot of each step.

Started by tests/window/run.py --script tests/window/footage.py. FIT_FLARE_CLIP: the clip, in a folder that may be
written to.
"""
from __future__ import annotations

import os
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driver as ui
import flow
from flow import done, panel, shot, wait
from measure import module

CLIP = os.environ["FIT_FLARE_CLIP"]


def steps():
    """Install the extension with the engine, and take the flare from the clip."""
    yield from flow.begin()
    view = ui.region("WINDOW")
    ui.point(view.x + 0.4 * view.width, view.y + 0.5 * view.height)
    ui.press("A")
    ui.press("DEL")
    yield 0.5
    yield from ui.open_tab("Fit Flare")
    yield 0.5
    yield from ui.press_button("fit_flare.flare_from_footage", panel())
    shot("02_file_browser")
    yield from ui.choose_file(*os.path.split(CLIP))
    scene, fits = bpy.context.scene, module("fits")
    yield from wait(lambda: fits.fit_job(scene) is not None, 30)
    job = fits.fit_job(scene)
    yield from wait(lambda: job.done > 20 or not job.running, 600)
    shot("03_fitting")
    took = yield from wait(lambda: not job.running, 3600)
    assert job.state == "done", job.error
    yield 2
    shot("04_flare")
    assert scene.fit_flare.flare, "the fit's flare is not shown"
    done("all", shot_s=round(took, 1), lights=[item.name for item in scene.fit_flare.lights])


if __name__ == "__main__":
    ui.run(steps)
