# SPDX-License-Identifier: GPL-3.0-or-later
"""Processes of an earlier session: recognised, and distinguished from others with the same numbers."""
from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from core.system import processes


@pytest.fixture(params=["this system's way", "by ps"])
def sleeper(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch,
            tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], float]]:
    """A process that sleeps, and when it was started; once with /proc, once without, as on macOS."""
    if request.param == "by ps":
        if os.name == "nt":
            pytest.skip("Windows has no ps")
        monkeypatch.setattr(processes, "PROC", tmp_path / "none")  # as on macOS
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    yield process, time.time()
    process.kill()
    process.wait()


def test_a_process_is_identified_by_id_and_start_time(sleeper: tuple[subprocess.Popen[bytes], float]) -> None:
    process, started = sleeper
    assert processes.is_running(process.pid)
    assert processes.is_same_process(process.pid, started)
    assert not processes.is_same_process(process.pid, started - 3600), "it began after that which was written down"
    assert not processes.is_same_process(process.pid, started + 3600), "it began before that which was written down"
    process.kill()
    process.wait()
    assert not processes.is_running(process.pid)
    assert not processes.is_same_process(process.pid, started)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_an_unreaped_process_does_not_run() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    time.sleep(1)  # not waited for: its number is not given out yet
    assert not processes.is_running(process.pid)
    process.wait()


def test_start_times_are_read_from_ps(monkeypatch: pytest.MonkeyPatch) -> None:
    for output, age in (("      03:07\n", 187), ("1-02:03:04", 93784), ("   12:00:00", 43200),
                      ("441077234-00:18:40\n", 0)):
        monkeypatch.setattr(processes.subprocess, "run",
                            lambda *_argv, output=output, **_options: subprocess.CompletedProcess([], 0, output))
        assert processes._start_time_ps(1) == pytest.approx(time.time() - age, abs=1)
    monkeypatch.setattr(processes.subprocess, "run", lambda *_argv, **_options: subprocess.CompletedProcess([], 1, ""))
    assert processes._start_time_ps(1) is None


def test_a_process_of_another_user_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without /proc a signal tells whether a process runs; permission denied means that it does."""
    monkeypatch.setattr(processes, "PROC", tmp_path / "none")
    monkeypatch.setattr(processes, "WINDOWS", False)
    for refused, there in ((PermissionError, True), (ProcessLookupError, False)):
        monkeypatch.setattr(processes.os, "kill", lambda *_, refused=refused: (_ for _ in ()).throw(refused))
        assert processes.is_running(1) == there


@pytest.mark.parametrize("inner", ["python.exe", "Scripts/python.exe", "bin/python"])
def test_a_python_is_found_in_an_environment_of_every_kind(inner: str, tmp_path: Path) -> None:
    assert processes.find_python(tmp_path) is None
    assert processes.find_python(tmp_path / ("x" * 300)) is None
    python = tmp_path / inner
    python.parent.mkdir(exist_ok=True)
    python.touch()
    assert processes.find_python(tmp_path) == processes.find_python(python) == python


def test_an_environment_without_its_base_has_no_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On Windows an environment's python.exe stays when the Python that it is based on is removed."""
    monkeypatch.setattr(processes, "WINDOWS", True)
    python, base = tmp_path / "engine" / "Scripts" / "python.exe", tmp_path / "Blender 5.0" / "python.exe"
    for file in (python, base):
        file.parent.mkdir(parents=True)
        file.touch()
    (tmp_path / "engine" / "pyvenv.cfg").write_text(f"include-system-site-packages = false\nhome = {base.parent} \n")
    assert processes.find_python(tmp_path / "engine") == processes.find_python(python) == python
    base.unlink()
    assert processes.find_python(tmp_path / "engine") is processes.find_python(python) is None


def test_the_machine_id_of_a_mac_is_independent_of_the_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = iter(("studio.local", "guest-17.wifi", "studio.local"))
    monkeypatch.setattr(processes.platform, "node", lambda: next(names))
    monkeypatch.setattr(processes.Path, "home", lambda: tmp_path)
    machine = processes.machine_id.__wrapped__
    assert machine() != machine(), "its name, elsewhere"
    monkeypatch.setattr(processes.sys, "platform", "darwin")
    machine_id = machine()
    assert machine_id == machine()
    assert len(machine_id) == 36
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["machine"]
    monkeypatch.setattr(processes.Path, "home", lambda: tmp_path.joinpath(*tmp_path.rglob("machine")))  # a file
    assert machine() == "studio.local"
