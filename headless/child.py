# SPDX-License-Identifier: GPL-3.0-or-later
"""One of our commands as a child process, started with `--progress json`: its events, its stop and its outcome.

`hand_off` starts one child for a step, `jobs` several; these share one event queue.
"""
from __future__ import annotations

import contextlib
import json
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..core.errors import Cancelled, EngineError, FitFlareError, SettingsError
from ..core.system.processes import STOPPED, USAGE_ERROR, new_process_group

KILL_AFTER_S = 60.0  # from an interrupt, for the process to write its state
POLL_S = 0.2
LOG_TAIL_LINES = 40

Event = dict[str, Any]
EventQueue = queue.Queue[tuple["Child", Event | None]]
"""Events of children in the order of their arrival; None marks the last one of a child."""


class Child:
    """A child process. error_text: the message of its error event, "" while there is none. log_tail: the last lines
    that it wrote to standard error, once it has ended."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str],
                 event_queue: EventQueue | None = None) -> None:
        """Start the process. Raises EngineError where the system cannot start it."""
        self.name, self.error_text, self.log_tail = Path(command[0]).name, "", ""
        self._event_queue: EventQueue = queue.Queue() if event_queue is None else event_queue
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the process has ended
        try:
            self._process = subprocess.Popen(list(command), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                             stderr=self._stderr, env=environment, encoding="utf-8", errors="replace",
                                             **new_process_group())
        except OSError as problem:
            self._stderr.close()
            raise EngineError(f"{command[0]} cannot be started ({problem.strerror or problem}).") from problem
        threading.Thread(target=self._read_events, daemon=True).start()

    @property
    def status(self) -> int | None:
        """The exit status; None while the process runs."""
        return self._process.poll()

    def events(self) -> Iterator[Event]:
        """Yield the events until the process ends; only for a child with an event queue of its own."""
        while True:
            arrival = next_event(self._event_queue)
            if arrival is not None:
                _, event = arrival
                if event is None:
                    return
                yield event

    def interrupt(self) -> None:
        """Ask the process to stop; the second call ends it at once."""
        with contextlib.suppress(OSError):
            self._process.send_signal(getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT))

    def wait_or_kill(self) -> None:
        """Wait for the process to end, and kill it after `KILL_AFTER_S`; then keep the end of its log in `log_tail`."""
        deadline = time.monotonic() + KILL_AFTER_S
        while self.status is None:
            if time.monotonic() > deadline:
                self._process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(POLL_S)
        if not self._stderr.closed:
            self._stderr.seek(0)
            lines = self._stderr.read().decode("utf-8", "replace").splitlines(keepends=True)
            self.log_tail = "".join(lines[-LOG_TAIL_LINES:])
            self._stderr.close()

    def to_error(self) -> FitFlareError:
        """Return the error that the exit status stands for, with the message of the error event."""
        return {STOPPED: Cancelled, USAGE_ERROR: SettingsError}.get(self.status or 0, FitFlareError)(self.error_text)

    def _read_events(self) -> None:
        """Queue the events, in a thread, since on Windows Ctrl-C does not interrupt reading from a pipe."""
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                event = _parse_event(line)
                if event.get("type") == "error":
                    self.error_text = str(event.get("text", ""))
                if event:
                    self._event_queue.put((self, event))
        self._event_queue.put((self, None))


def next_event(event_queue: EventQueue) -> tuple[Child, Event | None] | None:
    """Return the next child and event; None after `POLL_S` without any.

    The wait is bounded because Windows delivers Ctrl-C only between two waits.
    """
    try:
        return event_queue.get(timeout=POLL_S)
    except queue.Empty:
        return None


def _parse_event(line: str) -> Event:
    """Parse one line of output as an event; return {} for any other text."""
    if not line.startswith("{"):
        return {}
    try:
        event = json.loads(line)
    except ValueError:
        return {}
    return event if isinstance(event, dict) else {}


def combined_error(failed: Sequence[Child], count: int, step: str) -> FitFlareError:
    """Return one error for the processes that failed, out of `count` of a step, with the message of each.

    step: the step's name. The error has the type that all their errors share, else it is a FitFlareError. Where some
    processes ended without a message it is an EngineError that counts them, and the end of one's log is written to
    standard error.
    """
    problems = [child.to_error() for child in failed if child.error_text]
    messages = list(dict.fromkeys(map(str, problems)))
    if silent := [child for child in failed if not child.error_text]:
        log_tail = silent[0].log_tail
        sys.stderr.write(log_tail)
        subject = f"{len(silent)} of {count} processes of {step}" if count > 1 else f"{silent[0].name}, for {step},"
        statuses = ", ".join(str(child.status) for child in silent)
        log_hint = "the end of one log is above" if count > 1 else "the end of its log is above"
        messages.append(f"{subject} ended without a message, status {statuses}; "
                        f"{log_hint if log_tail else 'memory may have been short'}.")
        return EngineError(" ".join(messages))
    error_types = {type(problem) for problem in problems}
    return (error_types.pop() if len(error_types) == 1 else FitFlareError)(" ".join(messages))
