# SPDX-License-Identifier: GPL-3.0-or-later
"""The whole chain as it is started by people and farms: stopped, resumed, from a Python and from Blender.

Blender's part runs in the bpy packages that `make setup` installs; and in a real Blender where
FIT_FLARE_BLENDER names one (a program, or a command line that ends where Blender's arguments begin) or
`blender` is on the PATH.
"""
from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from core.bake.exr import read_layers, write_layers
from core.bake.layers import to_layers
from core.capture import Capture
from core.colour.srgb import srgb_from_linear
from core.fit.run import Run
from core.images.read import read_picture
from core.images.size import picture_size

ROOT = Path(__file__).resolve().parents[2]
RUN = ROOT / "headless" / "run.py"
OLDER = ROOT / ".venv-bpy45" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")

# As `blender -b -P run.py -- …`, with Blender as a module of a Python.
AS_BLENDER = "import bpy, runpy, sys; runpy.run_path(sys.argv[1], run_name='__main__')"
HALF = 2.0 ** -11


class Ended(NamedTuple):
    status: int
    events: list[dict[str, Any]]
    errors: str

    @property
    def result(self) -> Any:
        return next(event["data"] for event in self.events if event["type"] == "result")

    def stages(self) -> list[str]:
        return [event["name"] for event in self.events if event["type"] == "stage"]


def run(command: Sequence[str], *args: object, stop_at: str = "", **variables: str) -> Ended:
    """Run a command to its end and return its status and events.

    stop_at: a stage, at whose first progress the command is interrupted. variables: of the environment.
    """
    whole = [*command, *map(str, args), "--progress", "json"]
    child = subprocess.Popen(whole, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                             env={**os.environ, **variables}, start_new_session=True)
    events = []
    assert child.stdout is not None
    for event in json_lines(child.stdout):
        events.append(event)
        if event["type"] == "progress" and event["stage"] == stop_at:
            child.send_signal(signal.SIGINT)
            stop_at = ""
    errors = child.communicate(timeout=60)[1]
    return Ended(child.returncode, events, errors)


def json_lines(lines: Iterator[str]) -> Iterator[dict[str, Any]]:
    """A real Blender says its name and farewell on the same stream."""
    return (json.loads(line) for line in lines if line.startswith("{"))


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demo")


@pytest.fixture(scope="module")
def words(capture: Path, out: Path) -> list[object]:
    return ["demo", "--capture", capture, "--out", out, "--iterations", 12]


@pytest.fixture(scope="module")
def stopped(words: list[object]) -> Ended:
    if os.name == "nt":
        pytest.skip("the test's way of stopping a process is not Windows'")
    return run([sys.executable, str(RUN)], *words, stop_at="fit")


@pytest.fixture(scope="module")
def finished(stopped: Ended, words: list[object]) -> Ended:
    """After a stop, run to the end."""
    assert stopped.status == 130, stopped.errors
    ended = run([sys.executable, str(RUN)], *words)
    assert ended.status == 0, (ended.events, ended.errors)
    return ended


def test_a_stop_is_clean(stopped: Ended, out: Path, finished: Ended) -> None:
    """An interrupted fit says so, leaves no partial file, and goes on from its checkpoint."""
    assert "Stopped during fit" in stopped.events[-1]["text"]
    assert "Traceback" not in stopped.errors
    begun = next(event for event in finished.events if event["type"] == "stage" and event["name"] == "fit")
    assert begun["done"] >= 1, "the fit went on"
    assert not [path for path in out.rglob(".*") if path.is_file()], "nothing is left half written"


def test_the_demo_writes_all_its_files(finished: Ended, out: Path, capture: Path) -> None:
    assert finished.stages()[:3] == ["fit", "eval", "bake"]
    assert any("the removal network does not run" in event.get("text", "") for event in finished.events)
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == ["frames", "layers", "run"]
    views = len(list((capture / "images").iterdir()))
    assert len(list((out / "layers").glob("layers.*.exr"))) == views
    width, height = picture_size(next((capture / "images").iterdir()))
    sheet = picture_size(out / "contact_sheet.png")
    assert sheet[0] > 4 * width
    assert sheet[1] > 2 * height
    scores = json.loads((out / "run" / "eval.json").read_text(encoding="utf-8"))
    assert scores["reference"] == "truth"
    assert {"composite", "scene", "flare", "flare_linear", "views"} <= set(scores)
    assert finished.result["scores"]["flare"] == scores["flare"]


@pytest.mark.usefixtures("finished")
@pytest.mark.parametrize("blend", ["over", "add"])
def test_layers_add_up_to_the_fitted_picture(blend: Any, out: Path, capture: Path, tmp_path: Path) -> None:
    """Whatever the fit puts together in display space, the linear layers sum to."""
    made, camera = Run.open(out / "run"), Capture.open(capture).views[4].camera
    made.settings = replace(made.settings, blend=blend)
    write_layers(tmp_path / "a.exr", to_layers(made.render(camera)))
    baked = read_layers(tmp_path / "a.exr")
    shown = np.clip(srgb_from_linear(baked.scene + baked.flare), 0, 1)
    np.testing.assert_allclose(shown, made.render_view(camera).composite.numpy(), atol=1e-3)
    assert np.abs(baked.flare).max() > 0.01, "there is a flare to speak of"


def assert_composited(out: Path) -> None:
    """Assert that the frames that Blender rendered are the composites of the baked layers."""
    layers = sorted((out / "layers").glob("layers.*.exr"))
    frames = sorted((out / "frames").glob("frame.*.exr"))
    assert len(frames) == len(layers) > 0
    for frame, layer in zip(frames, layers, strict=True):
        baked = read_layers(layer)
        np.testing.assert_allclose(read_picture(frame).pixels, baked.scene + baked.flare, rtol=2 * HALF, atol=1e-6)
        shown = np.clip(srgb_from_linear(baked.composite), 0, 1)
        np.testing.assert_allclose(read_picture(frame.with_suffix(".png")).pixels, shown, atol=0.6 / 255)


def test_frames_are_composited_in_blender_beside_the_engine(finished: Ended, out: Path) -> None:
    if "blender" not in finished.result:
        pytest.skip("this Python has no bpy package, and there is no other Blender (`make setup`)")
    assert "compose" in finished.stages()
    assert_composited(out)


def again_from_blender(command: Sequence[str], words: list[object], out: Path) -> Ended:
    """Run the commands once more from a Blender; assert that they keep the fit and make layers and frames again."""
    shutil.rmtree(out / "frames", ignore_errors=True)
    shutil.rmtree(out / "layers")
    ended = run(command, *words, FIT_FLARE_ENGINE=sys.executable)
    assert ended.status == 0, (ended.events, ended.errors)
    assert any("finished already" in event.get("text", "") for event in ended.events), "the fit is not made again"
    assert_composited(out)
    return ended


@pytest.mark.usefixtures("finished")
def test_the_same_from_a_blender_without_an_engine(words: list[object], out: Path) -> None:
    """The commands make layers and composites also in a Blender that hands the work to an engine elsewhere."""
    if not OLDER.is_file():
        pytest.skip(f"there is no {OLDER} (`make setup` makes it)")
    ended = again_from_blender([str(OLDER), "-c", AS_BLENDER, str(RUN), "--"], words, out)
    assert ended.result["blender"].startswith("4.5")


@pytest.mark.usefixtures("finished")
def test_the_same_from_a_real_blender(words: list[object], out: Path) -> None:
    """The commands make layers and composites also when Blender itself starts them."""
    named = os.environ.get("FIT_FLARE_BLENDER") or shutil.which("blender")
    if not named:
        pytest.skip("there is no Blender: name one in FIT_FLARE_BLENDER, or put it on the PATH")
    blender = [named] if Path(named).is_file() else shlex.split(named)
    ended = again_from_blender([*blender, "-b", "--factory-startup", "-P", str(RUN), "--"], words, out)
    assert "compose" in ended.stages()


@pytest.mark.usefixtures("finished")
def test_a_run_is_not_resumed_with_other_settings(words: list[object]) -> None:
    ended = run([sys.executable, str(RUN)], *words[:-1], 13)
    assert ended.status == 1
    assert "other settings" in ended.events[-1]["text"]


@pytest.mark.usefixtures("finished")
def test_without_blender_the_other_steps_run_and_a_message_says_so(words: list[object]) -> None:
    """In a Python without bpy, and with no Blender named, the chain makes all but the composite."""
    code = ("import importlib.util, runpy, sys\n"
            "find = importlib.util.find_spec\n"
            "importlib.util.find_spec = lambda name, *rest: None if name == 'bpy' else find(name, *rest)\n"
            "del sys.argv[0]\n"
            "runpy.run_path(sys.argv[0], run_name='__main__')")
    ended = run([sys.executable, "-c", code, str(RUN)], *words, PATH=str(Path(sys.executable).parent),
                FIT_FLARE_BLENDER="")
    assert ended.status == 0, ended.errors
    said = [event["text"] for event in ended.events if event["type"] == "say"]
    assert any(text.startswith("Skipped: frames.") and "--blender" in text for text in said)
    assert "blender" not in ended.result
