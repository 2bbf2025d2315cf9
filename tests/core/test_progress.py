# SPDX-License-Identifier: GPL-3.0-or-later
"""Progress speaks JSON by the line, and a stop is heard at the next step."""
from __future__ import annotations

import errno
import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from core.errors import Cancelled
from core.system.progress import (
    STOP_FILE,
    JsonProgress,
    OpenJdProgress,
    Progress,
    TerminalProgress,
    flush_or_drop,
    stop_on_request,
)

ROOT = Path(__file__).resolve().parents[2]


def test_json_lines_are_whole_and_in_order() -> None:
    stream = io.StringIO()
    progress = JsonProgress(stream)
    progress.stage("fit", 3)
    for _ in range(3):
        progress.advance(loss=0.5)
    progress.say("done")
    progress.result(run="a")
    events = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert events[0]["type"] == "stage"
    assert events[-1] == {"type": "result", "data": {"run": "a"}}
    last = [event for event in events if event["type"] == "progress"][-1]
    assert (last["done"], last["total"], last["eta_s"]) == (3, 3, 0.0)


def test_terminal_progress_writes_to_a_plain_stream() -> None:
    stream = io.StringIO()
    progress = TerminalProgress(stream)
    progress.stage("bake", 2)
    progress.advance(2, loss=1.0)
    progress.say("a sentence")
    progress.error("wrong")
    assert "bake" in stream.getvalue()
    assert "a sentence" in stream.getvalue()
    assert "error: wrong" in stream.getvalue()


def test_a_stop_request_ends_the_work_at_the_next_step() -> None:
    progress = Progress()
    progress.stage("fit", 5)
    progress.advance()
    progress.request_stop()
    with pytest.raises(Cancelled, match="fit"):
        progress.advance()


class FullDisk(io.StringIO):
    """A stream whose disk takes no more."""

    def flush(self) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class Gone(io.StringIO):
    """A stream that nobody reads any more."""

    def flush(self) -> None:
        raise BrokenPipeError


@pytest.mark.parametrize("kind", [JsonProgress, OpenJdProgress, TerminalProgress])
def test_progress_on_a_full_disk_does_not_end_the_work(kind: type[Progress]) -> None:
    progress = kind(FullDisk())
    progress.stage("fit", 2)
    progress.advance(2)
    progress.say("Half of it.")
    progress.error("The disk is full.")
    with pytest.raises(BrokenPipeError):
        kind(Gone()).say("hello")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a disk that is always full")
def test_output_that_a_full_disk_refuses_is_dropped() -> None:
    stream = open("/dev/full", "w")  # noqa: SIM115 - closed below, which tries what is left in it again
    stream.write("a line")
    flush_or_drop(stream)
    with pytest.raises(OSError, match="No space"):
        os.write(stream.fileno(), b"it leads where it led")
    stream.close()


@pytest.mark.parametrize("number", [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP")
                                    if hasattr(signal, name)])
@pytest.mark.usefixtures("hangups_are_heard")
def test_signals_request_a_stop_and_handlers_are_restored(number: int) -> None:
    before = signal.getsignal(number)
    progress = Progress()
    with stop_on_request(progress):
        os.kill(os.getpid(), number)
        with pytest.raises(Cancelled):
            progress.advance()
    assert signal.getsignal(number) is before


ON_A_TERMINAL = """
import fcntl, sys, termios, time
from pathlib import Path
from core.errors import Cancelled
from core.system.progress import TerminalProgress, flush_or_drop, stop_on_request

fcntl.ioctl(0, termios.TIOCSCTTY, 0)
progress = TerminalProgress()
try:
    with stop_on_request(progress):
        progress.stage("fit", 10**9)
        while True:
            progress.say("a step")
            progress.advance()
            time.sleep(0.01)
except Cancelled as stop:
    progress.error(str(stop))
    flush_or_drop(sys.stderr)
    Path(sys.argv[1]).write_text("whole")
"""


@pytest.mark.skipif(not hasattr(os, "openpty") or sys.platform == "darwin", reason="of Linux's terminals")
@pytest.mark.usefixtures("hangups_are_heard")
def test_a_closed_terminal_stops_the_work(tmp_path: Path) -> None:
    ours, theirs = os.openpty()
    args = [sys.executable, "-c", ON_A_TERMINAL, str(tmp_path / "saved")]
    with subprocess.Popen(args, cwd=ROOT, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True) as work:
        os.close(theirs)
        try:
            while b"a step" not in os.read(ours, 1000):
                pass
            os.close(ours)
            assert work.wait(20) == 0
        finally:
            work.kill()
    assert (tmp_path / "saved").read_text() == "whole"


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="Windows has no such signal")
@pytest.mark.usefixtures("hangups_are_heard")
def test_a_hangup_may_repeat_and_is_ignored_under_nohup() -> None:
    progress = Progress()
    with stop_on_request(progress):
        os.kill(os.getpid(), signal.SIGHUP)
        os.kill(os.getpid(), signal.SIGHUP)
        with pytest.raises(Cancelled):
            progress.check()
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_request(progress := Progress()):
            os.kill(os.getpid(), signal.SIGHUP)
            progress.check()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_openjd_lines_follow_the_specification() -> None:
    stream = io.StringIO()
    progress = OpenJdProgress(stream)
    progress.stage("bake", 4)
    progress.advance(4)
    progress.say("two\nlines")
    progress.result(layers="a")
    progress.error("It failed.")
    assert stream.getvalue().splitlines() == [
        "openjd_status: bake 0/4", "openjd_progress: 0", "openjd_progress: 100", "openjd_status: two lines",
        "openjd_fail: It failed."]


@pytest.mark.parametrize("of_main_thread", [True, False])
def test_a_stop_file_ends_the_work(of_main_thread: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(STOP_FILE, str(tmp_path / "stop"))
    monkeypatch.setattr("core.system.progress.STOP_FILE_INTERVAL_S", 0.01)
    stopped: list[str] = []

    def work() -> None:
        """Work with a stop file in place; note the message of the cancellation in `stopped`."""
        progress = Progress()
        try:
            with stop_on_request(progress):
                progress.stage("fit", 1000)
                (tmp_path / "stop").touch()
                for _ in range(1000):
                    progress.advance()
                    time.sleep(0.01)
        except Cancelled as stop:
            stopped.append(str(stop))

    before = threading.active_count()
    if of_main_thread:
        work()
    else:
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert stopped == ["Stopped during fit as requested; what is done is kept."]
    assert threading.active_count() == before, "who looked has gone"


class Clock:
    """A clock in place of the time module's; the test moves it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        monkeypatch.setattr("core.system.progress.time.monotonic", lambda: self.now)

    def left_after(self, progress: Progress, seconds: float, steps: int = 1) -> float | None:
        self.now += seconds
        progress.advance(steps)
        return progress.eta_s


def test_the_eta_of_resumed_work_counts_new_steps_only(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, progress = Clock(monkeypatch), Progress()
    progress.stage("fit", 1000, 900)
    assert progress.eta_s is None
    assert clock.left_after(progress, 40) is None, "the first step says little"
    assert clock.left_after(progress, 50, 50) == pytest.approx(49)
    assert clock.left_after(progress, 50, 49) == 0


def test_the_eta_ignores_the_first_step_and_old_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, progress = Clock(monkeypatch), Progress()
    progress.stage("fit", 1000)
    assert clock.left_after(progress, 20) is None, "compiling"
    assert clock.left_after(progress, 0.5) is None
    for _ in range(20):
        left = clock.left_after(progress, 0.1)
    assert left == pytest.approx(2.5 / 21 * 978)
    for _ in range(400):
        left = clock.left_after(progress, 0.3)
    assert left == pytest.approx(0.3 * 578, rel=0.01), "it goes slower now"
    progress.stage("eval", 10)
    assert progress.eta_s is None


def test_the_eta_ignores_steps_that_end_together(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, progress = Clock(monkeypatch), Progress()
    progress.stage("clean", 64)
    lefts = [clock.left_after(progress, 0.01 if number % 16 else 5) for number in range(48)]
    assert not any(lefts[:16]), "not before others end"
    for number, left in enumerate(lefts[16:], 17):
        assert left is not None
        assert 0.5 < left / (5 * (64 - number) / 16) <= 1.1, (number, left)
