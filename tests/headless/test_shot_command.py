# SPDX-License-Identifier: GPL-3.0-or-later
"""`shot` goes from frames to the layers of their flare, and goes on where it was stopped."""
from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from core.bake.exr import read_layers
from core.fit import Run
from tests.core.removal_cases import network_file
from tests.core.test_fit_plates import make_shot
from tests.headless.test_solve_and_lights import run

FRAMES = 4


def test_shot_makes_run_layers_and_clean_frames(tmp_path: Path) -> None:
    folder, out = make_shot(tmp_path / "frames", count=FRAMES), tmp_path / "out"
    request = ("shot", folder, "--out", out, "--scene", "plates", "--focal", 90, "--iterations", 20)
    status, events = run(*request)
    assert status == 0, events
    result = events[-1]["data"]
    assert result["scene"] == "plates" and Path(result["sheet"]).is_file()
    assert len(list(Path(result["layers"]).glob("layers.*.exr"))) == FRAMES
    assert len(list(Path(result["clean"]).glob("*.png"))) == FRAMES
    fitted = Run.open(result["run"])
    assert fitted.open_capture().views[0].camera.fx == 90 and fitted.lights == ("lamp",)
    says = [event["text"] for event in events if event["type"] == "say"]
    assert any("Shares of the flare by light" in text for text in says)
    before = fitted.fingerprint
    status, events = run(*request)
    assert status == 0 and Run.open(result["run"]).fingerprint == before
    assert any("finished already" in event["text"] for event in events if event["type"] == "say")


def test_a_shot_without_flare_stays_dark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The network removes nothing: plates from other frames would make a flare of what moves."""
    monkeypatch.setenv("FIT_FLARE_WEIGHTS", str(network_file(tmp_path / "net.safetensors", bias=-1.0)))
    folder, out = make_shot(tmp_path / "frames", count=FRAMES), tmp_path / "out"
    shutil.rmtree(folder / "removed", ignore_errors=True)
    status, events = run("shot", folder, "--out", out, "--scene", "plates", "--focal", 90, "--iterations", 20)
    assert status == 0, events
    says = [event["text"] for event in events if event["type"] == "say"]
    assert any("found no flare in the frames" in text and "put clean frames from elsewhere into" in text
               for text in says)
    for path in sorted((out / "layers").glob("layers.*.exr")):
        layers = read_layers(path)
        assert layers.scene.any() and not layers.flare.any(), "to the last bit"
    assert run("shot", folder, "--out", out, "--scene", "plates")[0] == 0, "it goes on with the settings of its run"


def test_shot_names_a_source_that_is_missing(tmp_path: Path) -> None:
    status, events = run("shot", tmp_path / "none.mp4", "--out", tmp_path / "out")
    assert status != 0 and "is missing; name a video or a folder of frames" in events[-1]["text"]
