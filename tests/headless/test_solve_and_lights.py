# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands `solve` and `lights`, as scripts start them."""
from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from core.capture import Capture
from tests.core.captures import orbit
from tests.core.test_lights import lit_capture
from tests.core.test_solve import SIZE, shoot

RUN = Path(__file__).resolve().parents[2] / "headless" / "run.py"


def run(*args: object) -> tuple[int, list[dict[str, Any]]]:
    """Exit status and events."""
    done = subprocess.run([sys.executable, str(RUN), *map(str, args), "--progress", "json"], capture_output=True,
                          text=True, check=False)
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()]


def test_solve_and_lights_make_a_capture_of_frames(tmp_path: Path) -> None:
    frames = shoot(tmp_path / "frames", orbit(9, size=SIZE, arc=0.9))
    status, events = run("solve", frames, "--out", tmp_path / "c")
    assert status == 0 and events[-1]["data"]["registered"] == 9
    stages = [event["name"] for event in events if event["type"] == "stage"]
    assert stages == ["read frames", "find features", "match frames", "place cameras", "write frames"]
    status, events = run("lights", tmp_path / "c")
    assert status == 0 and events[-1]["data"]["lights"] == []
    assert any("No light was found" in event["text"] for event in events if event["type"] == "say")


def test_the_camera_of_a_nuke_script_makes_a_capture(tmp_path: Path) -> None:
    plates = shoot(tmp_path / "plates", orbit(3, size=SIZE, arc=0.2))
    script = tmp_path / "camera.nk"
    script.write_text("Camera3 {\n translate {{curve x0 0 0.1} 0 4}\n rotate {0 {curve x0 0 1} 0}\n focal 30\n}\n")
    status, events = run("solve", script, "--plates", plates, "--out", tmp_path / "c")
    assert status == 0 and events[-1]["data"]["frames"] == 2
    assert any("1 left out" in event["text"] for event in events if event["type"] == "say")
    assert len(Capture.open(tmp_path / "c").views) == 2
    for words in ((), ("--plates", plates, "--lights", "sun"), ("--plates", plates, "--lens", "OPENCV"),
                  ("--plates", plates)):  # the last one: the capture exists
        assert run("solve", script, *words, "--out", tmp_path / "c")[0] != 0


def test_keep_preserves_the_names_of_lights(tmp_path: Path) -> None:
    folder = lit_capture(tmp_path / "c", 8, [(0.4, -0.5, 0.3)])
    status, events = run("lights", folder)
    (light,) = events[-1]["data"]["lights"]
    assert status == 0 and light["support"] == 8 and Path(events[-1]["data"]["sheets"][0]).is_file()
    file = folder / "lights.json"
    data = json.loads(file.read_text())
    data["lights"][0]["name"] = "lamp"
    file.write_text(json.dumps(data))
    assert run("lights", folder, "--keep")[0] == 0
    assert [light.name for light in Capture.open(folder).lights] == ["lamp"]


def test_lights_edited_by_hand_are_not_overwritten(tmp_path: Path) -> None:
    folder = lit_capture(tmp_path / "c", 8, [(0.4, -0.5, 0.3)])
    assert run("lights", folder)[0] == run("lights", folder)[0] == 0, "what was found may be found again"
    file = folder / "lights.json"
    for change in ({"name": "lamp"}, {"xyz": [0.3, -0.5, 0.3]}, None):
        data = json.loads(file.read_text())
        if change is None:
            data = {"lights": [{"name": "sun", "xyz": [0, 0, 9]}]}
        else:
            data["lights"][0].update(change)
        own = json.dumps(data)
        file.write_text(own)
        status, events = run("lights", folder, "--min-views", "99")
        assert status == 1
        assert "add --keep" in events[-1]["text"]
        assert file.read_text() == own
        file.unlink()
        run("lights", folder)


@pytest.mark.parametrize("words", [("solve", "nowhere", "--out", "c"), ("lights", "nowhere"),
                                   ("lights", "nowhere", "--threshold", "3")])
def test_a_failed_solve_has_a_message_and_a_status(tmp_path: Path, words: tuple[str, ...]) -> None:
    rest = [tmp_path / word if word == "c" else word for word in words[2:]]
    status, events = run(words[0], tmp_path / words[1], *rest)
    assert status == 1 and [event["type"] for event in events] == ["error"]
    assert "nowhere" in events[0]["text"] and events[0]["text"].endswith(".")
    assert not list(tmp_path.iterdir())
