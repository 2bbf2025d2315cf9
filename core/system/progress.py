# SPDX-License-Identifier: GPL-3.0-or-later
"""Reports progress of a job, and passes on requests to stop it.

Core code takes a `Progress` and calls `stage`, `advance`, `say`, `result`. The base class is silent; `TerminalProgress`
draws a bar; `OpenJdProgress` writes the Open Job Description of farms; `JsonProgress` writes a JSON object per line for
the add-on and other programs:

    {"type": "stage", "name": "fit", "total": 3000, "done": 0}
    {"type": "progress", "stage": "fit", "done": 120, "total": 3000, "eta_s": 61.2, "figures": {…}}
    {"type": "say", "text": "…"}
    {"type": "result", "data": {…}}
    {"type": "error", "text": "…"}
"""
from __future__ import annotations

import contextlib
import errno
import importlib.util
import json
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from ..errors import DISK_FULL, Cancelled

STOP_FILE = "FIT_FLARE_STOP"
"""Environment variable with the path of a file whose existence asks a command to stop."""
STOP_FILE_INTERVAL_S = 0.3
"""Seconds between two looks for that file."""
MIN_PACE_WINDOW_S, MAX_PACE_WINDOW_S = 1.0, 60.0
"""Shortest and longest time over which the pace of work is measured: a fit slows down as its Gaussians become more."""
LINE_INTERVAL_S, JSON_INTERVAL_S, OPEN_JD_INTERVAL_S = 10.0, 0.1, 1.0
"""Shortest time between two reports of progress: by lines, as JSON, and to Open Job Description."""
_STREAM_GONE = (*DISK_FULL, errno.EIO)
"""Error numbers of a stream that takes no more: the disk is full, or (EIO) the terminal is closed."""


class Progress:
    """Silent progress, and the interface of the other classes; `advance` raises Cancelled after `request_stop`."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._stage = ""
        self._total = 0
        self._done = 0
        self._samples: deque[tuple[float, int]] = deque()
        """(time, steps done), about once a second over the last MAX_PACE_WINDOW_S of this stage."""

    def stage(self, name: str, total: int, done: int = 0) -> None:
        """Begin a stage of `total` steps, of which `done` were made by an earlier run."""
        self._stage, self._total, self._done = name, total, done
        self._samples.clear()
        self._show_stage()
        self.check()

    def advance(self, steps: int = 1, **figures: float) -> None:
        """Count steps; `figures` are shown beside them (loss, Gaussians, …)."""
        self._done += steps
        self._sample_pace()
        self._show_progress(figures)
        self.check()

    def say(self, text: str) -> None:
        """Report one sentence to the user."""

    def result(self, **data: Any) -> None:
        """Report the paths and figures that the command made, JSON-able."""

    def error(self, text: str) -> None:
        """Report the sentence with which a failed command ends."""

    def close(self) -> None:
        """Restore the terminal."""

    def request_stop(self) -> None:
        """Ask the work to end at its next step; safe from signal handlers and other threads."""
        self._stop.set()

    def check(self) -> None:
        """Raise Cancelled if a stop was requested."""
        if self._stop.is_set():
            raise Cancelled(f"Stopped during {self._stage or 'start-up'} as requested; what is done is kept.")

    @property
    def stage_name(self) -> str:
        """Name of the stage, "" before the first."""
        return self._stage

    @property
    def eta_s(self) -> float | None:
        """Estimated seconds to the end of this stage, by the recent pace; None until a second after the first step.

        The first step says little about the others: code is compiled and data loaded in it, and parallel processes end
        several at once.
        """
        if self._done >= self._total:
            return 0.0
        if not self._samples:
            return None
        sample_time, sample_done = self._samples[0]
        elapsed_s = time.monotonic() - sample_time
        if elapsed_s < MIN_PACE_WINDOW_S or self._done == sample_done:
            return None
        return elapsed_s / (self._done - sample_done) * (self._total - self._done)

    def _sample_pace(self) -> None:
        """Once a second, add the steps done by now to the samples; drop samples from before the pace window, except the
        last of them, at which the window starts."""
        now, samples = time.monotonic(), self._samples
        if not samples or now - samples[-1][0] >= MIN_PACE_WINDOW_S:
            samples.append((now, self._done))
        while len(samples) > 2 and now - samples[1][0] > MAX_PACE_WINDOW_S:
            samples.popleft()

    def _show_stage(self) -> None:
        pass

    def _show_progress(self, figures: dict[str, float]) -> None:
        pass


def _write_line(stream: TextIO, line: str) -> None:
    """Write a line; drop it where the disk is full or the terminal closed.

    The work goes on, or fails for its own reasons. A closed terminal stops a command by its signal.
    """
    try:
        stream.write(f"{line}\n")
        stream.flush()
    except OSError as problem:
        if problem.errno not in _STREAM_GONE:
            raise


def flush_or_drop(stream: TextIO) -> None:
    """Flush a stream, and discard what a full disk or a closed terminal refuses: Python would retry at exit, and fail.
    """
    try:
        stream.flush()
    except OSError as problem:
        if problem.errno not in _STREAM_GONE:
            raise
        # Point the stream's descriptor at the null device, flush what is left there, and restore the descriptor.
        descriptor, null = stream.fileno(), os.open(os.devnull, os.O_WRONLY)
        saved_descriptor = os.dup(descriptor)
        os.dup2(null, descriptor)
        try:
            stream.flush()
        finally:
            os.dup2(saved_descriptor, descriptor)
            os.close(saved_descriptor)
            os.close(null)


class _LineProgress:
    """Prints a line every ten seconds and at the end; stands in for tqdm's bar."""

    def __init__(self, name: str, total: int, done: int, stream: TextIO) -> None:
        self._name, self._total, self._done, self._stream = name, total, done, stream
        self._reported = time.monotonic()
        self._figures = ""

    def set_postfix(self, figures: dict[str, str], refresh: bool) -> None:  # noqa: ARG002 - tqdm's own signature
        self._figures = "".join(f"  {name} {value}" for name, value in figures.items())

    def update(self, steps: int) -> None:
        """Count steps, and print a line if one is due."""
        self._done += steps
        if self._done >= self._total or time.monotonic() - self._reported > LINE_INTERVAL_S:
            self._reported = time.monotonic()
            _write_line(self._stream, f"{self._name}: {self._done}/{self._total}{self._figures}")

    def clear(self) -> None:
        """Does nothing: lines need no clearing."""

    def close(self) -> None:
        """Does nothing."""


class TerminalProgress(Progress):
    """Draws a bar on a terminal (tqdm); prints lines where the output is a file, or tqdm is not installed."""

    def __init__(self, stream: TextIO | None = None) -> None:
        super().__init__()
        self._stream = stream or sys.stderr
        self._bar: Any = None
        self._reported = 0

    def _show_stage(self) -> None:
        """Begin the bar of the current stage, by tqdm on a terminal that has it, else by lines."""
        self.close()
        self._reported = self._done
        # Blender's own Python has no tqdm.
        if self._stream.isatty() and importlib.util.find_spec("tqdm"):
            from tqdm import tqdm

            self._bar = tqdm(total=self._total, initial=self._done, desc=self._stage, file=self._stream,
                             dynamic_ncols=True)
        else:
            self._bar = _LineProgress(self._stage, self._total, self._done, self._stream)

    def _show_progress(self, figures: dict[str, float]) -> None:
        if self._bar is None:
            return
        if figures:
            self._bar.set_postfix({key: f"{value:.4g}" for key, value in figures.items()}, refresh=False)
        self._bar.update(self._done - self._reported)
        self._reported = self._done

    def say(self, text: str) -> None:
        if self._bar is not None and self._done >= self._total:  # leave a finished bar above the text
            self.close()
        elif self._bar is not None:
            self._bar.clear()
        _write_line(self._stream, text)

    def error(self, text: str) -> None:
        self.close()
        _write_line(self._stream, f"error: {text}")

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class JsonProgress(Progress):
    """Writes one JSON object per line to stdout, at most ten progress lines per second."""

    def __init__(self, stream: TextIO | None = None) -> None:
        super().__init__()
        self._stream = stream or sys.stdout
        self._last = 0.0

    def _send(self, **event: Any) -> None:
        _write_line(self._stream, json.dumps(event))

    def _show_stage(self) -> None:
        self._last = 0.0
        self._send(type="stage", name=self._stage, total=self._total, done=self._done)

    def _show_progress(self, figures: dict[str, float]) -> None:
        now = time.monotonic()
        if self._done < self._total and now - self._last < JSON_INTERVAL_S:
            return
        self._last = now
        eta = self.eta_s
        self._send(type="progress", stage=self._stage, done=self._done, total=self._total,
                   eta_s=None if eta is None else round(eta, 1), figures=figures)

    def say(self, text: str) -> None:
        self._send(type="say", text=text)

    def result(self, **data: Any) -> None:
        self._send(type="result", data=data)

    def error(self, text: str) -> None:
        self._send(type="error", text=text)


class OpenJdProgress(Progress):
    """Writes lines of the Open Job Description to stdout: openjd_progress (per cent), openjd_status, openjd_fail.

    At most one progress line per second, and each per cent once.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        super().__init__()
        self._stream = stream or sys.stdout
        self._reported = -1
        self._last = 0.0

    def _write_update(self, kind: str, text: str) -> None:
        """Write one line of the Open Job Description. kind: "status", "progress" or "fail"."""
        _write_line(self._stream, f"openjd_{kind}: {' '.join(text.split())}")

    def _show_stage(self) -> None:
        self._reported, self._last = -1, 0.0
        self._write_update("status", f"{self._stage} {self._done}/{self._total}")
        self._show_progress({})

    def _show_progress(self, figures: dict[str, float]) -> None:  # noqa: ARG002 - the base's signature
        percent = int(100 * min(max(self._done / self._total, 0), 1)) if self._total > 0 else 100
        now = time.monotonic()
        if percent == self._reported or (percent < 100 and now - self._last < OPEN_JD_INTERVAL_S):
            return
        self._reported, self._last = percent, now
        self._write_update("progress", f"{percent}")

    def say(self, text: str) -> None:
        self._write_update("status", text)

    def error(self, text: str) -> None:
        self._write_update("fail", text)


@contextlib.contextmanager
def stop_on_request(progress: Progress) -> Iterator[Progress]:
    """Stop the work at its next step on one of `stop_signals`, or when the file that STOP_FILE names exists."""
    with _stop_on_file(progress), _stop_on_signals(progress):
        yield progress


@contextlib.contextmanager
def _stop_on_file(progress: Progress) -> Iterator[Progress]:
    """Request a stop when the file that STOP_FILE names exists: a thread watches for it during the block."""
    path = os.environ.get(STOP_FILE)
    if not path:
        yield progress
        return
    file, ended = Path(path), threading.Event()

    def watch() -> None:
        while not ended.wait(STOP_FILE_INTERVAL_S):
            if file.exists():
                progress.request_stop()
                return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield progress
    finally:
        ended.set()
        watcher.join()


def stop_signals() -> list[int]:
    """Return the signals that stop a command: SIGINT, SIGTERM, (Windows) CTRL_BREAK, and SIGHUP where the system has
    it.

    SIGHUP, which a closed terminal sends, is left out where nohup has it ignored.
    """
    names = ("SIGINT", "SIGTERM", "SIGBREAK", "SIGHUP")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    return [number for number in numbers if not is_hangup(number) or signal.getsignal(number) is not signal.SIG_IGN]


def is_hangup(number: int) -> bool:
    """Return whether a signal says that the terminal is closed."""
    return number == getattr(signal, "SIGHUP", None)


@contextlib.contextmanager
def _stop_on_signals(progress: Progress) -> Iterator[Progress]:
    """Request a stop on one of `stop_signals`, for the length of the block. Only the main thread may set handlers;
    elsewhere this changes nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield progress
        return
    previous_handlers = {number: signal.getsignal(number) for number in stop_signals()}

    def request_stop(number: int, _frame: Any) -> None:
        progress.request_stop()
        # A second signal takes effect at once. A closed terminal signals twice: by the system and by the shell.
        signal.signal(number, signal.SIG_IGN if is_hangup(number) else signal.SIG_DFL)

    for number in previous_handlers:
        signal.signal(number, request_stop)
    try:
        yield progress
    finally:
        for number, handler in previous_handlers.items():
            # None is a handler that Python did not set (Blender's own) and cannot set again.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
