# SPDX-License-Identifier: GPL-3.0-or-later
"""The time of `remove` for many frames, against the time for one, and against another checkout, in one run.

    python benchmarks/removal_frames.py [--frames 100] [--size 1920x1080] [--reference CHECKOUT]

Frames are PNGs of a slowly moving pattern with a light. They are cleaned as stills (`--stills`), and as a shot, whose
predictions are filtered over time. The time for one frame is the smallest of three in a process that has its kernels
and weights loaded; it includes reading and writing. With `--reference`, each command of the other checkout runs before
this one's.
"""
from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import report
from core.images.write import write_png

COLUMNS = ("checkout, frames", "seconds", "seconds per frame", "of the frames times one frame")
ONE_FRAME = """
import sys, time
from pathlib import Path
from core.removal.inference.remover import Remover
from core.removal.jobs.batch import clean_plates
from core.system.progress import Progress
plate, folder, remover = Path(sys.argv[1]), Path(sys.argv[2]), Remover()
for _ in range(4):
    started = time.perf_counter()
    clean_plates([plate], folder, remover, Progress(), overwrite=True, independent=True)
    print(time.perf_counter() - started)
"""
"""Prints the seconds of each call; the first one loads what later ones have."""


def draw_frames(folder: Path, count: int, width: int, height: int) -> list[Path]:
    """Draw `count` frames of a pattern that moves by two pixels a frame, with a light and its glow."""
    folder.mkdir()
    paths = [folder / f"{number:04d}.png" for number in range(count)]
    random = np.random.default_rng(0)
    grain = random.normal(0, 0.01, (height, width + 2 * count, 3)).astype(np.float32)
    x, y = np.meshgrid(np.arange(width + 2 * count, dtype=np.float32), np.arange(height, dtype=np.float32))
    waves = 0.25 + 0.1 * np.sin(x / 40) * np.cos(y / 55) + 0.05 * np.sin(x / 7 + y / 11)
    scene = waves[..., None] * np.array([1, 0.8, 0.6], np.float32) + grain
    for number, path in enumerate(paths):
        light_x, light_y = 0.6 * width - 3 * number, 0.35 * height
        distance = np.hypot(x[:, :width] - light_x, y[:, :width] - light_y) / width
        glow = 0.5 / (1 + 900 * distance ** 2) + 4 * (distance < 0.01)
        write_png(path, np.clip(scene[:, 2 * number:2 * number + width] + glow[..., None], 0, 1))
    return paths


def seconds_for_one(checkout: Path, plate: Path, folder: Path) -> float:
    """Return the shortest time in which a checkout cleans one plate after the first, in seconds."""
    done = subprocess.run([sys.executable, "-c", ONE_FRAME, plate, folder], check=True, cwd=checkout,
                          capture_output=True, text=True)
    return min(float(line) for line in done.stdout.split()[1:])


def seconds_for_all(checkout: Path, frames: Path, folder: Path, *options: str) -> float:
    """Return the time in which the `remove` of a checkout cleans a folder of frames, in seconds."""
    started = time.perf_counter()
    subprocess.run([sys.executable, checkout / "headless" / "run.py", "remove", frames, "--out", folder, *options],
                   check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - started


def main() -> None:
    """Clean the frames with each checkout, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--size", default="1920x1080", metavar="WIDTHxHEIGHT")
    parser.add_argument("--reference", type=Path, help="root of another checkout, whose commands run first")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    checkouts = {"reference": args.reference.resolve()} if args.reference else {}
    checkouts["this"] = report.ROOT
    print(report.conditions())
    rows, one_frame_s = list[list[str]](), 0.0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        frames = draw_frames(folder / "frames", args.frames, width, height)
        for name, checkout in checkouts.items():
            seconds = seconds_for_one(checkout, frames[0], folder / f"one_{name}")
            one_frame_s = one_frame_s or seconds
            rows.append([f"{name}, one frame", f"{seconds:.2f}", f"{seconds:.2f}", f"{seconds / one_frame_s:.2f}"])
        for kind, options in (("stills", ["--stills"]), ("a shot", [])):
            for name, checkout in checkouts.items():
                seconds = seconds_for_all(checkout, folder / "frames", folder / f"{kind}_{name}", *options)
                rows.append([f"{name}, {args.frames} frames, {kind}", f"{seconds:.1f}",
                             f"{seconds / args.frames:.2f}", f"{seconds / args.frames / one_frame_s:.2f}"])
                print(rows[-1], flush=True)
    print(report.table(COLUMNS, rows))


if __name__ == "__main__":
    main()
