# SPDX-License-Identifier: GPL-3.0-or-later
"""--jobs: several processes of one command on this machine, each with a part of the frames.

Each process is the command itself with `--frames` and `--progress json`, as a render farm would start it. No two
processes have a frame in common; they share only the output folder.
"""
from __future__ import annotations

import argparse
import itertools
import queue
import sys
from collections import deque
from collections.abc import Sequence

from ..core.system.processes import DONE, available_cores, child_environment
from ..core.system.progress import STOP_FILE, Progress
from . import hand_off
from .child import Child, Event, EventQueue, combined_error, next_event
from .command import check_at_least_one


def add_option(parser: argparse.ArgumentParser,
               description: str = "processes at once on this machine, each with a part of the frames") -> None:
    """Add --jobs N, with this description."""
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help=f"{description} (default 1)")


def split_frames(numbers: Sequence[int], jobs: int) -> list[str]:
    """Split frame numbers into up to `jobs` contiguous lists of about equal length, each as a value of --frames.

    Raises SettingsError where `jobs` is below 1.
    """
    check_at_least_one("--jobs", jobs)
    ordered = sorted(set(numbers))
    count = min(jobs, len(ordered))
    bounds = [round(len(ordered) * part / count) for part in range(count + 1)] if count else [0]
    return [_format_ranges(ordered[start:end]) for start, end in itertools.pairwise(bounds)]


def _format_ranges(numbers: Sequence[int]) -> str:
    """Format ascending numbers, such as [1, 2, 3, 7] as "1-3,7"."""
    ranges: list[list[int]] = []
    for number in numbers:
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    return ",".join(f"{low}-{high}" if high > low else f"{low}" for low, high in ranges)


def run_jobs(args: argparse.Namespace, step: str, numbers: Sequence[int], progress: Progress,
             extra: Sequence[str] = (), *, continue_on_failure: bool = False) -> None:
    """Run a step of the command in `args.jobs` processes at once, each with a part of the frames.

    extra: more arguments for each process. continue_on_failure: a process that fails does not stop the others. The
    results of the processes are dropped: a caller that needs one runs the step itself afterwards, which keeps the
    finished frames. Raises what `run_parts` raises.
    """
    parts = [[*extra, "--jobs", "1", "--frames", frames] for frames in split_frames(numbers, args.jobs)]
    run_parts(args, step, parts, args.jobs, len(numbers), progress, continue_on_failure=continue_on_failure)


def run_parts(args: argparse.Namespace, step: str, parts: Sequence[Sequence[str]], jobs: int, total: int,
              progress: Progress, *, continue_on_failure: bool = False) -> None:
    """Run a step of the command once for each part, `jobs` processes at a time.

    parts: arguments to append to the command's own, one list per process. total: progress steps of all processes
    together; where it equals the number of parts, each finished part counts as one. continue_on_failure: a process that
    fails does not stop the others. Raises Cancelled on a stop, after the processes have stopped; the `combined_error`
    of processes that failed, after the others have stopped or, with `continue_on_failure`, have ended; EngineError
    where one cannot be started.
    """
    commands = [[sys.executable, str(hand_off.RUN_SCRIPT),
                 *hand_off.add_options(args.argv, "--step", step, *part, "--progress", "json")] for part in parts]
    progress.stage(step, total)
    failed = _run_all(commands, jobs, _JointProgress(progress, total == len(parts)), continue_on_failure)
    if failed:
        raise combined_error(failed, len(parts), step)


class _JointProgress:
    """Sums the progress of all processes: finished processes (`by_part`), or the steps that each one counts.

    _counted: steps that each process has reported as done.
    """

    def __init__(self, progress: Progress, by_part: bool) -> None:
        self.progress, self._by_part = progress, by_part
        self._counted: dict[Child, int] = {}

    def handle(self, child: Child, event: Event | None) -> None:
        """Add an event of a process; None stands for its end. Raises Cancelled."""
        if self._by_part:
            if event is None and child.status == DONE:
                self.progress.advance()
        elif event is not None and event.get("type") in ("stage", "progress"):
            advanced = event["done"] - self._counted.get(child, 0)
            self._counted[child] = event["done"]
            if advanced:
                self.progress.advance(advanced)


def _run_all(commands: Sequence[Sequence[str]], jobs: int, counter: _JointProgress,
             continue_on_failure: bool) -> list[Child]:
    """Run the processes, `jobs` at once; return those that failed. counter: gets their events.

    A stop, an error or, without `continue_on_failure`, the first failure ends the loop early; processes that still run
    are then stopped. Raises Cancelled and EngineError.
    """
    event_queue: EventQueue = queue.Queue()
    variables = _child_environment(min(jobs, len(commands)))
    waiting, running, failed = deque(commands), list[Child](), list[Child]()
    try:
        while (waiting or running) and (continue_on_failure or not failed):
            while waiting and len(running) < jobs:
                running.append(Child(waiting.popleft(), variables, event_queue))
            counter.progress.check()
            arrival = next_event(event_queue)
            if arrival is None:
                continue
            child, event = arrival
            if event is None:
                child.wait_or_kill()
                running.remove(child)
                if child.status != DONE:
                    failed.append(child)
            counter.handle(child, event)
    finally:
        for child in running:
            child.interrupt()
        for child in running:
            child.wait_or_kill()
    return failed


def _child_environment(processes: int) -> dict[str, str]:
    """Return the environment of one of so many processes: each gets an equal part of the cores as threads."""
    threads = str(max(available_cores() // max(processes, 1), 1))
    variables = {**child_environment(), "OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}
    variables.pop(STOP_FILE, None)  # this process watches the file, and stops the others
    return variables
