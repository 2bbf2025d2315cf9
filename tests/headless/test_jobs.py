# SPDX-License-Identifier: GPL-3.0-or-later
"""Splitting frames among processes, and the errors of processes that failed."""
from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

import pytest
from fit_flare.core.errors import Cancelled, EngineError, FitFlareError, SettingsError
from fit_flare.core.system.progress import Progress
from fit_flare.headless import hand_off, jobs

PROCESS = """
import json, os, sys
word = sys.argv[sys.argv.index("--frames") + 1]
if word == "bad":
    print(json.dumps({"type": "error", "text": "Frame 7 is damaged."}))
    sys.exit(1)
if word.startswith("status"):
    print(json.dumps({"type": "error", "text": "The words are no good."}))
    sys.exit(int(word[len("status "):]))
if word == "home":
    sys.exit(os.environ.get("PYTHONPATH", "nowhere"))
if word == "killed":
    os._exit(9)
if word == "sleep":
    import time
    time.sleep(60)
    open(os.path.join(os.path.dirname(__file__), "slept"), "w").close()
if word == "threads":
    sys.exit(f"{os.environ['OMP_NUM_THREADS']} and {os.environ['NUMBA_NUM_THREADS']}")
if word == "loud":
    sys.exit("Bus error at 0x0")
if word == "recorded":
    with open(__file__ + ".json", "w") as record:
        json.dump(sys.argv[1:], record)
"""


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of run.py one that fails as its frames say."""
    (tmp_path / "run.py").write_text(PROCESS, encoding="utf-8")
    monkeypatch.setattr(hand_off, "RUN_SCRIPT", tmp_path / "run.py")


def run(*frames: str) -> None:
    args = argparse.Namespace(argv=["remove"])
    parts = [["--frames", word] for word in frames]
    jobs.run_parts(args, "remove", parts, len(parts), len(parts), Progress(), continue_on_failure=True)


@pytest.mark.parametrize(("numbers", "count", "expected"), [
    ([5, 1, 2, 3], 2, ["1-2", "3,5"]), ([4, 4], 3, ["4"]), ([], 2, []),
])
def test_frames_are_split_into_contiguous_ranges(numbers: list[int], count: int, expected: list[str]) -> None:
    assert jobs.split_frames(numbers, count) == expected
    with pytest.raises(SettingsError, match="--jobs 0"):
        jobs.split_frames(numbers, 0)


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system gives no process a part of its cores")
@pytest.mark.usefixtures("program")
def test_processes_share_the_available_cores(monkeypatch: pytest.MonkeyPatch,
                                             capfd: pytest.CaptureFixture[str]) -> None:
    """Of a large machine a farm's slot is a part, and threads for all of it would wait for each other."""
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(4)))
    with pytest.raises(EngineError):
        run("threads", "fine")
    assert "2 and 2" in capfd.readouterr().err


@pytest.mark.usefixtures("program")
def test_names_after_the_end_of_options_stay_names() -> None:
    words = argparse.Namespace(argv=["remove", "--", "bad", "--frames"])
    jobs.run_parts(words, "remove", [["--frames", "recorded"]], 1, 1, Progress(), continue_on_failure=True)
    args = json.loads(Path(f"{hand_off.RUN_SCRIPT}.json").read_text(encoding="utf-8"))
    assert args == ["remove", "--step", "remove", "--frames", "recorded", "--progress", "json", "--", "bad", "--frames"]


@pytest.mark.usefixtures("program")
def test_every_failed_process_is_reported_also_without_a_message(capfd: pytest.CaptureFixture[str]) -> None:
    run("fine", "fine")
    with pytest.raises(FitFlareError) as problem:
        run("bad", "fine", "bad")
    assert str(problem.value) == "Frame 7 is damaged."
    with pytest.raises(EngineError) as problem:
        run("bad", "killed")
    assert str(problem.value) == ("Frame 7 is damaged. 1 of 2 processes of remove ended without a message, status "
                                  "9; memory may have been short.")
    with pytest.raises(EngineError, match="status 1; the end of one log is above"):
        run("loud", "fine")
    assert "Bus error at 0x0" in capfd.readouterr().err


@pytest.mark.parametrize(("frames", "error"), [
    (["status 2", "fine"], SettingsError), (["status 130", "status 130"], Cancelled), (["status 1"], FitFlareError),
    (["status 2", "status 1"], FitFlareError),
])
@pytest.mark.usefixtures("program")
def test_several_failed_processes_raise_the_error_of_one(frames: list[str], error: type[FitFlareError]) -> None:
    with pytest.raises(FitFlareError, match=r"^The words are no good\.$") as problem:
        run(*frames)
    assert type(problem.value) is error


@pytest.mark.usefixtures("program")
def test_children_do_not_import_modules_of_this_process(monkeypatch: pytest.MonkeyPatch,
                                                        capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("PYTHONPATH", "/of/blender")
    with pytest.raises(EngineError):
        run("home")
    assert capfd.readouterr().err.strip() == "nowhere"


@pytest.mark.usefixtures("program")
def test_a_python_that_cannot_start_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(jobs.sys, "executable", str(tmp_path / "python"))
    with pytest.raises(EngineError, match="cannot be started"):
        run("fine", "fine")


@pytest.mark.usefixtures("program")
def test_a_failed_process_stops_the_others(tmp_path: Path) -> None:
    args, began = argparse.Namespace(argv=["bake"]), time.monotonic()
    with pytest.raises(FitFlareError, match=r"^Frame 7 is damaged\.$"):
        jobs.run_parts(args, "bake", [["--frames", "sleep"], ["--frames", "bad"]], 2, 2, Progress())
    assert time.monotonic() - began < 30
    assert not (tmp_path / "slept").exists()
