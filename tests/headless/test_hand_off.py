# SPDX-License-Identifier: GPL-3.0-or-later
"""The order in which engine and Blender are searched, and what is forwarded between two processes."""
from __future__ import annotations

import os
import queue
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from fit_flare.core.errors import Cancelled, EngineError, FitFlareError, SettingsError
from fit_flare.core.system.processes import child_environment
from fit_flare.core.system.progress import Progress, stop_on_request
from fit_flare.headless import hand_off
from fit_flare.headless.child import Child, EventQueue, next_event

HERE = [sys.executable, str(hand_off.RUN_SCRIPT)]


class RecordingProgress(Progress):
    """Remembers what was shown."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[Any] = []

    def say(self, text: str) -> None:
        self.lines.append(text)

    def _show_stage(self) -> None:
        self.lines.append((self._stage, self._total, self._done))

    def _show_progress(self, figures: dict[str, float]) -> None:
        self.lines.append((self._done, figures))


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """No variables, nothing on the PATH, and a repository without an environment; its folder."""
    for name in ("FIT_FLARE_ENGINE", "FIT_FLARE_BLENDER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(hand_off, "ROOT", tmp_path / "repository")
    monkeypatch.setattr(hand_off, "_default_locations", lambda: iter(()))
    return tmp_path / "repository"


def without(monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    find = hand_off.importlib.util.find_spec
    monkeypatch.setattr(hand_off.importlib.util, "find_spec", lambda name: None if name == package else find(name))


# ---- who ------------------------------------------------------------------------------------------


@pytest.fixture
def torchless(tmp_path: Path) -> Path:
    """A Python without torch, as a virtual environment's folder."""
    place = tmp_path / "torchless"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(place)], check=True)
    return place


def test_the_engine_is_looked_for_in_order(bare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(EngineError, match="press Set Up Engine"):  # the extension has no Makefile
        hand_off.engine_command(None)
    bare.mkdir()
    (bare / "Makefile").touch()
    with pytest.raises(EngineError, match="make setup"):
        hand_off.engine_command(None)
    environment = Path(sys.prefix)
    (bare.parent / ".venv").symlink_to(environment, target_is_directory=True)
    beside = hand_off.engine_command(None)
    assert beside[0].startswith(str(bare.parent / ".venv"))
    (bare / ".venv").symlink_to(environment, target_is_directory=True)
    assert hand_off.engine_command(None)[0].startswith(str(bare / ".venv"))
    monkeypatch.setattr(hand_off, "_engine_in_preferences", lambda: sys.executable)
    assert hand_off.engine_command(None) == HERE
    monkeypatch.setenv("FIT_FLARE_ENGINE", str(bare / ".venv"))
    assert hand_off.engine_command(None)[0].startswith(str(bare / ".venv"))
    assert hand_off.engine_command(sys.executable) == HERE


def test_a_named_engine_must_have_torch(bare: Path, torchless: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for place in (torchless, bare / "nowhere"):
        with pytest.raises(EngineError, match="--engine names"):
            hand_off.engine_command(str(place))
    monkeypatch.setenv("FIT_FLARE_ENGINE", str(torchless))
    with pytest.raises(EngineError, match="FIT_FLARE_ENGINE names"):
        hand_off.engine_command(None)


@pytest.mark.usefixtures("bare")
def test_blender_is_looked_for_in_order(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    without(monkeypatch, "bpy")
    with pytest.raises(EngineError, match="--blender"):
        hand_off.blender_command(None)
    program = tmp_path / ("blender.exe" if os.name == "nt" else "blender")
    shutil.copy(sys.executable, program)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert Path(hand_off.blender_command(None)[0]).samefile(program)
    monkeypatch.setattr(hand_off.importlib.util, "find_spec", lambda _name: object())
    assert hand_off.blender_command(None) == HERE
    monkeypatch.setenv("FIT_FLARE_BLENDER", "blender --gpu-backend opengl")
    words = hand_off.blender_command(None)
    assert words[:4] == ["blender", "--gpu-backend", "opengl", "-b"]
    assert words[-2:] == [str(hand_off.RUN_SCRIPT), "--"]
    assert hand_off.blender_command(str(program))[0] == str(program)
    with pytest.raises(EngineError, match="--blender names"):
        hand_off.blender_command("no-such-blender -x")


@pytest.mark.parametrize("on_windows", [True, False])
def test_a_blender_in_a_folder_with_spaces(on_windows: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A path of Blender may contain spaces; with further arguments it has to be quoted."""
    monkeypatch.setattr(hand_off, "WINDOWS", on_windows)
    program = tmp_path / "Program Files" / "blender.exe"
    program.parent.mkdir()
    shutil.copy(sys.executable, program)
    for text, args in ((str(program), []), (f'"{program}"', []), (f'"{program}" --threads 2', ["--threads", "2"])):
        assert hand_off.blender_command(text)[:1 + len(args)] == [str(program), *args]
    with pytest.raises(EngineError, match="is not a program"):
        hand_off.blender_command(f'"{program} --threads 2')


def test_a_process_has_one_side() -> None:
    """This process is the engine's side and has not imported Blender."""
    assert hand_off.current_side() == "engine"
    assert "bpy" not in sys.modules


# ---- how ------------------------------------------------------------------------------------------


def child(tmp_path: Path, code: str) -> list[str]:
    script = tmp_path / "child.py"
    script.write_text("import json, os, signal, sys, time\n"
                      "def tell(**event): print(json.dumps(event), flush=True)\n" + code)
    return [sys.executable, str(script)]


def test_events_of_the_child_are_forwarded(tmp_path: Path) -> None:
    heard = RecordingProgress()
    code = ("print('Blender 9.9')\n"
            "tell(type='stage', name='bake', total=5, done=2)\n"
            "tell(type='progress', done=4, total=5, figures={'loss': 0.5})\n"
            "print('{not an event}')\n"
            "tell(type='say', text='äh')\n"
            "tell(type='result', data={'words': sys.argv[1:]})\n")
    result = hand_off.run_in_child(child(tmp_path, code), ["demo", "--out", "a b"], "frames", heard)
    assert result == {"words": ["demo", "--out", "a b", "--step", "frames", "--progress", "json"]}
    assert heard.lines == [("bake", 5, 2), (4, {"loss": 0.5}), "äh"]


@pytest.mark.parametrize(("status", "error"), [(1, FitFlareError), (2, SettingsError), (130, Cancelled)])
def test_the_error_of_the_child_is_raised(tmp_path: Path, status: int, error: type[FitFlareError]) -> None:
    code = f"tell(type='error', text='The lamp is broken.')\nsys.exit({status})"
    with pytest.raises(FitFlareError, match=r"^The lamp is broken\.$") as problem:
        hand_off.run_in_child(child(tmp_path, code), [], "x", RecordingProgress())
    assert type(problem.value) is error


def test_options_are_added_before_the_end_of_options(tmp_path: Path) -> None:
    """Behind "--" all words are names of files."""
    code = "tell(type='result', data={'words': sys.argv[1:]})\n"
    result = hand_off.run_in_child(child(tmp_path, code), ["remove", "--out", "o", "--", "-a.png"], "remove",
                                    RecordingProgress())
    assert result["words"] == ["remove", "--out", "o", "--step", "remove", "--progress", "json", "--", "-a.png"]


def test_a_crash_of_the_child_is_reported_with_the_end_of_its_log(tmp_path: Path,
                                                                  capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(EngineError, match="status 9"):
        hand_off.run_in_child(child(tmp_path, "print('boom', file=sys.stderr)\nsys.exit(9)"), [], "x",
                              RecordingProgress())
    assert "boom" in capsys.readouterr().err


def test_a_program_that_cannot_start_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(EngineError, match="cannot be started"):
        hand_off.run_in_child([str(tmp_path / "nothing")], [], "x", RecordingProgress())


def test_waiting_for_an_event_can_be_stopped(tmp_path: Path) -> None:
    """On Windows no signal gets through to who reads from a pipe."""
    event_queue: EventQueue = queue.Queue()
    code = ("import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"  # also where it is ignored here
            "tell(type='say', text='here')\ntime.sleep(60)")
    silent = Child(child(tmp_path, code), child_environment(), event_queue)
    while next_event(event_queue) is None:
        pass
    assert next_event(event_queue) is None
    silent.interrupt()
    silent.wait_or_kill()
    assert next_event(event_queue) == (silent, None)
    assert silent.status != 0


@pytest.mark.skipif(os.name == "nt", reason="signals to oneself end the process on Windows")
@pytest.mark.parametrize("numbers", [["SIGTERM"], ["SIGHUP", "SIGHUP"], ["SIGTERM", "SIGHUP"]])
@pytest.mark.usefixtures("hangups_are_heard")
def test_a_stop_reaches_the_child_which_ends_by_itself(tmp_path: Path, numbers: list[str]) -> None:
    """Once: a second one would end it before it has saved."""
    code = ("def stop(*_):\n"
            "    signal.signal(signal.SIGINT, signal.SIG_DFL)\n"
            "    time.sleep(0.3)\n"
            "    tell(type='say', text='saving')\n"
            "    open(sys.argv[1], 'w').write('whole')\n"
            "    tell(type='error', text='Stopped.')\n"
            "    sys.exit(130)\n"
            "signal.signal(signal.SIGINT, stop)\n"
            "tell(type='stage', name='fit', total=5, done=0)\n"
            # In short pieces: a signal that comes just before a sleep is heard only after it.
            "for _ in range(300):\n"
            "    time.sleep(0.1)\n")

    class Stopping(RecordingProgress):
        def _show_stage(self) -> None:
            for number in numbers:
                os.kill(os.getpid(), getattr(signal, number))

    heard, began = Stopping(), time.monotonic()
    with pytest.raises(Cancelled), stop_on_request(heard):
        hand_off.run_in_child(child(tmp_path, code), [str(tmp_path / "saved")], "x", heard)
    assert (tmp_path / "saved").read_text() == "whole"
    assert heard.lines == ["saving"]
    assert time.monotonic() - began < 10


@pytest.mark.skipif(os.name == "nt", reason="the test looks for the process by its number")
def test_no_child_is_left_when_the_parent_fails(tmp_path: Path) -> None:
    class Failing(RecordingProgress):
        def say(self, text: str) -> None:
            raise BrokenPipeError(text)

    code = "tell(type='say', text=str(os.getpid()))\ntime.sleep(30)\n"
    with pytest.raises(BrokenPipeError) as problem:
        hand_off.run_in_child(child(tmp_path, code), [], "x", Failing())
    with pytest.raises(ProcessLookupError):
        os.kill(int(str(problem.value)), 0)
