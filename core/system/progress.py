# SPDX-License-Identifier: GPL-3.0-or-later
"""How long work tells where it stands, and how it is asked to stop.

Core code takes a `Progress` and calls `stage`, `advance`, `say`, `result`. The base class is silent;
`TerminalProgress` draws a bar; `OpenJdProgress` speaks to farms of the Open Job Description; `JsonProgress`
writes one JSON object a line for the add-on and other programs:

    {"type": "stage", "name": "fit", "total": 3000, "done": 0}
    {"type": "progress", "stage": "fit", "done": 120, "total": 3000, "left_s": 61.2, "figures": {…}}
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
"""Of the environment: the path of a file which, when it is there, asks a command to stop."""
STOP_FILE_EVERY_S = 0.3
LEAST_PACE_OVER_S, PACE_OVER_S = 1.0, 60.0
"""Over which the pace of work is measured, at least and at most: a fit slows down as its Gaussians grow more."""
_NO_LISTENER = (*DISK_FULL, errno.EIO)  # the latter of a terminal that is gone


class Progress:
    """Silent progress, and the interface of the others; `advance` raises Cancelled after `request_stop`."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._stage = ""
        self._total = 0
        self._done = 0
        self._marks: deque[tuple[float, int]] = deque()
        """Of this stage when how many steps were done, from the first on, about once a second over the last
        `PACE_OVER_S`."""

    def stage(self, name: str, total: int, done: int = 0) -> None:
        """Begin a stage of `total` steps, of which `done` were made by an earlier run."""
        self._stage, self._total, self._done = name, total, done
        self._marks.clear()
        self._show_stage()
        self.check()

    def advance(self, steps: int = 1, **figures: float) -> None:
        """Count steps; `figures` are shown beside them (loss, Gaussians, …)."""
        self._done += steps
        self._mark()
        self._show_progress(figures)
        self.check()

    def say(self, text: str) -> None:
        """One sentence for the person who watches."""

    def result(self, **data: Any) -> None:
        """What the command made: paths and figures, JSON-able."""

    def error(self, text: str) -> None:
        """The one sentence a failed command ends with."""

    def close(self) -> None:
        """Leave the terminal tidy."""

    def request_stop(self) -> None:
        """Ask the work to end at its next step; safe from signal handlers and other threads."""
        self._stop.set()

    def check(self) -> None:
        """Raise Cancelled if a stop was asked for."""
        if self._stop.is_set():
            raise Cancelled(f"Stopped during {self._stage or 'start-up'} as asked; what is done is kept.")

    @property
    def left_s(self) -> float | None:
        """Seconds left in this stage at the pace of late; None until a second after the first step, which says little
        of the others: in it things are compiled and loaded, and processes that work side by side end several at once.
        """
        if self._done >= self._total:
            return 0.0
        if not self._marks:
            return None
        since, before = self._marks[0]
        passed = time.monotonic() - since
        if passed < LEAST_PACE_OVER_S or self._done == before:
            return None
        return passed / (self._done - before) * (self._total - self._done)

    def _mark(self) -> None:
        now, marks = time.monotonic(), self._marks
        if not marks or now - marks[-1][0] >= LEAST_PACE_OVER_S:
            marks.append((now, self._done))
        while len(marks) > 2 and now - marks[1][0] > PACE_OVER_S:
            marks.popleft()

    def _show_stage(self) -> None:
        pass

    def _show_progress(self, figures: dict[str, float]) -> None:
        pass


def _tell(stream: TextIO, line: str) -> None:
    """A disk too full for what is told is no reason to end: the work goes on, or says so by its own failure. A terminal
    that is gone has its own way of asking for the end."""
    try:
        stream.write(f"{line}\n")
        stream.flush()
    except OSError as problem:
        if problem.errno not in _NO_LISTENER:
            raise


def flush_or_drop(stream: TextIO) -> None:
    """Leave nothing in the stream that a full disk or a terminal that is gone refuses: Python would try it again at
    exit, and fail by it."""
    try:
        stream.flush()
    except OSError as problem:
        if problem.errno not in _NO_LISTENER:
            raise
        number, nowhere = stream.fileno(), os.open(os.devnull, os.O_WRONLY)
        before = os.dup(number)
        os.dup2(nowhere, number)
        try:
            stream.flush()
        finally:
            os.dup2(before, number)
            os.close(before)
            os.close(nowhere)


class _Lines:
    """A line every ten seconds and at the end, in place of tqdm's bar."""

    def __init__(self, name: str, total: int, done: int, stream: TextIO) -> None:
        self._name, self._total, self._done, self._stream = name, total, done, stream
        self._shown = time.monotonic()
        self._figures = ""

    def set_postfix(self, figures: dict[str, str], refresh: bool) -> None:  # noqa: ARG002 - tqdm's own signature
        self._figures = "".join(f"  {name} {value}" for name, value in figures.items())

    def update(self, steps: int) -> None:
        self._done += steps
        if self._done >= self._total or time.monotonic() - self._shown > 10:
            self._shown = time.monotonic()
            _tell(self._stream, f"{self._name}: {self._done}/{self._total}{self._figures}")

    def clear(self) -> None:
        """Lines leave nothing to clear."""

    def close(self) -> None:
        """Nor to close."""


class TerminalProgress(Progress):
    """A bar on a terminal (tqdm); plain lines where the output is a file, or tqdm is not installed."""

    def __init__(self, stream: TextIO | None = None) -> None:
        super().__init__()
        self._stream = stream or sys.stderr
        self._bar: Any = None
        self._shown = 0

    def _show_stage(self) -> None:
        self.close()
        self._shown = self._done
        # Blender's own Python has no tqdm.
        if self._stream.isatty() and importlib.util.find_spec("tqdm"):
            from tqdm import tqdm

            self._bar = tqdm(total=self._total, initial=self._done, desc=self._stage, file=self._stream,
                             dynamic_ncols=True)
        else:
            self._bar = _Lines(self._stage, self._total, self._done, self._stream)

    def _show_progress(self, figures: dict[str, float]) -> None:
        if self._bar is None:
            return
        if figures:
            self._bar.set_postfix({key: f"{value:.4g}" for key, value in figures.items()}, refresh=False)
        self._bar.update(self._done - self._shown)
        self._shown = self._done

    def say(self, text: str) -> None:
        if self._bar is not None and self._done >= self._total:
            self.close()
        elif self._bar is not None:
            self._bar.clear()
        _tell(self._stream, text)

    def error(self, text: str) -> None:
        self.close()
        _tell(self._stream, f"error: {text}")

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class JsonProgress(Progress):
    """One JSON object a line on stdout, at most ten progress lines a second."""

    def __init__(self, stream: TextIO | None = None) -> None:
        super().__init__()
        self._stream = stream or sys.stdout
        self._last = 0.0

    def _send(self, **event: Any) -> None:
        _tell(self._stream, json.dumps(event))

    def _show_stage(self) -> None:
        self._last = 0.0
        self._send(type="stage", name=self._stage, total=self._total, done=self._done)

    def _show_progress(self, figures: dict[str, float]) -> None:
        now = time.monotonic()
        if self._done < self._total and now - self._last < 0.1:
            return
        self._last = now
        left = self.left_s
        self._send(type="progress", stage=self._stage, done=self._done, total=self._total,
                   left_s=None if left is None else round(left, 1), figures=figures)

    def say(self, text: str) -> None:
        self._send(type="say", text=text)

    def result(self, **data: Any) -> None:
        self._send(type="result", data=data)

    def error(self, text: str) -> None:
        self._send(type="error", text=text)


class OpenJdProgress(Progress):
    """Lines of the Open Job Description on stdout: openjd_progress (per cent), openjd_status, openjd_fail.

    At most one progress line a second, and each per cent once.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        super().__init__()
        self._stream = stream or sys.stdout
        self._shown = -1
        self._last = 0.0

    def _line(self, kind: str, text: str) -> None:
        _tell(self._stream, f"openjd_{kind}: {' '.join(text.split())}")

    def _show_stage(self) -> None:
        self._shown, self._last = -1, 0.0
        self._line("status", f"{self._stage} {self._done}/{self._total}")
        self._show_progress({})

    def _show_progress(self, figures: dict[str, float]) -> None:  # noqa: ARG002 - the base's signature
        share = int(100 * min(max(self._done / self._total, 0), 1)) if self._total > 0 else 100
        now = time.monotonic()
        if share == self._shown or (share < 100 and now - self._last < 1):
            return
        self._shown, self._last = share, now
        self._line("progress", f"{share}")

    def say(self, text: str) -> None:
        self._line("status", text)

    def error(self, text: str) -> None:
        self._line("fail", text)


@contextlib.contextmanager
def stoppable(progress: Progress) -> Iterator[Progress]:
    """Let `stop_signals` and a file where STOP_FILE says ask the work to stop at its next step."""
    with _stopped_by_file(progress), _stopped_by_signals(progress):
        yield progress


@contextlib.contextmanager
def _stopped_by_file(progress: Progress) -> Iterator[Progress]:
    named = os.environ.get(STOP_FILE)
    if not named:
        yield progress
        return
    file, ended = Path(named), threading.Event()

    def look() -> None:
        while not ended.wait(STOP_FILE_EVERY_S):
            if file.exists():
                progress.request_stop()
                return

    watcher = threading.Thread(target=look, daemon=True)
    watcher.start()
    try:
        yield progress
    finally:
        ended.set()
        watcher.join()


def stop_signals() -> list[int]:
    """SIGINT, SIGTERM, (Windows) CTRL_BREAK; and where the system has it SIGHUP, of a terminal that is gone, unless
    nohup has it ignored."""
    names = ("SIGINT", "SIGTERM", "SIGBREAK", "SIGHUP")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    return [number for number in numbers if not is_hangup(number) or signal.getsignal(number) is not signal.SIG_IGN]


def is_hangup(number: int) -> bool:
    """Whether a signal says that the terminal is gone."""
    return number == getattr(signal, "SIGHUP", None)


@contextlib.contextmanager
def _stopped_by_signals(progress: Progress) -> Iterator[Progress]:
    """Only the main thread may set signal handlers; elsewhere this changes nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield progress
        return
    before = {number: signal.getsignal(number) for number in stop_signals()}

    def ask(number: int, _frame: Any) -> None:
        progress.request_stop()
        # A second signal gets the system's own, immediate, answer. That a terminal is gone both the system and the
        # shell tell.
        signal.signal(number, signal.SIG_IGN if is_hangup(number) else signal.SIG_DFL)

    for number in before:
        signal.signal(number, ask)
    try:
        yield progress
    finally:
        for number, handler in before.items():
            # None is a handler that Python did not set (Blender's own) and cannot set again.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
