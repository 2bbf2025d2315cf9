# SPDX-License-Identifier: GPL-3.0-or-later
"""Several processes of one command on this machine, each with a share of the frames: --jobs.

Each is the command itself with `--frames` and `--progress json`, as a farm would start it; the frames are
theirs alone, so nothing is shared but the folder they write to.
"""
from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from typing import IO, Any

from ..core.errors import EngineError, FitFlareError
from ..core.processes import cores
from ..core.progress import STOP_FILE, Progress
from . import hand_off
from .command import from_1

POLL_S = 0.2


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
    Raises Cancelled when asked to stop, after the processes have stopped; FitFlareError with the sentences of those
    that failed, after the others have been stopped or, `past_failures`, have ended.
    """
    events: queue.Queue[tuple[int, dict[str, Any] | None]] = queue.Queue()
    threads = str(max(cores() // max(min(jobs, len(parts)), 1), 1))
    environment = {**os.environ, "OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}
    environment.pop(STOP_FILE, None)  # this process looks for it, and stops the others
    by_part = total == len(parts)
    children: list[subprocess.Popen[str]] = []
    noises: list[IO[bytes]] = []
    counted, errors, ended = [0] * len(parts), dict[int, str](), 0
    progress.stage(step, total)
    try:
        while ended < len(parts) and (past_failures or not errors):
            while len(children) < len(parts) and len(children) - ended < jobs:
                noises.append(tempfile.TemporaryFile())  # noqa: SIM115 - closed below, when its process has ended
                own = hand_off.with_options(words.words, "--step", step, *parts[len(children)], "--progress", "json")
                whole = [sys.executable, str(hand_off.RUN), *own]
                children.append(subprocess.Popen(whole, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                                 stderr=noises[-1], encoding="utf-8", errors="replace",
                                                 env=environment, **hand_off.own_group()))
                threading.Thread(target=_listen, args=(len(children) - 1, children[-1], events), daemon=True).start()
            progress.check()
            try:
                number, event = events.get(timeout=POLL_S)
            except queue.Empty:
                continue
            if event is None:
                ended += 1
                if children[number].wait() != 0:
                    errors.setdefault(number, "")
                elif by_part:
                    progress.advance()
            elif event.get("type") in ("stage", "progress") and not by_part:
                made, counted[number] = event["done"] - counted[number], event["done"]
                if made:
                    progress.advance(made)
            elif event.get("type") == "error":
                errors[number] = event["text"]
    finally:
        _end(children)
        silent = [number for number, text in errors.items() if not text]
        said = _last_words(noises[silent[0]]) if silent else ""
        for noise in noises:
            noise.close()
    told = list(dict.fromkeys(text for text in errors.values() if text))
    if silent:
        sys.stderr.write(said)
        statuses = ", ".join(str(children[number].returncode) for number in silent)
        told.append(f"{len(silent)} of {len(parts)} processes of {step} ended without a reason, status {statuses}; "
                    f"{'what one wrote last stands above' if said else 'memory may have been short'}.")
        raise EngineError(" ".join(told))
    if told:
        raise FitFlareError(" ".join(told))


def _listen(number: int, child: subprocess.Popen[str], events: queue.Queue[tuple[int, dict[str, Any] | None]]) -> None:
    assert child.stdout is not None
    for line in child.stdout:
        with contextlib.suppress(ValueError):
            event = json.loads(line)
            if isinstance(event, dict):
                events.put((number, event))
    events.put((number, None))


def _end(children: Sequence[subprocess.Popen[str]]) -> None:
    """Ask those that run to stop, and wait for them."""
    running = [child for child in children if child.poll() is None]
    for child in running:
        with contextlib.suppress(OSError):
            child.send_signal(getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT))
    for child in running:
        try:
            child.wait(timeout=hand_off.PATIENCE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def _last_words(noise: IO[bytes]) -> str:
    noise.seek(0)
    return "".join(noise.read().decode("utf-8", "replace").splitlines(keepends=True)[-40:])

