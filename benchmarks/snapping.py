# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights moved by noise, and where a fit puts them before it begins.

    python benchmarks/snapping.py CAPTURE ... [--seeds 6]

Captures with flare-free frames, whose lights.json is exact. Distances are means over the views, of the frame's width.
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import report
from benchmarks.ablations import displaced
from core.capture import Capture
from core.fit.settings import preset
from core.fit.trainer import Trainer

SIGMAS = (0.0, 0.1, 0.25, 0.5, 1.0)
NEAR = 0.012


def off(capture: Capture, places: ArrayLike) -> NDArray[np.float64]:
    """(lights,) mean distance of these places (lights, 3) from the lights, over the views that have both in front."""
    distances = []
    for view in capture.views:
        pixels, depth = view.camera.project([light.xyz for light in capture.lights])
        others, behind = view.camera.project(places)
        away = np.linalg.norm(pixels - others, axis=1) / view.camera.width
        distances.append(np.where((depth > 0) & (behind > 0), away, np.nan))
    return np.asarray(np.nanmean(distances, 0))


def main() -> None:
    """Print a row for each capture and sigma."""
    parser = argparse.ArgumentParser(description="Lights moved by noise, and where a fit puts them.")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--seeds", type=int, default=6)
    words = parser.parse_args()
    rows = []
    for folder in words.captures:
        truth = Capture.open(folder)
        for sigma in SIGMAS:
            before, after = [], []
            for seed in range(words.seeds if sigma else 1):
                moved = displaced(Capture.open(folder), sigma, seed)
                flare = Trainer(moved, preset("standard")).flare
                assert flare is not None
                before.append(off(truth, [light.xyz for light in moved.lights]))
                after.append(off(truth, flare.positions.numpy()))
            given, found = np.concatenate(before), np.concatenate(after)
            rows.append([folder.name, f"{sigma:g}", f"{given.max():.1%}", f"{np.median(found):.2%}",
                         f"{(found < NEAR).sum()} of {len(found)}", str((found > given + 1e-3).sum())])
            print(*rows[-1], sep="\t", file=sys.stderr, flush=True)
    print(report.table(["capture", "sigma", "given, worst", "found, median", f"within {NEAR:.1%}", "worse than given"],
                       rows))


if __name__ == "__main__":
    main()
