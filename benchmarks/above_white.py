# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits of float frames with their light above white, compared with fits of clipped frames.

    python benchmarks/above_white.py CAPTURE ... [--preset draft] [--modes default split]

The captures need exact layers (truth/), whose sum becomes the frames. Errors are relative L2 errors of linear light;
all figures are means over the held-out views.
"""
from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import report
from core.capture import Capture, View
from core.choices import OUR_PRESETS
from core.errors import CaptureError
from core.fit import Run, fit, preset
from core.fit.metering import MAX_WHITE
from core.images.picture import Picture
from core.metrics.pictures import relative_l2

COLUMNS = ("flare below white", "flare above", "its peak", "exact peak", "flare's light", "scene above white")


class FloatFrames(Capture):
    """A capture whose frames and clean frames are made of its exact layers."""

    def frame(self, view: View, size: tuple[int, int] | None = None) -> Picture:
        """Return the sum of the exact layers, linear. Raises CaptureError without them."""
        scene, flare = self.truth_scene(view, size), self.truth_flare(view, size)
        if scene is None or flare is None:
            raise CaptureError(f"{self.folder} has no exact layers of {view.name}.")
        return Picture(scene.linear() + flare.linear(), "linear")

    def clean_frame(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        return self.truth_scene(view, size)


def mean_scores(run: Run, capture: Capture) -> list[float]:
    """Return the scores of `COLUMNS`, averaged over the held-out views that have them."""
    rows = []
    for view in capture.split(run.settings.holdout)[1]:
        layers = run.render(view.camera)
        rendered_flare = np.sum([*layers.flare_by_light.values()], axis=0)
        scene, flare = capture.truth_scene(view), capture.truth_flare(view)
        assert scene is not None and flare is not None
        flare_bright, scene_bright = (_is_above_white(layer.linear()) for layer in (flare, scene))
        exact_flare = flare.linear()
        rows.append([relative_l2(rendered_flare, exact_flare, ~flare_bright),
                     relative_l2(rendered_flare, exact_flare, flare_bright),
                     rendered_flare.max(), exact_flare.max(), rendered_flare.sum() / exact_flare.sum(),
                     relative_l2(layers.scene, scene.linear(), scene_bright)])
    return np.nanmean(np.array(rows, np.float64), 0).tolist()


def _is_above_white(light: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.asarray((light > 1).any(-1))


def main() -> None:
    """Fit each capture in each mode, clipped and with its light above white, and print the table."""
    parser = argparse.ArgumentParser(description="Fits of float frames, with and without light above white.")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--preset", choices=OUR_PRESETS, default="draft")
    parser.add_argument("--modes", choices=("default", "split"), nargs="+", default=["default", "split"])
    args = parser.parse_args()
    rows = []
    for folder in args.captures:
        capture = FloatFrames.open(folder)
        for mode in args.modes:
            for name, white in (("clipped", 1.0), ("as they are", MAX_WHITE)):
                with tempfile.TemporaryDirectory() as folder_name:
                    settings = replace(preset(args.preset, mode=mode), white=white)
                    scores = mean_scores(fit(capture, settings, Path(folder_name) / "run"), capture)
                rows.append([folder.name, mode, name, *(f"{value:.2f}" for value in scores)])
                print(*rows[-1], sep="\t", file=sys.stderr, flush=True)
    print(report.table(["capture", "mode", "frames", *COLUMNS], rows))


if __name__ == "__main__":
    main()
