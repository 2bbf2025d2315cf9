# SPDX-License-Identifier: GPL-3.0-or-later
"""A fit rendered at other sizes than its own, by the grid of pixels it was learned on and without.

    python benchmarks/sizes.py CAPTURE ... [--preset draft] [--size 240]

Captures with exact layers (truth/), against which the views that were held out are scored at each size. The light of
the flare is a part of that which the fit shows at its own size.
"""
from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import report
from core.capture import Capture, View
from core.choices import OUR_PRESETS
from core.colour.srgb import srgb_from_linear
from core.errors import CaptureError
from core.fit import Run, fit, preset
from core.metrics.pictures import psnr

TIMES = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
COLUMNS = ("size", "", "scene, dB", "composite", "linear flare", "its light")


def scores(run: Run, capture: Capture, views: Sequence[View], width: int) -> tuple[float, float, float, float]:
    """PSNR of scene, composite and linear flare, and the flare's light, means over the views."""
    rows = []
    for view in views:
        camera = view.camera.scaled(width)
        layers = run.render(camera)
        exact = [layer.linear() for layer in (capture.truth_scene(view, camera.size),
                                              capture.truth_flare(view, camera.size)) if layer is not None]
        if len(exact) < 2:
            raise CaptureError(f"{capture.folder} has no exact layers of {view.name}.")
        scene, flare = exact
        found = np.sum([*layers.flare_by_light.values()], axis=0)
        shown = [srgb_from_linear(np.clip(one, 0, 1)) for one in (layers.scene, scene, layers.scene + found,
                                                                  scene + flare)]
        rows.append((psnr(shown[0], shown[1]), psnr(shown[2], shown[3]),
                     psnr(np.clip(found, 0, 1), np.clip(flare, 0, 1)), float(found.mean())))
    first, second, third, fourth = np.mean(np.array(rows, np.float64), 0).tolist()
    return first, second, third, fourth


def compared(run: Run, capture: Capture, own: int, most: int) -> list[list[str]]:
    """A row for each size and way."""
    _, views = capture.split(run.settings.holdout)
    scene, flare = run.scene, run.flare
    assert flare is not None
    grids = {"by its grid": (scene.sampling, flare.sampling), "without": (None, None)}
    light = scores(run, capture, views, own)[3]
    rows = []
    for width in sorted({min(round(times * own), most) for times in TIMES}):
        for name, (of_scene, of_flare) in grids.items():
            scene.sampling, flare.sampling = of_scene, of_flare
            *found, total = scores(run, capture, views, width)
            rows.append([f"{width}", name, *(f"{value:.2f}" for value in found), f"{total / light:.2f}"])
    return rows


def main() -> None:
    """Print a table for each capture."""
    parser = argparse.ArgumentParser(description="A fit at other sizes than its own.")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--preset", choices=OUR_PRESETS, default="draft")
    parser.add_argument("--size", type=int, default=240, help="width at which it is fitted")
    words = parser.parse_args()
    for folder in words.captures:
        capture = Capture.open(folder)
        most = max(view.camera.width for view in capture.views)
        with tempfile.TemporaryDirectory() as place:
            run = fit(capture, replace(preset(words.preset), width=words.size), Path(place) / "run")
            rows = compared(run, capture, words.size, most)
        print(f"{folder.name}, preset {words.preset}, fitted at {words.size} pixels\n")
        print(report.table(COLUMNS, rows))


if __name__ == "__main__":
    main()
