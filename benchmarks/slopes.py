# SPDX-License-Identifier: GPL-3.0-or-later
"""Growth of memory, open files and threads over long work: plates of `remove`, frames of `bake`, iterations of `fit`.

    python benchmarks/slopes.py [plates] [frames] [iterations] [growing] [--count 1000]

`iterations` has a fixed number of Gaussians; in `growing`, which has no limit, they are cloned as in any fit.

Each runs in a process of its own on tiny pictures. Memory is sampled at every step; the slope is the least-squares line
through the samples after the first fifth, in which caches fill, per hundred units. Memory may grow by less than 1 MB
per hundred units and open files and threads not at all, or the exit status is 1.
"""
from __future__ import annotations

import argparse
import gc
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.resident import resident_memory
from core.bake.shot import bake_shot
from core.capture import Capture
from core.fit import fit, preset
from core.fit.overrides import override_settings
from core.flare.file import FlareFile
from core.flare.file import save as save_flare
from core.images.write import write_png
from core.look import TrainedCamera
from core.look.shot import Shot, ShotFrame
from core.removal.inference.remover import Remover
from core.removal.jobs.batch import clean_plates
from core.system.progress import Progress
from tests.core.flared import cameras, flared_capture
from tests.core.removal_cases import network_file
from tests.core.test_flare import some_flare

MAX_MB_PER_HUNDRED = 1.0
MAX_HANDLES_PER_HUNDRED = 0.5
WARM_UP = 0.2
"""Part of the samples that is left out."""


class MemorySampler(Progress):
    """Samples (units, MB, open files, threads) at every step."""

    def __init__(self) -> None:
        super().__init__()
        self.samples: list[tuple[int, float, int, int]] = []
        self._units = 0
        self._process = psutil.Process()

    def advance(self, steps: int = 1, **figures: float) -> None:
        super().advance(steps, **figures)
        self._units += steps
        if self._units % 10 == 0:
            gc.collect()
        self.samples.append((self._units, resident_memory(), self._process.num_fds(), self._process.num_threads()))


def clean_random_plates(folder: Path, count: int, progress: Progress) -> None:
    """Clean `count` plates."""
    random = np.random.default_rng(0)
    for number in range(count):
        write_png(folder / "plates" / f"{number:05d}.png", random.random((32, 48, 3), np.float32))
    remover = Remover(network_file(folder / "weights.safetensors", bias=0.2), working_size=128)
    clean_plates([folder / "plates"], folder / "clean", remover, progress, independent=True)


def bake_frames(folder: Path, count: int, progress: Progress) -> None:
    """Bake `count` frames of a shot."""
    save_flare(folder / "look.flare", FlareFile(some_flare(count=6), "over", TrainedCamera(64, 40, 70.0, 70.0, 33.0,
                                                                                           19.5)))
    shot = Shot(folder / "look.flare", tuple(ShotFrame(number, "Camera", camera, (), ())
                                             for number, camera in enumerate(cameras(count), 1)))
    bake_shot(shot, folder / "layers", progress=progress)


def fit_fixed_count(folder: Path, count: int, progress: Progress) -> None:
    """Fit for `count` iterations with a fixed number of Gaussians: the memory of clones is no leak."""
    # Cloning would begin and end after the last iteration.
    never = {f"{part}.{end}": 10 * count for part in ("scene.classic", "scene.mcmc", "flare.density")
             for end in ("start", "stop")}
    fit_growing_count(folder, count, progress, **never)


def fit_growing_count(folder: Path, count: int, progress: Progress, **changes: int) -> None:
    """Fit for `count` iterations, in which Gaussians may be cloned. changes: settings by name."""
    capture = Capture.open(flared_capture(folder / "capture", count=7, dots=60))
    settings = override_settings(preset("draft", iterations=count), {"flare.count": 24, **changes})
    fit(capture, settings, folder / "run", progress)


WORK: dict[str, Callable[[Path, int, Progress], None]] = {
    "plates": clean_random_plates, "frames": bake_frames, "iterations": fit_fixed_count, "growing": fit_growing_count}
UNLIMITED = ("growing",)
"""Work whose memory may grow."""


def slope_per_hundred(x: list[float], y: list[float]) -> float:
    """Return the slope of the least-squares line of `y`, per hundred of `x`; 0 where all `x` are equal."""
    return float(np.polyfit(x, y, 1)[0]) * 100 if len(set(x)) > 1 else 0.0


def measure_growth(kind: str, count: int) -> int:
    """Do the work of one kind and print its line; return the exit status, 1 where something grows too much."""
    torch.set_num_threads(1)
    progress = MemorySampler()
    with tempfile.TemporaryDirectory(prefix="slopes-") as folder:
        WORK[kind](Path(folder), count, progress)
    samples = progress.samples[int(len(progress.samples) * WARM_UP):]
    units, *columns = (list(map(float, column)) for column in zip(*samples, strict=True))
    memory, files, threads = (slope_per_hundred(units, column) for column in columns)
    print(f"| {kind} | {int(units[-1])} | {columns[0][0]:.0f} | {columns[0][-1]:.0f} | {memory:+.3f} | {files:+.3f} | "
          f"{threads:+.3f} |", flush=True)
    too_much = memory >= MAX_MB_PER_HUNDRED and kind not in UNLIMITED
    return int(too_much or max(files, threads) >= MAX_HANDLES_PER_HUNDRED)


def main(argv: list[str]) -> int:
    """Measure each kind in a process of its own; return the exit status, 1 if something grows too much or a process
    fails."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    limited = [kind for kind in WORK if kind not in UNLIMITED]
    parser.add_argument("kinds", nargs="*", default=limited, metavar="KIND", help=", ".join(WORK))
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.here:
        return measure_growth(args.kinds[0], args.count)
    print("| work | units | MB after warm-up | MB at the end | MB per 100 | open files per 100 | threads per 100 |\n"
          "| --- | --- | --- | --- | --- | --- | --- |", flush=True)
    statuses = [subprocess.run([sys.executable, __file__, kind, "--count", str(args.count), "--here"],
                               check=False).returncode for kind in args.kinds]
    return int(any(statuses))  # the status of a process that a signal ends is negative


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
