# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors of lights that were moved by noise, before and after a fit snaps them to their flares.

    python benchmarks/snapping.py CAPTURE ... [--seeds 6]

Captures with clean frames, whose lights.json is exact. Distances are means over the views, of the frame's width.
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import report
from benchmarks.ablations import displace_lights
from core.capture import Capture
from core.fit.settings import preset
from core.fit.trainer import Trainer

SIGMAS = (0.0, 0.1, 0.25, 0.5, 1.0)
MAX_NEAR_ERROR = 0.012
"""Distance of a snapped light from the exact one that counts as near, relative to the frame's width."""


def light_errors(capture: Capture, positions: ArrayLike) -> NDArray[np.float64]:
    """Return (lights,): the mean distance, as views show it, of each light from its place in `positions` (lights, 3).

    Distances are relative to the frame's width. Views in which light or place is behind the camera are left out.
    """
    distances = []
    for view in capture.views:
        pixels, depth = view.camera.project([light.xyz for light in capture.lights])
        other_pixels, other_depth = view.camera.project(positions)
        distance = np.linalg.norm(pixels - other_pixels, axis=1) / view.camera.width
        distances.append(np.where((depth > 0) & (other_depth > 0), distance, np.nan))
    return np.asarray(np.nanmean(distances, 0))


def main() -> None:
    """Measure each capture at each sigma: rows go to stderr as they are measured, the table to stdout at the end."""
    parser = argparse.ArgumentParser(description="Errors of noisy lights before and after snapping.")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--seeds", type=int, default=6)
    args = parser.parse_args()
    rows = []
    for folder in args.captures:
        truth = Capture.open(folder)
        for sigma in SIGMAS:
            errors_before, errors_after = [], []
            for seed in range(args.seeds if sigma else 1):
                displaced = displace_lights(Capture.open(folder), sigma, seed)
                flare = Trainer(displaced, preset("standard")).flare
                assert flare is not None
                errors_before.append(light_errors(truth, [light.xyz for light in displaced.lights]))
                errors_after.append(light_errors(truth, flare.positions.numpy()))
            initial, snapped = np.concatenate(errors_before), np.concatenate(errors_after)
            rows.append([folder.name, f"{sigma:g}", f"{initial.max():.1%}", f"{np.median(snapped):.2%}",
                         f"{(snapped < MAX_NEAR_ERROR).sum()} of {len(snapped)}",
                         str((snapped > initial + 1e-3).sum())])
            print(*rows[-1], sep="\t", file=sys.stderr, flush=True)
    print(report.table(["capture", "sigma", "initial, worst", "snapped, median",
                        f"within {MAX_NEAR_ERROR:.1%}", "worse than initial"],
                       rows))


if __name__ == "__main__":
    main()
