# SPDX-License-Identifier: GPL-3.0-or-later
"""A fit rendered at other sizes than its own, with the low-pass filter of its pixel grid and without.

    python benchmarks/sizes.py CAPTURE ... [--preset draft] [--size 240]

The captures need exact layers (truth/), with which the held-out views are compared at each size. The light of the flare
is relative to that at the fit's own size.
"""
from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import report
from core.capture import Capture, View
from core.choices import OUR_PRESETS
from core.colour.srgb import srgb_from_linear
from core.errors import CaptureError
from core.fit import Run, fit, preset
from core.metrics.pictures import psnr

SCALES = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
COLUMNS = ("size", "", "scene, dB", "composite", "linear flare", "its light")


class SizeScores(NamedTuple):
    """PSNR of scene, composite and linear flare, dB, and the flare's mean linear light."""

    scene: float
    composite: float
    linear_flare: float
    flare_light: float


def mean_scores(run: Run, capture: Capture, views: Sequence[View], width: int) -> SizeScores:
    """Return scores averaged over the views.

    width: pixels of the rendered pictures. Raises CaptureError without exact layers.
    """
    rows = []
    for view in views:
        camera = view.camera.scaled(width)
        layers = run.render(camera)
        exact = [layer.linear() for layer in (capture.truth_scene(view, camera.size),
                                              capture.truth_flare(view, camera.size)) if layer is not None]
        if len(exact) < 2:
            raise CaptureError(f"{capture.folder} has no exact layers of {view.name}.")
        scene, flare = exact
        flare_sum = np.sum([*layers.flare_by_light.values()], axis=0)
        display = [srgb_from_linear(np.clip(picture, 0, 1))
                   for picture in (layers.scene, scene, layers.scene + flare_sum, scene + flare)]
        rows.append((psnr(display[0], display[1]), psnr(display[2], display[3]),
                     psnr(np.clip(flare_sum, 0, 1), np.clip(flare, 0, 1)), float(flare_sum.mean())))
    return SizeScores(*np.mean(np.array(rows, np.float64), 0).tolist())


def compare_sizes(run: Run, capture: Capture, fitted_width: int, max_width: int) -> list[list[str]]:
    """Return two rows for each size up to `max_width`: with the pixel grid of the fit, and without.

    Leaves the run without its pixel grids.
    """
    _, views = capture.split(run.settings.holdout)
    scene, flare = run.scene, run.flare
    assert flare is not None
    grids = {"by its grid": (scene.pixel_grid, flare.pixel_grid), "without": (None, None)}
    fitted_light = mean_scores(run, capture, views, fitted_width).flare_light
    rows = []
    for width in sorted({min(round(scale * fitted_width), max_width) for scale in SCALES}):
        for name, (scene_grid, flare_grid) in grids.items():
            scene.pixel_grid, flare.pixel_grid = scene_grid, flare_grid
            *psnrs, light = mean_scores(run, capture, views, width)
            rows.append([f"{width}", name, *(f"{value:.2f}" for value in psnrs), f"{light / fitted_light:.2f}"])
    return rows


def main() -> None:
    """Fit each capture, render it at other sizes, and print a table for it."""
    parser = argparse.ArgumentParser(description="A fit at other sizes than its own.")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--preset", choices=OUR_PRESETS, default="draft")
    parser.add_argument("--size", type=int, default=240, help="width at which it is fitted")
    args = parser.parse_args()
    for folder in args.captures:
        capture = Capture.open(folder)
        max_width = max(view.camera.width for view in capture.views)
        with tempfile.TemporaryDirectory() as folder_name:
            run = fit(capture, replace(preset(args.preset), width=args.size), Path(folder_name) / "run")
            rows = compare_sizes(run, capture, args.size, max_width)
        print(f"{folder.name}, preset {args.preset}, fitted at {args.size} pixels\n")
        print(report.table(COLUMNS, rows))


if __name__ == "__main__":
    main()
