# SPDX-License-Identifier: GPL-3.0-or-later
"""Error of `make-flare` by lens: `python benchmarks/make_flare.py LENS ... [--sheets FOLDER]`.

Each lens is traced and fitted as `make-flare` does, then compared with its tracing along a path of the light that the
fit did not see. Prints a table: relative L2 in linear light, mean and largest over the path. A sheet has the traced
flare, the fitted one, and 0.5 + their difference for some places of the path.
"""
from __future__ import annotations

import argparse
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.colour.srgb import srgb_from_linear
from core.errors import FitFlareError
from core.fit.traced_flare import (
    TracedPictures,
    draw_fitted,
    fit_traced,
    path_places,
    relative_errors,
    setup_with_ghost_gain,
    spread_places,
    trace,
    traced_camera,
)
from core.fit.traced_settings import TracedFlareSettings
from core.flare.model import FlareModel
from core.images.contact_sheet import side_by_side
from core.images.write import write_png
from core.optics.lenses import find_lens
from core.system.progress import TerminalProgress

SHEET_ROWS = 4


def parse_setting(text: str) -> tuple[str, Any]:
    """Parse NAME=VALUE, the value as TOML."""
    name, _, value = text.partition("=")
    return name, tomllib.loads(f"value = {value}")["value"]


def write_sheet(file: Path, settings: TracedFlareSettings, model: FlareModel, path: TracedPictures) -> None:
    """Write traced flare, fitted flare and 0.5 + their difference side by side, a row for each of SHEET_ROWS places.

    path: the tracing along the path; its places are spread evenly, without the ends.
    """
    indices = np.linspace(1, len(path.places) - 2, SHEET_ROWS).round().astype(int)
    fitted = draw_fitted(model, traced_camera(settings), path.places[indices])
    rows = [side_by_side([srgb_from_linear(np.clip(traced_flare, 0, 1)), srgb_from_linear(np.clip(fitted_flare, 0, 1)),
                          np.clip(0.5 + fitted_flare - traced_flare, 0, 1)])
            for traced_flare, fitted_flare in zip(path.pictures[indices], fitted, strict=True)]
    write_png(file, np.concatenate(rows))


def main() -> int:
    """Trace and fit each lens, and print its row; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("lenses", nargs="+", metavar="LENS", help=".lens files, or names of lenses of the program")
    parser.add_argument("--sheets", type=Path, metavar="FOLDER", help="write a sheet for each lens")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="changes",
                        help="a setting, as for make-flare; repeatable")
    args = parser.parse_args()
    print("| lens | focal length, mm | surfaces | mean error | largest error | time, s |\n| --- " + "| ---: " * 5 + "|")
    errors: list[float] = []
    for name in args.lenses:
        start = time.monotonic()
        try:
            settings = TracedFlareSettings().override({**dict(map(parse_setting, args.changes)), "lens": name})
            setup, progress = setup_with_ghost_gain(settings), TerminalProgress()
        except FitFlareError as problem:
            print(f"| {Path(name).stem} | refused | | | | |", flush=True)
            print(problem, file=sys.stderr)
            continue
        traced = trace(settings, setup, spread_places(settings), progress, "trace")
        model = fit_traced(settings, setup, traced, progress)
        seconds = time.monotonic() - start
        path = trace(settings, setup, path_places(settings), progress, "measure")
        progress.close()
        path_errors = relative_errors(model, traced_camera(settings), path)
        errors.append(float(np.mean(path_errors)))
        lens = find_lens(name)
        print(f"| {Path(name).stem} | {settings.used_focal_length:.1f} | {len(lens.index) - 1} | {errors[-1]:.3f} | "
              f"{max(path_errors):.3f} | {seconds:.0f} |", flush=True)
        if args.sheets:
            args.sheets.mkdir(parents=True, exist_ok=True)
            write_sheet(args.sheets / f"{Path(name).stem}.png", settings, model, path)
    if errors:
        print(f"\nMean over the lenses: {np.mean(errors):.3f}; below 0.15: {sum(error < 0.15 for error in errors)} of "
              f"{len(errors)}.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
