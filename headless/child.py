# SPDX-License-Identifier: GPL-3.0-or-later
"""A command of ours in a process of its own, started with `--progress json`: its events, its stop, and what became of
it. Whoever starts several hears them all in one inbox."""
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
from ..core.system.processes import MISUSED, STOPPED, own_group

PATIENCE_S = 60.0  # for a stopped process to write what it must
POLL_S = 0.2
LAST_WORDS = 40  # lines

Event = dict[str, Any]
Inbox = queue.Queue[tuple["Child", Event | None]]
"""What children tell, in the order that it comes; None when one has told all."""


class Child:
    """told: the sentence of its error, "" while it has none. last_words: of a child that has ended, what else it wrote.
    """

    def __init__(self, command: Sequence[str], environment: Mapping[str, str], inbox: Inbox | None = None) -> None:
        """Start it. Raises EngineError where the system does not."""
        self.name, self.told, self.last_words = Path(command[0]).name, "", ""
        self._inbox: Inbox = queue.Queue() if inbox is None else inbox
        self._noise = tempfile.TemporaryFile()  # noqa: SIM115 - closed when the process has ended
        try:
            self._process = subprocess.Popen(list(command), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                             stderr=self._noise, env=environment, encoding="utf-8", errors="replace",
                                             **own_group())
        except OSError as problem:
            self._noise.close()
            raise EngineError(f"{command[0]} cannot be started ({problem.strerror or problem}).") from problem
        threading.Thread(target=self._listen, daemon=True).start()

    @property
    def status(self) -> int | None:
        """None while it runs."""
        return self._process.poll()

    def events(self) -> Iterator[Event]:
        """What it tells, to its end; of one that has an inbox of its own."""
        while True:
            heard = next_event(self._inbox)
            if heard is not None:
                if heard[1] is None:
                    return
                yield heard[1]

    def interrupt(self) -> None:
        """Ask it to stop. A second time ends it at once."""
        with contextlib.suppress(OSError):
            self._process.send_signal(getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT))

    def end(self) -> None:
        """Wait for it, and kill it where that takes too long."""
        until = time.monotonic() + PATIENCE_S
        while self.status is None:
            if time.monotonic() > until:
                self._process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(POLL_S)
        if not self._noise.closed:
            self._noise.seek(0)
            lines = self._noise.read().decode("utf-8", "replace").splitlines(keepends=True)
            self.last_words = "".join(lines[-LAST_WORDS:])
            self._noise.close()

    def failure(self) -> FitFlareError:
        """Its sentence, as the error that its status says."""
        return {STOPPED: Cancelled, MISUSED: SettingsError}.get(self.status or 0, FitFlareError)(self.told)

    def _listen(self) -> None:
        """In a thread, since on Windows Ctrl-C does not interrupt who reads from a pipe."""
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                event = _event(line)
                if event.get("type") == "error":
                    self.told = str(event.get("text", ""))
                if event:
                    self._inbox.put((self, event))
        self._inbox.put((self, None))


def next_event(inbox: Inbox) -> tuple[Child, Event | None] | None:
    """What one of the children tells next; None where all are silent for a moment: on Windows a stop is heard between
    two waits alone."""
    try:
        return inbox.get(timeout=POLL_S)
    except queue.Empty:
        return None


def _event(line: str) -> Event:
    """The event that a line holds; {} for the other things that programs print."""
    if not line.startswith("{"):
        return {}
    try:
        event = json.loads(line)
    except ValueError:
        return {}
    return event if isinstance(event, dict) else {}


def joint_failure(failed: Sequence[Child], count: int, step: str) -> FitFlareError:
    """One error for those of `count` processes of a step that have ended and failed, with the sentence of each; of the
    kind that they have in common. EngineError where one gave no reason; its last words are shown."""
    problems = [child.failure() for child in failed if child.told]
    told = list(dict.fromkeys(map(str, problems)))
    if silent := [child for child in failed if not child.told]:
        said = silent[0].last_words
        sys.stderr.write(said)
        who = f"{len(silent)} of {count} processes of {step}" if count > 1 else f"{silent[0].name}, for {step},"
        statuses = ", ".join(str(child.status) for child in silent)
        wrote = "what one wrote last stands above" if count > 1 else "its last words stand above"
        told.append(f"{who} ended without a reason, status {statuses}; "
                    f"{wrote if said else 'memory may have been short'}.")
        return EngineError(" ".join(told))
    kinds = {type(problem) for problem in problems}
    return (kinds.pop() if len(kinds) == 1 else FitFlareError)(" ".join(told))
