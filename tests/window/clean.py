# SPDX-License-Identifier: GPL-3.0-or-later
"""Clean frames in Blender's real window: a matte into its field, Make Clean Frames, and again with another matte.

Started by tests/window/run.py --script tests/window/clean.py.
"""
from __future__ import annotations

import shutil
import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import driver as ui
import flow
from measure import module


def matte(name: str, white: slice) -> str:
    """Write a black picture that is white in some of its columns; return its path."""
    path = flow.out / name
    image = bpy.data.images.new(name, 96, 54)
    pixels = np.zeros((54, 96, 4), np.float32)
    pixels[..., 3] = 1
    pixels[:, white, :3] = 1
    image.pixels.foreach_set(pixels.ravel())
    image.filepath_raw, image.file_format = str(path), "PNG"
    image.save()
    bpy.data.images.remove(image)
    return str(path)


def clean(capture: Path, where: str):
    """Type the matte's path into its field, press the button and wait. Steps.

    Their value is the first and the last changed column of the first frame, as shares of its width; [] without change.
    """
    x, y = yield from ui.find("fit_flare.matte", flow.panel(), path=True, across=0.65)
    yield from ui.fill(x, y, where)
    yield from ui.press_button("fit_flare.clean_frames", flow.panel(), below=y)
    job = module("jobs").find_job(capture / "removal")
    assert job is not None and job.running, "the engine did not start"
    yield from flow.wait(lambda: not job.running, 600)
    assert job.state == "done", job.error
    yield 1
    first = min(path.name for path in (capture / "images").iterdir())
    frames = [bpy.data.images.load(str(capture / folder / first)) for folder in ("images", "removed")]
    before, after = (np.array(frame.pixels[:]).reshape(-1, frame.size[0], 4) for frame in frames)
    width = frames[0].size[0]
    for frame in frames:
        bpy.data.images.remove(frame)
    changed = np.flatnonzero(np.abs(before - after).max((0, 2)) > 0.05)
    return [float(changed.min() / width), float(changed.max() / width)] if len(changed) else []


def steps():
    """Clean a capture with a matte of its left half, then of its right half; check that only these are changed."""
    shutil.rmtree(Path(flow.CAPTURE) / "removed")
    yield from flow.begin()
    yield from flow.import_capture()
    scene, capture = bpy.context.scene, Path(bpy.context.scene.fit_flare.capture)
    scene.fit_flare.mode = "split"
    yield 0.5
    flow.shot("01_no_clean_frames")
    left = yield from clean(capture, matte("left.png", slice(0, 48)))
    assert scene.fit_flare.mode == "estimated", "the fit goes by the clean frames now"
    flow.shot("02_cleaned")
    right = yield from clean(capture, matte("right.png", slice(48, 96)))
    flow.shot("03_cleaned_again")
    assert left and left[1] < 0.55, left
    assert right and right[0] > 0.45, right
    flow.shot("last")
    flow.done("all", left=left, right=right)


if __name__ == "__main__":
    ui.FAILED = str(flow.out / "failed.png")
    ui.run(steps)
