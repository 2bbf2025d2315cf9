# SPDX-License-Identifier: GPL-3.0-or-later
"""Several processes of one command on this machine, each with a share of the frames: --jobs.

Each is the command itself with `--frames` and `--progress json`, as a farm would start it; the frames are
theirs alone, so nothing is shared but the folder they write to.
"""
from __future__ import annotations

import argparse
import itertools
import queue
import sys
from collections import deque
from collections.abc import Sequence

from ..core.system.processes import DONE, cores, environment
from ..core.system.progress import STOP_FILE, Progress
from . import hand_off
from .child import Child, Event, Inbox, joint_failure, next_event
from .command import from_1


def add_option(parser: argparse.ArgumentParser,
               what: str = "processes at once on this machine, each with a share of the frames") -> None:
    """--jobs N, of `what`."""
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help=f"{what} (default 1)")


def shares(numbers: Sequence[int], jobs: int) -> list[str]:
    """Frame numbers as `jobs` lists for --frames, contiguous and of about one length; fewer where there are few.

    Raises SettingsError for less than one job.
    """
    from_1("--jobs", jobs)
    ordered = sorted(set(numbers))
    count = min(jobs, len(ordered))
    cuts = [round(len(ordered) * part / count) for part in range(count + 1)] if count else [0]
    return [_ranges(ordered[low:high]) for low, high in itertools.pairwise(cuts)]


def _ranges(numbers: Sequence[int]) -> str:
    """[1, 2, 3, 7] as "1-3,7"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ",".join(f"{low}-{high}" if high > low else f"{low}" for low, high in runs)


def run_jobs(words: argparse.Namespace, step: str, numbers: Sequence[int], progress: Progress,
             extra: Sequence[str] = (), *, past_failures: bool = False) -> None:
    """Run a step of the command once for each share of the frames, at once; returns when all are done.

    extra: words that the processes are given besides. past_failures, and what is raised: as of `run_parts`.
    """
    parts = [[*extra, "--jobs", "1", "--frames", frames] for frames in shares(numbers, words.jobs)]
    run_parts(words, step, parts, words.jobs, len(numbers), progress, past_failures=past_failures)


def run_parts(words: argparse.Namespace, step: str, parts: Sequence[Sequence[str]], jobs: int, total: int,
              progress: Progress, *, past_failures: bool = False) -> None:
    """Run a step of the command once for each part, its words with these after them, `jobs` of them at a time.

    total: steps of all together, as the processes count them; where it is the number of parts, parts are counted.
    past_failures: one that fails does not stop the others, since they go past what they cannot do themselves.
    Raises Cancelled when asked to stop, after the processes have stopped; the `joint_failure` of those that failed,
    after the others have been stopped or, `past_failures`, have ended; EngineError where one cannot be started.
    """
    commands = [[sys.executable, str(hand_off.RUN),
                 *hand_off.with_options(words.words, "--step", step, *part, "--progress", "json")] for part in parts]
    progress.stage(step, total)
    failed = _run_all(commands, jobs, _Counter(progress, total == len(parts)), past_failures)
    if failed:
        raise joint_failure(failed, len(parts), step)


class _Counter:
    """The steps of all processes together, for one progress: of a process that is through one, `by_part`, or those that
    it counts itself."""

    def __init__(self, progress: Progress, by_part: bool) -> None:
        self.progress, self._by_part = progress, by_part
        self._counted: dict[Child, int] = {}

    def take(self, child: Child, event: Event | None) -> None:
        """An event of a process, or its end. Raises Cancelled."""
        if self._by_part:
            if event is None and child.status == DONE:
                self.progress.advance()
        elif event is not None and event.get("type") in ("stage", "progress"):
            made = event["done"] - self._counted.get(child, 0)
            self._counted[child] = event["done"]
            if made:
                self.progress.advance(made)


def _run_all(commands: Sequence[Sequence[str]], jobs: int, counter: _Counter, past_failures: bool) -> list[Child]:
    """The processes that failed; where it ends before all are through, the others have been stopped."""
    inbox: Inbox = queue.Queue()
    shared = _environment(min(jobs, len(commands)))
    waiting, running, failed = deque(commands), list[Child](), list[Child]()
    try:
        while (waiting or running) and (past_failures or not failed):
            while waiting and len(running) < jobs:
                running.append(Child(waiting.popleft(), shared, inbox))
            counter.progress.check()
            heard = next_event(inbox)
            if heard is None:
                continue
            child, event = heard
            if event is None:
                child.end()
                running.remove(child)
                if child.status != DONE:
                    failed.append(child)
            counter.take(child, event)
    finally:
        for child in running:
            child.interrupt()
        for child in running:
            child.end()
    return failed


def _environment(processes: int) -> dict[str, str]:
    """Of each of so many at once, which share the cores."""
    threads = str(max(cores() // max(processes, 1), 1))
    shared = {**environment(), "OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}
    shared.pop(STOP_FILE, None)  # this process looks for it, and stops the others
    return shared
