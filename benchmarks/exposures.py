# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames whose exposure changes, fitted as if it did not and as it is found.

    python benchmarks/exposures.py CAPTURE ... [--stops 0.7] [--preset draft] [--size 240]

The frames of captures of one exposure, and their flare-free frames and exact layers, are brought to a light that goes
up and down by so many stops along the shot, and rounded and clipped as files are. Held-out views are scored against
them, beside those of the captures as they are.
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

COLUMNS = ("mode", "frames", "fitted as", *LAYERS, "found, stops off")
ROUNDS = 1.5
"""Times that the light goes up and down."""


class Drifting(Capture):
    """A capture, each view times some light; clipped at white, in 8 bits."""

    def __init__(self, capture: Capture, times: Mapping[str, float]) -> None:
        self.__dict__.update(capture.__dict__)
        self.times = times

    def frame(self, view: View, size: tuple[int, int] | None = None) -> Picture:
        """As filmed."""
        return self._filmed(super().frame(view, size), view)

    def removed(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """Without flare."""
        picture = super().removed(view, size)
        return None if picture is None else self._filmed(picture, view)

    def truth_scene(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """The exact layer."""
        return self._lit(super().truth_scene(view, size), view)

    def truth_flare(self, view: View, size: tuple[int, int] | None = None) -> Picture | None:
        """The exact layer."""
        return self._lit(super().truth_flare(view, size), view)

    def _filmed(self, picture: Picture, view: View) -> Picture:
        light = picture.linear() * np.float32(self.times[view.name])
        return Picture(np.round(srgb_from_linear(light).clip(0, 1) * 255) / np.float32(255), "srgb")

    def _lit(self, picture: Picture | None, view: View) -> Picture | None:
        return None if picture is None else replace(picture, pixels=picture.pixels * np.float32(self.times[view.name]))


def scores(run: Run, capture: Capture) -> list[str]:
    """PSNR of each layer, dB, means over the views that were held out."""
    _, views = capture.with_exposures(run.exposures).split(run.settings.holdout)
    cameras = {view: view.camera.scaled(run.settings.width) for view in views}
    found: dict[str, Any] = evaluate(run, capture, cameras)
    return [f"{found[layer]['psnr']:.2f}" if layer in found else "-" for layer in LAYERS]


def compared(capture: Capture, mode: str, words: argparse.Namespace) -> list[list[str]]:
    """A row for the capture as it is, and for each way to fit it drifting."""
    count = len(capture.views)
    stops = {view.name: words.stops * math.sin(2 * math.pi * ROUNDS * number / count)
             for number, view in enumerate(capture.views)}
    drifting = Drifting(capture, {name: 2**one for name, one in stops.items()})
    rows = []
    for name, one, way in (("as they are", capture, "found"), ("drifting", drifting, "fixed"),
                           ("drifting", drifting, "found")):
        settings = replace(preset(words.preset, mode=mode), width=words.size, exposure=way)  # type: ignore[arg-type]
        with tempfile.TemporaryDirectory() as place:
            run = fit(one, settings, Path(place) / "run")
            rows.append([mode, name, way, *scores(run, one), _off(run.exposures, stops if one is drifting else {})])
    return rows


def _off(found: Mapping[str, float], stops: Mapping[str, float]) -> str:
    """Standard deviation from the true ones."""
    if not found:
        return "nothing found"
    return f"{np.std([math.log2(one) - stops.get(name, 0.0) for name, one in found.items()]):.3f}"


def main() -> None:
    """Print a table for each capture."""
    parser = argparse.ArgumentParser(description="Frames whose exposure changes.")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--stops", type=float, default=0.7, help="to either side")
    parser.add_argument("--preset", choices=OUR_PRESETS, default="draft")
    parser.add_argument("--size", type=int, default=240, help="width at which it is fitted")
    words = parser.parse_args()
    for folder in words.captures:
        capture = Capture.open(folder)
        modes = ["split", *(["default"] if capture.has_removed or capture.has_truth else [])]
        rows = [row for mode in modes for row in compared(capture, mode, words)]
        print(f"{folder.name}, {words.stops:g} stops to either side, preset {words.preset}, {words.size} pixels\n")
        print(report.table(COLUMNS, rows))


if __name__ == "__main__":
    main()
