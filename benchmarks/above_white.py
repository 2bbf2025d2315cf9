# SPDX-License-Identifier: GPL-3.0-or-later
"""A fit of float frames with the light that they hold above white, beside one that clips them there.

    python benchmarks/above_white.py CAPTURE ... [--preset draft] [--modes default split]

Captures with exact layers (truth/), whose sum becomes the frames. Errors are relative, of linear light: the root of the
squared error over that of the squared truth; all figures are means over the views that were held out.
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
from core.fit.metering import WHITEST
from core.images.picture import Picture
from core.metrics.pictures import relative_l2

COLUMNS = ("flare below white", "flare above", "its peak", "exact peak", "flare's light", "scene above white")


class FloatFrames(Capture):
    """A capture whose frames, with and without flare, are its exact layers."""

    def frame(self, view: View, size: tuple[int, int] | None = None) -> Picture:
        scene, flare = self.truth_scene(view, size), self.truth_flare(view, size)
        if scene is None or flare is None:
            raise CaptureError(f"{self.folder} has no exact layers of {view.name}.")
        return Picture(scene.linear() + flare.linear(), "linear")

    def removed(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        return self.truth_scene(view, size)


def scores(run: Run, capture: Capture) -> list[float]:
    """Of `COLUMNS`, over the views that were held out."""
    rows = []
    for view in capture.split(run.settings.holdout)[1]:
        layers = run.render(view.camera)
        found = np.sum([*layers.flare_by_light.values()], axis=0)
        scene, flare = capture.truth_scene(view), capture.truth_flare(view)
        assert scene is not None and flare is not None
        bright, lamps = (_above_white(one.linear()) for one in (flare, scene))
        rows.append([relative_l2(found, flare.linear(), ~bright), relative_l2(found, flare.linear(), bright),
                     found.max(), flare.linear().max(), found.sum() / flare.linear().sum(),
                     relative_l2(layers.scene, scene.linear(), lamps)])
    return np.nanmean(np.array(rows, np.float64), 0).tolist()


def _above_white(light: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.asarray((light > 1).any(-1))


def main() -> None:
    """Print a row for each capture and mode, with the light above white and without."""
    parser = argparse.ArgumentParser(description="Fits of float frames, with and without light above white.")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--preset", choices=OUR_PRESETS, default="draft")
    parser.add_argument("--modes", choices=("default", "split"), nargs="+", default=["default", "split"])
    words = parser.parse_args()
    rows = []
    for folder in words.captures:
        capture = FloatFrames.open(folder)
        for mode in words.modes:
            for name, white in (("clipped", 1.0), ("as they are", WHITEST)):
                with tempfile.TemporaryDirectory() as place:
                    settings = replace(preset(words.preset, mode=mode), white=white)
                    found = scores(fit(capture, settings, Path(place) / "run"), capture)
                rows.append([folder.name, mode, name, *(f"{value:.2f}" for value in found)])
                print(*rows[-1], sep="\t", file=sys.stderr, flush=True)
    print(report.table(["capture", "mode", "frames", *COLUMNS], rows))


if __name__ == "__main__":
    main()
