# SPDX-License-Identifier: GPL-3.0-or-later
"""A picture of a view's exact flare beside the flares of fits.

    python benchmarks/flares_side_by_side.py CAPTURE VIEW RUN ... --out PNG

First row: the frame and the exact flare. Then a row for each run: its flare, and twice its difference from the exact
one, on grey. The flare is |frame - scene|, display values, the paper's measure.
"""
from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.capture import Capture
from core.errors import CaptureError
from core.fit.frames import Frames
from core.fit.run import Run
from core.images.write import write_png
from core.metrics.evaluation import displayed_flare

Pixels = NDArray[np.float32]


def side_by_side(capture: Capture, name: str, runs: list[Run]) -> Pixels:
    """Return the picture, display values (h, w, 3), at the width of the first run. name: the view's, with any suffix.

    Raises CaptureError if the view or its layers are missing.
    """
    view = next((candidate for candidate in capture.views if Path(candidate.name).stem == Path(name).stem), None)
    if view is None:
        raise CaptureError(f"{capture.folder} has no view {name}; give a frame's name.")
    camera = Frames(capture, runs[0].settings.width).camera(view)
    scene, flare = capture.truth_scene(view, camera.size), capture.truth_flare(view, camera.size)
    if scene is None or flare is None:
        raise CaptureError(f"{capture.folder} has no exact layers (truth/); give a sample capture.")
    exact = displayed_flare(scene.linear() + flare.linear(), scene.linear())
    rows = [[capture.frame(view, camera.size).display(), exact]]
    for run in runs:
        layers = run.render(camera)
        rendered = displayed_flare(sum(layers.flare_by_light.values(), layers.scene), layers.scene)
        rows.append([rendered, 0.5 + 2 * (rendered - exact)])
    return np.clip(np.concatenate([np.concatenate(row, 1) for row in rows]), 0, 1)


def main() -> None:
    """Write the picture that the arguments describe."""
    parser = argparse.ArgumentParser(description="A view's exact flare beside the flares of fits.")
    parser.add_argument("capture", type=Path)
    parser.add_argument("view")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    write_png(args.out, side_by_side(Capture.open(args.capture), args.view, [Run.open(run) for run in args.runs]))


if __name__ == "__main__":
    main()
