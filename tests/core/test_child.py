# SPDX-License-Identifier: GPL-3.0-or-later
"""A function in a child process: result, exceptions, progress and stops as in a call; its death is caught."""
from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from core.capture.solve import SolveSettings, solve
from core.errors import Cancelled, CaptureError
from core.system.child import ChildDied, run_in_child
from core.system.progress import Progress
from tests.core.recording_progress import RecordingProgress


def work(number: int, progress: Progress) -> np.ndarray:  # type: ignore[type-arg]
    print("what a library prints")
    progress.stage("count", number)
    for _ in range(number):
        progress.advance(1, loss=0.5)
    progress.say("counted")
    return np.arange(number)


def fail(kind: str, progress: Progress) -> None:
    progress.stage("write features", 3)
    if kind == "abort":
        os.abort()
    if kind == "exit":
        os._exit(3)
    raise CaptureError("nothing to see")


def wait_for_ever(file: str, _progress: Progress) -> None:
    Path(file).write_text(str(os.getpid()))
    while True:
        time.sleep(0.05)


def test_a_child_returns_and_reports_as_a_call() -> None:
    heard = RecordingProgress()
    assert run_in_child(work, 4, progress=heard).tolist() == [0, 1, 2, 3]
    assert heard.stage_name == "count"


def test_an_exception_of_the_child_is_raised() -> None:
    with pytest.raises(CaptureError, match="nothing to see"):
        run_in_child(fail, "error", progress=Progress())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has other statuses")
@pytest.mark.parametrize(("kind", "how"), [("abort", "SIGABRT"), ("exit", "status 3")])
def test_the_death_of_the_child_is_caught(kind: str, how: str) -> None:
    with pytest.raises(ChildDied, match=f"write features, {how}"):
        run_in_child(fail, kind, progress=Progress())


def test_a_stop_request_ends_the_child() -> None:
    progress = Progress()
    progress.request_stop()
    with pytest.raises(Cancelled, match="during count"):
        run_in_child(work, 4, progress=progress)


def test_what_progress_raises_is_raised() -> None:
    class Deaf(Progress):
        def advance(self, steps: int = 1, **figures: float) -> None:  # noqa: ARG002
            raise OSError("nobody listens")

    with pytest.raises(OSError, match="nobody listens"):
        run_in_child(work, 4, progress=Deaf())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no fork")
def test_the_child_of_a_killed_process_ends(tmp_path: Path) -> None:
    file = tmp_path / "pid"
    parent = os.fork()
    if not parent:
        run_in_child(wait_for_ever, str(file), progress=Progress())
        os._exit(0)
    end = time.monotonic() + 60
    while not (file.is_file() and file.read_text()) and time.monotonic() < end:
        time.sleep(0.05)
    os.kill(parent, signal.SIGKILL)
    os.waitpid(parent, 0)
    child = int(file.read_text())
    while Path(f"/proc/{child}").exists() and time.monotonic() < end:
        time.sleep(0.05)
    assert not Path(f"/proc/{child}").exists() or Path(f"/proc/{child}/stat").read_text().split(") ")[1][0] == "Z"


def test_a_solve_whose_library_aborts_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.core.captures import orbit
    from tests.core.test_solve import SIZE, shoot

    monkeypatch.setattr("core.capture.solve.mapping.solve", abort_instead)
    with pytest.raises(CaptureError, match=r"disk of .* is full or fails"):
        solve(shoot(tmp_path / "frames", orbit(4, size=SIZE, arc=0.4)), tmp_path / "out")


def test_an_error_of_the_library_is_a_sentence(tmp_path: Path) -> None:
    from core.capture.solve import mapping

    pycolmap, progress, database = mapping.load_pycolmap(), Progress(), tmp_path / "database.db"
    progress.stage("match frames", 1)
    database.write_bytes(b"no database" * 1000)
    with (pytest.raises(CaptureError, match=r'failed at the step "match frames" \(.*\); mostly the disk of .* is full'),
          mapping._report_library_errors(tmp_path, progress), mapping._open_database(pycolmap, database)):
        pass
    (tmp_path / mapping.MODELS_FILE).write_text('["0"]')
    with (pytest.raises(CaptureError, match=r"\(\[reconstruction\.cc"),
          mapping._report_library_errors(tmp_path, progress)):
        mapping._run_mapper(pycolmap, tmp_path, database, 4, SolveSettings(), progress)
    with pytest.raises(ValueError, match="not a colour"), mapping._report_library_errors(tmp_path, progress):
        raise ValueError("not a colour")


def abort_instead(*_: object) -> None:
    os.abort()
