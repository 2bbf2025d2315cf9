# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures what an NVIDIA GPU gives, in one run of at most 15 minutes; prints tables for docs/results/rasterizer.md.

    python benchmarks/gpu.py                              iterations, frames, fits, threads of the processor
    python benchmarks/gpu.py --capture CAPTURE            fits of a capture with larger frames than the sample's
    python benchmarks/gpu.py --minutes 5 --only iterations frames

gsplat has columns if it is installed. A part that the time does not allow is named, not measured. Without a GPU it says
so and measures nothing.
"""
from __future__ import annotations

import argparse
import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from core.system.thread_environment import set_thread_environment

set_thread_environment()

import torch

from benchmarks import report
from benchmarks.raster import Case, Iteration, Raster, gsplat_rasterizer, our_rasterizer
from benchmarks.report import milliseconds, table
from benchmarks.timing import median_times, on_threads
from core.capture import Capture
from core.conventions.run_files import EVALUATION, METRICS
from core.errors import EngineError, RunError
from core.gaussians.device import select_device
from core.system.files import read_json

CASES = (Case(50_000, 480, 270), Case(150_000, 960, 540), Case(1_000_000, 1920, 1080))
FRAME_CASE = Case(173_000, 1920, 1080)
"""The frame whose time the paper gives: 10.8 ms on an RTX 4090."""
THREADS_CASE = Case(50_000, 480, 270, 2000)
THREADS = (2, 4, 8, 16)
FIT_WIDTHS = (480, 960, 1920)
MIN_SECONDS = 20.0
"""Seconds that must be left for a part to begin."""
ROUNDS = 3


class Deadline:
    """The time that is left of `minutes`."""

    def __init__(self, minutes: float) -> None:
        self._end = time.monotonic() + 60 * minutes

    @property
    def seconds_left(self) -> float:
        """Seconds left."""
        return self._end - time.monotonic()


def measure_iterations(_: Deadline, __: Path) -> str:
    """Return a table of forward pass, forward and backward pass, and whole training iteration, by size and rasterizer.
    """
    names = ["cuda", *(["gsplat"] if _is_gsplat_usable() else [])]
    rows = []
    for case in CASES:
        work: dict[str, Callable[[], object]] = {}
        for name in names:
            raster = Raster(case, gsplat_rasterizer if name == "gsplat" else our_rasterizer(name), name, "cuda")
            work |= {f"{name} forward": raster.forward, f"{name} both": raster.forward_backward}
        work["cuda iteration"] = Iteration(case, "cuda", "cuda").step
        times = median_times(work, ROUNDS)
        rows.append([str(case), *[milliseconds(times.get(f"{name} {kind}")) for name in names
                                  for kind in ("forward", "both")], milliseconds(times["cuda iteration"])])
        torch.cuda.empty_cache()
    kinds = [f"{name}, {kind}" for name in names for kind in ("forward", "forward + backward")]
    return table([f"ms; {torch.cuda.get_device_name()}", *kinds, "cuda, iteration with loss and Adam"], rows)


def _is_gsplat_usable() -> bool:
    """Return whether gsplat draws here; print why not if it is installed, but cannot be built."""
    if importlib.util.find_spec("gsplat") is None:
        return False
    try:
        Raster(Case(10, 16, 16), gsplat_rasterizer, None, "cuda").forward()
    except (ImportError, OSError, RuntimeError, AttributeError) as problem:
        print(f"gsplat is left out: {problem}")
        return False
    return True


def measure_frames(_: Deadline, __: Path) -> str:
    """Return a table of the time of a frame of the paper's size."""
    raster = Raster(FRAME_CASE, our_rasterizer("cuda"), "cuda", "cuda")
    seconds = median_times({"frame": raster.forward}, ROUNDS)["frame"]
    return table(["a frame, ms", "cuda"], [[str(FRAME_CASE), milliseconds(seconds)]])


def measure_thread_scaling(_: Deadline, __: Path) -> str:
    """Return a table of the time of one training iteration on the CPU by number of threads, with the speed-up over the
    smallest number."""
    counts = [count for count in THREADS if count <= torch.get_num_threads()]
    if not counts:
        return f"The processor has fewer than {THREADS[0]} threads; none is measured."
    step = Iteration(THREADS_CASE, "cpu").step
    times = median_times({str(count): on_threads(count, step) for count in counts}, ROUNDS)
    rows = [[f"{count} threads", milliseconds(times[str(count)]), f"{times[str(counts[0])] / times[str(count)]:.2f}"]
            for count in counts]
    return table([f"iteration, {THREADS_CASE}", "ms", f"speed-up over {counts[0]} threads"], rows)


def measure_fits(deadline: Deadline, capture: Path) -> str:
    """Return a table of whole `standard` fits of a capture by width of the frames: seconds, and held-out PSNR, dB.

    A fit that does not end in the time left is stopped, and the table has its iterations.
    """
    opened = Capture.open(capture)
    frame_width, rows = opened.views[0].camera.width, []
    for width in FIT_WIDTHS:
        if width > frame_width:
            rows.append([str(width), f"left out: the frames are {frame_width} pixels wide", "–", "–"])
        elif deadline.seconds_left < MIN_SECONDS:
            rows.append([str(width), "left out: no time left", "–", "–"])
        else:
            with tempfile.TemporaryDirectory() as folder:
                rows.append([str(width), *_time_fit(capture, width, Path(folder) / "run", deadline)])
    return table(["`fit --preset standard --device cuda`, width", "seconds", "composite, dB", "flare, dB"], rows)


def _time_fit(capture: Path, width: int, run: Path, deadline: Deadline) -> tuple[str, str, str]:
    """Fit and score a capture; return seconds, and the PSNR of composite and flare, as text."""
    command = [sys.executable, str(ROOT / "headless" / "run.py")]
    start = time.monotonic()
    try:
        subprocess.run([*command, "fit", str(capture), "--out", str(run), "--preset", "standard", "--size", str(width),
                        "--device", "cuda"], check=True, timeout=max(deadline.seconds_left, 1), capture_output=True)
        seconds = time.monotonic() - start
        subprocess.run([*command, "eval", str(run), "--device", "cuda"], check=True,
                       timeout=max(deadline.seconds_left, 1), capture_output=True)
    except subprocess.CalledProcessError as problem:
        return f"failed: {problem.stderr.decode(errors='replace').strip().splitlines()[-1:]}", "–", "–"
    except subprocess.TimeoutExpired:
        metrics = run / METRICS
        lines = metrics.read_text(encoding="utf-8").splitlines() if metrics.is_file() else []
        done = json.loads(lines[-1])["iteration"] if lines else 0
        return f"not finished: {done} iterations in {time.monotonic() - start:.0f} s", "–", "–"
    scores = read_json(run / EVALUATION, RunError)
    return f"{seconds:.0f}", f"{scores['composite']['psnr']:.2f}", f"{scores['flare']['psnr']:.2f}"


PARTS: dict[str, Callable[[Deadline, Path], str]] = {
    "iterations": measure_iterations, "frames": measure_frames, "threads": measure_thread_scaling, "fits": measure_fits}


def main() -> int:
    """Measure the parts in turn until the time is over; return 0, also where there is no GPU."""
    parser = argparse.ArgumentParser(description="Measures what an NVIDIA GPU gives.")
    parser.add_argument("--minutes", type=float, default=15.0, help="time of the whole run (default 15)")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--capture", type=Path, default=ROOT / "sample_scenes" / "desk", help="capture to fit")
    args = parser.parse_args()
    try:
        select_device("cuda")
    except EngineError as problem:
        print(f"Nothing is measured: {problem}")
        return 0
    deadline = Deadline(args.minutes)
    print(report.conditions(), flush=True)
    for part in args.only:
        has_time = deadline.seconds_left > MIN_SECONDS
        text = PARTS[part](deadline, args.capture) if has_time else f"{part} is left out: no time left."
        print(f"\n{text}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
