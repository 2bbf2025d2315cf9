# SPDX-License-Identifier: GPL-3.0-or-later
"""The share of a fit's iterations in which only one core works, by tracing the kernels that run on all threads.

    python benchmarks/single_core.py CAPTURE [--preset standard] [--iterations 600] [--threads 2]

Every call of such a kernel is timed. All other time counts as one core's, also where torch spreads an operation over
threads of its own, so the share is an upper bound. Start it on an otherwise idle machine.
"""
from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from core.system.thread_environment import set_thread_environment

set_thread_environment()  # before torch is imported

import torch

from benchmarks import report
from core.capture import Capture
from core.choices import OUR_PRESETS
from core.fit import preset
from core.fit.trainer import Trainer
from core.gaussians.cpu import threads

PARTS = 4
"""Parts of the fit whose share is printed: it changes with the sizes of the pictures and the number of Gaussians."""


class KernelTimer:
    """Sums the seconds of calls on more than one thread."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def timed(self, call: Callable[..., None]) -> Callable[..., None]:
        """Return `_ThreadPool.call` with its time added to `seconds`."""
        def timed_call(pool: Any, function: Any, scratch_size: int, arguments: Any, thread_count: int) -> None:
            started = time.perf_counter()
            call(pool, function, scratch_size, arguments, thread_count)
            if thread_count > 1:
                self.seconds += time.perf_counter() - started
        return timed_call


def main() -> None:
    """Run a short fit, and print the share of each part of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--preset", choices=OUR_PRESETS, default="standard")
    parser.add_argument("--iterations", type=int, default=600)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    timer = KernelTimer()
    threads._ThreadPool.call = timer.timed(threads._ThreadPool.call)  # type: ignore[method-assign]
    trainer = Trainer(Capture.open(args.capture), preset(args.preset, iterations=args.iterations))
    rows = []
    for part in range(PARTS):
        timer.seconds, started, first = 0.0, time.perf_counter(), trainer.iteration
        while trainer.iteration < args.iterations * (part + 1) // PARTS:
            trainer.step()
        seconds = time.perf_counter() - started
        rows.append([f"{first + 1} to {trainer.iteration}", f"{1e3 * seconds / (trainer.iteration - first):.1f}",
                     f"{1 - timer.seconds / seconds:.0%}"])
    print(report.conditions())
    print(report.table(("iterations", "ms each", "on one core"), rows))


if __name__ == "__main__":
    main()
