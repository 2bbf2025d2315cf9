# SPDX-License-Identifier: GPL-3.0-or-later
"""The time and the scores of whole fits of preset `standard`, in one run.

    python benchmarks/fit_speed.py CAPTURE [--reference CHECKOUT] [--widths 480 960] [--rounds 1] [--out FOLDER]

Each fit is a process of its own, from the first frame read to the last file written. With `--reference`, the `standard`
of another checkout is fitted in turn with this one's, at the first width. The capture needs exact layers.
"""
from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import report
from core.conventions.run_files import EVALUATION
from core.errors import RunError
from core.system.files import read_json

COLUMNS = ("fit", "minutes", "ratio", "composite", "scene", "flare", "linear flare", "its error")


class Fit(NamedTuple):
    """A fit to time: its name in the table, the checkout whose commands run it, and the width of its pictures, px."""

    name: str
    checkout: Path
    width: int


class Outcome(NamedTuple):
    """Seconds of a fit, and its evaluation."""

    seconds: float
    scores: dict[str, dict[str, float]]


def run_fit(fit: Fit, capture: Path, folder: Path) -> Outcome:
    """Run and score one fit of a capture in a new folder. Raises CalledProcessError if a command fails."""
    program = fit.checkout / "headless" / "run.py"
    started = time.perf_counter()
    subprocess.run([sys.executable, program, "fit", capture, "--out", folder, "--size", str(fit.width)], check=True,
                   stdout=subprocess.DEVNULL)
    seconds = time.perf_counter() - started
    subprocess.run([sys.executable, program, "eval", folder], check=True, stdout=subprocess.DEVNULL)
    return Outcome(seconds, read_json(folder / EVALUATION, RunError))


def table_row(fit: Fit, outcomes: list[Outcome], first_seconds: float) -> list[str]:
    """Return a row of the table: medians over the rounds; first_seconds: the median time of the first fit."""
    seconds = statistics.median(outcome.seconds for outcome in outcomes)

    def median(layer: str, score: str = "psnr") -> float:
        return statistics.median(outcome.scores[layer][score] for outcome in outcomes)

    scores = [f"{median(layer):.2f}" for layer in ("composite", "scene", "flare", "flare_linear")]
    return [fit.name, f"{seconds / 60:.1f}", f"{seconds / first_seconds:.2f}", *scores,
            f"{median('flare_linear', 'relative_l2'):.3f}"]


def main() -> None:
    """Run the fits in turn, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--reference", type=Path, help="root of another checkout, whose fit is timed first")
    parser.add_argument("--widths", type=int, nargs="+", default=[480], help="widths of the pictures, px")
    parser.add_argument("--rounds", type=int, default=1, help="how often each fit is made")
    parser.add_argument("--out", type=Path, help="folder of the runs (default: a temporary one)")
    args = parser.parse_args()
    fits = [Fit(f"standard, {width}", report.ROOT, width) for width in args.widths]
    if args.reference is not None:
        fits.insert(0, Fit(f"reference, {args.widths[0]}", args.reference, args.widths[0]))
    with tempfile.TemporaryDirectory() as temporary:
        out = args.out or Path(temporary)
        outcomes: dict[Fit, list[Outcome]] = {fit: [] for fit in fits}
        for number in range(args.rounds):
            for index, fit in enumerate(fits):
                outcomes[fit].append(run_fit(fit, args.capture, out / f"{number}_{index}"))
                print(f"{fit.name}: {outcomes[fit][-1].seconds:.0f} s", flush=True)
    first_seconds = statistics.median(outcome.seconds for outcome in outcomes[fits[0]])
    print(report.conditions())
    print(report.table(COLUMNS, [table_row(fit, outcomes[fit], first_seconds) for fit in fits]))


if __name__ == "__main__":
    main()
