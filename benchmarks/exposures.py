# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits of frames whose exposure changes, with a fixed and with a measured exposure.

    python benchmarks/exposures.py CAPTURE ... [--stops 0.7] [--preset draft] [--size 240]

The frames, clean frames and exact layers of captures of constant exposure are multiplied by a factor that varies by so
many stops along the shot, then rounded and clipped as in files. Held-out views are scored against them, and those of
the unchanged captures for comparison.
"""
from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import report
from core.capture import Capture, View
from core.choices import OUR_PRESETS
from core.colour.srgb import srgb_from_linear
from core.fit import Run, fit, preset
from core.images.picture import Picture
from core.metrics.evaluation import LAYERS, evaluate

COLUMNS = ("mode", "frames", "fitted as", *LAYERS, "error, stops")
PERIODS = 1.5
"""Periods of the exposure's variation along the shot."""


class DriftingCapture(Capture):
    """A capture whose light is multiplied by a factor for each view, `factors` by its name.

    Frames and clean frames are clipped at white and rounded to 8 bits; exact layers are not.
    """

    def __init__(self, capture: Capture, factors: Mapping[str, float]) -> None:
        self.__dict__.update(capture.__dict__)
        self.factors = factors

    def frame(self, view: View, size: tuple[int, int] | None = None) -> Picture:
        """Return the frame as a camera of that exposure films it."""
        return self._filmed_frame(super().frame(view, size), view)

    def clean_frame(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """Return the view's clean frame, filmed alike."""
        picture = super().clean_frame(view, size)
        return None if picture is None else self._filmed_frame(picture, view)

    def truth_scene(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """Return the view's exact scene layer."""
        return self._scaled_layer(super().truth_scene(view, size), view)

    def truth_flare(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """Return the view's exact flare layer."""
        return self._scaled_layer(super().truth_flare(view, size), view)

    def _filmed_frame(self, picture: Picture, view: View) -> Picture:
        light = picture.linear() * np.float32(self.factors[view.name])
        return Picture(np.round(srgb_from_linear(light).clip(0, 1) * 255) / np.float32(255), "srgb")

    def _scaled_layer(self, picture: Picture | None, view: View) -> Picture | None:
        if picture is None:
            return None
        return replace(picture, pixels=picture.pixels * np.float32(self.factors[view.name]))


def layer_scores(run: Run, capture: Capture) -> list[str]:
    """Return the PSNR of each of LAYERS, dB, as text: means over the held-out views, "-" for a layer without scores."""
    _, views = capture.with_exposures(run.exposures).split(run.settings.holdout)
    cameras = {view: view.camera.scaled(run.settings.width) for view in views}
    results: dict[str, Any] = evaluate(run, capture, cameras)
    return [f"{results[layer]['psnr']:.2f}" if layer in results else "-" for layer in LAYERS]


def compare_exposures(capture: Capture, mode: str, args: argparse.Namespace) -> list[list[str]]:
    """Fit, and return a row for the unchanged capture, and two for the drifting one: exposure fixed and measured."""
    count = len(capture.views)
    stops = {view.name: args.stops * math.sin(2 * math.pi * PERIODS * number / count)
             for number, view in enumerate(capture.views)}
    drifting = DriftingCapture(capture, {name: 2**stop for name, stop in stops.items()})
    rows = []
    for name, frames, exposure in (("as they are", capture, "measured"), ("drifting", drifting, "fixed"),
                                   ("drifting", drifting, "measured")):
        settings = replace(preset(args.preset, mode=mode), width=args.size, exposure=exposure)  # type: ignore[arg-type]
        with tempfile.TemporaryDirectory() as folder:
            run = fit(frames, settings, Path(folder) / "run")
            error = _exposure_error(run.exposures, stops if frames is drifting else {})
            rows.append([mode, name, exposure, *layer_scores(run, frames), error])
    return rows


def _exposure_error(estimated: Mapping[str, float], stops: Mapping[str, float]) -> str:
    """Return the standard deviation of estimated exposures from the true ones, stops, as text.

    estimated: factors by view. stops: true exposures by view; {} for a constant one.
    """
    if not estimated:
        return "none"
    return f"{np.std([math.log2(value) - stops.get(name, 0.0) for name, value in estimated.items()]):.3f}"


def main() -> None:
    """Fit each capture with changing exposure, and print a table for it."""
    parser = argparse.ArgumentParser(description="Frames whose exposure changes.")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--stops", type=float, default=0.7, help="to either side")
    parser.add_argument("--preset", choices=OUR_PRESETS, default="draft")
    parser.add_argument("--size", type=int, default=240, help="width at which it is fitted")
    args = parser.parse_args()
    for folder in args.captures:
        capture = Capture.open(folder)
        modes = ["split", *(["default"] if capture.has_clean_frames or capture.has_truth else [])]
        rows = [row for mode in modes for row in compare_exposures(capture, mode, args)]
        print(f"{folder.name}, {args.stops:g} stops to either side, preset {args.preset}, {args.size} pixels\n")
        print(report.table(COLUMNS, rows))


if __name__ == "__main__":
    main()
