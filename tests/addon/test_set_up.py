# SPDX-License-Identifier: GPL-3.0-or-later
"""Setting up the engine, with a package made for the test in place of torch."""
from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
from blenders import ROOT

SCRIPT = ROOT / "headless" / "set_up.py"


def wheel(folder: Path, name: str) -> Path:
    """Write a wheel of one empty module; return its path."""
    path = folder / f"{name}-1.0-py3-none-any.whl"
    info = f"{name}-1.0.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}.py", "")
        archive.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    return path


def set_up(folder: Path, *wanted: Path) -> tuple[int, list[dict[str, Any]]]:
    done = subprocess.run([sys.executable, "-I", str(SCRIPT), str(folder), *map(str, wanted)], capture_output=True,
                          text=True, check=False)
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()]


def test_set_up_makes_an_environment_and_installs_packages(tmp_path: Path) -> None:
    (tmp_path / "engine").mkdir()
    (tmp_path / "engine" / "pyvenv.cfg").touch()
    (tmp_path / "engine" / "left").write_text("by a set-up that was stopped")
    status, events = set_up(tmp_path / "engine", wheel(tmp_path, "sham_torch"))
    assert status == 0
    assert [event["type"] for event in events if event["type"] != "say"] == ["stage", "progress", "progress", "result"]
    assert any("Installing collected packages" in event.get("text", "") for event in events)
    python = events[-1]["data"]["engine"]
    assert subprocess.run([python, "-c", "import sham_torch"], check=False).returncode == 0
    assert not (tmp_path / "engine" / "left").exists()


def test_a_failed_set_up_is_reported_and_leaves_nothing(tmp_path: Path) -> None:
    status, events = set_up(tmp_path / "engine", tmp_path / "nowhere-1.0-py3-none-any.whl")
    assert status == 1
    assert "could not be installed (" in events[-1]["text"]
    assert "nowhere-1.0" in events[-1]["text"], "what pip said"
    assert not (tmp_path / "engine").exists()


def test_a_folder_with_other_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    status, events = set_up(tmp_path, tmp_path / "nowhere-1.0-py3-none-any.whl")
    assert status == 1 and "is not a virtual environment" in events[-1]["text"]
    assert (tmp_path / "notes.txt").read_text() == "mine"


def module() -> Any:
    spec = importlib.util.spec_from_file_location("set_up", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


@pytest.mark.parametrize("alone", [True, False])
def test_weights_are_downloaded_with_the_engine_or_alone(alone: bool, tmp_path: Path) -> None:
    source, target = tmp_path / "weights of a server", tmp_path / "user" / "weights.safetensors"
    source.write_bytes(b"weights")
    arguments = ["--weights", source.as_uri(), str(target), hashlib.sha256(b"weights").hexdigest()]
    first = [] if alone else [str(tmp_path / "engine"), str(wheel(tmp_path, "sham_torch"))]
    done = subprocess.run([sys.executable, "-I", str(SCRIPT), *first, *arguments], capture_output=True, text=True,
                          check=False)
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0 and events[-1]["type"] == "result"
    assert target.read_bytes() == b"weights"
    assert [event["done"] for event in events if event["type"] == "progress"][-1] == events[0]["total"]


@pytest.mark.parametrize("alone", [True, False])
def test_other_weights_are_refused_and_the_engine_stays(alone: bool, tmp_path: Path) -> None:
    source, target = tmp_path / "source", tmp_path / "user" / "weights.safetensors"
    source.write_bytes(b"weights of another version")
    arguments = ["--weights", source.as_uri(), str(target), hashlib.sha256(b"weights").hexdigest()]
    first = [] if alone else [str(tmp_path / "engine"), str(wheel(tmp_path, "sham_torch"))]
    done = subprocess.run([sys.executable, "-I", str(SCRIPT), *first, *arguments], capture_output=True, text=True,
                          check=False)
    last = json.loads(done.stdout.splitlines()[-1])
    assert done.returncode == (1 if alone else 0)
    assert "its SHA-256 differs" in (last["text"] if alone else last["data"]["weights_error"])
    assert list((tmp_path / "user").iterdir()) == []
    assert alone or (tmp_path / "engine" / "pyvenv.cfg").is_file()


@pytest.mark.skipif(os.name == "nt", reason="the Python without ensurepip is a shell script")
def test_a_blender_without_ensurepip_takes_another_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                          capsys: pytest.CaptureFixture[str]) -> None:
    set_up_, able = module(), sys.executable
    unable = tmp_path / "blenders-own"
    unable.write_text("#!/bin/sh\nexit 1\n")
    unable.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(unable))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert set_up_.main([str(tmp_path / "engine")]) == 1
    event = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert event["type"] == "error"
    assert "python3-venv" in event["text"]
    (tmp_path / "python3.11").symlink_to(able)
    assert set_up_.find_base_python() == str(tmp_path / "python3.11")


@pytest.mark.skipif(os.name == "nt", reason="signals")
@pytest.mark.parametrize("how", ["by a file", "by a signal", "by a signal that was ignored before"])
def test_a_stopped_set_up_ends_its_processes_and_leaves_nothing(how: str, tmp_path: Path) -> None:
    sleeper = tmp_path / "slow-1.0-py3-none-any.whl"
    os.mkfifo(sleeper)
    command = [sys.executable, "-I", str(SCRIPT), str(tmp_path / "engine"), str(sleeper)]
    if how.endswith("before"):
        command = ["sh", "-c", 'trap "" INT; exec "$@"', "sh", *command]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True,
                          env={**os.environ, "FIT_FLARE_STOP": str(tmp_path / "stop")}) as process:
        assert process.stdout is not None
        reading = os.open(sleeper, os.O_WRONLY)  # waits until pip has opened it, which then waits for what it reads
        if how == "by a file":
            (tmp_path / "stop").touch()
        else:
            process.send_signal(signal.SIGINT)
        events = [json.loads(line) for line in process.stdout]
    os.close(reading)
    assert process.returncode == 130
    assert events[-1]["text"].startswith("Stopped")
    assert not (tmp_path / "engine").exists()
    with pytest.raises(ProcessLookupError):  # of its session nobody is left
        os.killpg(process.pid, 0)


@pytest.mark.parametrize(("machine", "version", "why"), [
    ("x86_64", "15.1", "Intel processors"), ("arm64", "13.6.1", "macOS 14 or later"), ("arm64", "14.0", "")])
def test_macs_without_a_torch_build_are_refused(machine: str, version: str, why: str,
                                                monkeypatch: pytest.MonkeyPatch) -> None:
    script = module()
    assert script.unsupported_reason() == ""
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(script.platform, "machine", lambda: machine)
    monkeypatch.setattr(script.platform, "mac_ver", lambda: (version, ("", "", ""), machine))
    assert why in script.unsupported_reason()
    assert bool(why) == bool(script.unsupported_reason())


def test_a_network_failure_is_reported_as_one() -> None:
    said = "print('WARNING: Retrying (Retry(total=4)) after connection broken'); print('ERROR: No matching'); exit(1)"
    assert module().run_logged([sys.executable, "-c", said]) == "the network could not be reached"
    assert module().run_logged([sys.executable, "-c", "print('ERROR: No room left.'); exit(1)"]) == "No room left"
    assert module().run_logged([sys.executable, "-c", "print('fine')"]) == ""


@pytest.mark.parametrize(("windows", "cure"), [(True, "vc_redist.x64"), (False, "look at the log")])
def test_an_engine_that_cannot_be_loaded_is_removed(windows: bool, cure: str, tmp_path: Path,
                                                    monkeypatch: pytest.MonkeyPatch,
                                                    capsys: pytest.CaptureFixture[str]) -> None:
    """Everything can be installed where Windows lacks what torch's libraries want."""
    script, ran = module(), []

    def run(command: list[str]) -> str:
        ran.append(command)
        return "OSError: [WinError 126] c10.dll" if "import cv2" in command[-1] else ""

    monkeypatch.setattr(script, "run_logged", run)
    monkeypatch.setattr(script, "WINDOWS", windows)
    monkeypatch.setattr(script, "unsupported_reason", lambda: "")
    assert script.main([str(tmp_path / "engine")]) == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert events[0] == {"type": "stage", "name": "set up", "total": len(ran), "done": 0}
    assert events[-1]["text"].startswith(
        "The engine was installed but cannot be loaded (OSError: [WinError 126] c10.dll); ")
    assert cure in events[-1]["text"]
    assert [event["text"] for event in events if event["type"] == "say"][:2] == ["Making the virtual environment",
                                                                               "Installing numpy"]


def test_the_import_test_passes_in_this_environment() -> None:
    assert module().run_logged([sys.executable, "-c", module().IMPORT_TEST]) == ""


def test_an_engine_in_use_is_not_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                         capsys: pytest.CaptureFixture[str]) -> None:
    """Half of it would stay on Windows, and be taken for a folder of somebody's."""
    (tmp_path / "engine").mkdir()
    (tmp_path / "engine" / "pyvenv.cfg").touch()

    def refuse(*_: object) -> None:
        raise PermissionError("Access is denied")

    monkeypatch.setattr(Path, "rename", refuse)
    assert module().main([str(tmp_path / "engine"), "nothing"]) == 1
    assert "is in use; close other Blenders" in json.loads(capsys.readouterr().out.splitlines()[-1])["text"]
    assert list(tmp_path.rglob("*")) == [tmp_path / "engine", tmp_path / "engine" / "pyvenv.cfg"]
