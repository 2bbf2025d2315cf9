# SPDX-License-Identifier: GPL-3.0-or-later
"""A fit over plates separates the flare of a moving, switched light, without cameras, and its run is like any other."""
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from core.bake.bake import bake
from core.bake.exr import read_layers
from core.capture import Capture
from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.conventions.frame_numbers import number_views
from core.conventions.run_files import CHECKPOINT, FRAME_LIGHTS, PLATES
from core.errors import Cancelled, CaptureError, RunError
from core.fit import FitSettings, Run, fit, preset
from core.fit.light_results import FlareShare, make_frame_lights, select_flaring, share_messages
from core.fit.overrides import override_settings
from core.fit.settings import adapt_to_plates
from core.images.write import write_png
from core.metrics.pictures import relative_l2
from core.removal.jobs.fitted import remove_fitted_flare
from core.system.progress import Progress
from tests.core.recording_progress import StopAfter

WIDTH, HEIGHT, FRAMES = 96, 54, 16
OFF = {7, 8}
"""Frames in which the lamp is out."""
HELD_OUT = "0006.png"


def _flare(place: np.ndarray, colour: tuple[float, float, float]) -> np.ndarray:
    """A glow around the light and a ghost mirrored through the middle, linear light."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    middle = np.array([WIDTH, HEIGHT]) / 2
    ghost = middle - 0.6 * (place - middle)
    glow = 0.5 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 80)
    spot = 0.25 * np.exp(-((x - ghost[0]) ** 2 + (y - ghost[1]) ** 2) / 40)
    return np.asarray((glow + spot)[..., None] * np.array(colour), np.float32)


def make_shot(folder: Path, *, second_lamp: bool = False, count: int = FRAMES) -> Path:
    """Write a shot of a lamp that moves and goes out, with exact clean frames, and the lamp's path without brightness.

    second_lamp: add a light to lights.json that never shines.
    """
    random = np.random.default_rng(0)
    background = random.uniform(0.05, 0.3, (9, 16, 3)).repeat(6, 0).repeat(6, 1).astype(np.float32)
    keys = {}
    for number in range(count):
        name, share = f"{number + 1:04d}.png", number / (count - 1)
        place = np.array([15 + 60 * share, 40 - 25 * share + 6 * np.sin(9 * share)])
        scene = np.roll(background, number, 1)
        flare = 0.0 if number in OFF else _flare(place, (1.0, 0.8, 0.5))
        for part, light in (("images", scene + flare), ("removed", scene), ("truth/scene", scene)):
            path = folder / part / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, np.clip(srgb_from_linear(light), 0, 1))
        keys[name] = {"xy": place.tolist()}
    lights = [{"name": "lamp", "frames": keys}]
    if second_lamp:
        lights.append({"name": "dark", "xy": [80.0, 8.0]})
    (folder / "lights.json").write_text(json.dumps({"lights": lights}))
    (folder / "split.json").write_text(json.dumps({"test": [HELD_OUT] if count >= 6 else []}))
    return folder


def quick(iterations: int = 240) -> FitSettings:
    settings = adapt_to_plates(preset("draft", iterations=iterations))
    return override_settings(settings, {"flare.count": 60, "preview_every": 100})


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_shot(tmp_path_factory.mktemp("shot"), second_lamp=True)


@pytest.fixture(scope="module")
def run(shot: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    out = tmp_path_factory.mktemp("runs") / "run"
    fit(Capture.open(shot, need_cameras=False), quick(), out)
    return Run.open(out)


def test_the_held_out_frame_has_its_flare(run: Run) -> None:
    capture = run.open_capture()
    view = capture.view(HELD_OUT)
    layers = run.render(view.camera)
    fitted = sum(layers.flare_by_light.values())
    frame, scene = capture.frame(view).linear(), capture.clean_frame(view).linear()
    error = relative_l2(np.asarray(fitted), frame - scene, (frame < 0.9).all(-1))
    assert error < 0.45
    np.testing.assert_allclose(layers.scene + fitted, frame, atol=0.06)


def test_a_lamp_that_goes_out_has_no_brightness_there(run: Run) -> None:
    entry = next(light for light in json.loads((run.folder / FRAME_LIGHTS).read_text())["lights"]
                 if light["name"] == "lamp")
    brightness = [entry["frames"][f"{number + 1:04d}.png"]["on"] for number in range(FRAMES)]
    for number, value in enumerate(brightness):
        assert value == pytest.approx(0.0 if number in OFF else 1.0, abs=0.2), (number, brightness)


def test_a_light_without_flare_is_left_out_and_named(run: Run) -> None:
    assert run.lights == ("lamp",)
    log = (run.folder / "log.txt").read_text()
    assert "Shares of the flare by light: lamp" in log and "they do not flare" in log and "dark" in log


def test_a_doubtful_brightness_is_only_a_first_guess(tmp_path: Path) -> None:
    folder = make_shot(tmp_path, count=4)
    data = json.loads((folder / "lights.json").read_text())
    for number, key in enumerate(data["lights"][0]["frames"].values()):
        key.update(on=0.2, confidence=0.9 if number % 2 else 0.1)
    (folder / "lights.json").write_text(json.dumps(data))
    lights = make_frame_lights(Capture.open(folder, need_cameras=False), ["lamp"])
    np.testing.assert_allclose(lights.brightness.weight.detach(), 0.2)
    assert lights.prior.isnan()[:, 0].tolist() == [True, False, True, False]


def test_lights_that_do_not_flare_are_left_out_and_named() -> None:
    shares = {"a": FlareShare(0.999, 0.5), "b": FlareShare(0.001, 0.5)}
    assert select_flaring(shares) == ["a"]
    assert share_messages(shares, ["a"])[1].endswith("everywhere): b.")


def test_a_capture_in_which_no_light_flares_is_reported() -> None:
    dark = {"a": FlareShare(0.9, 0.001), "b": FlareShare(0.1, 0.0)}
    assert select_flaring(dark) == ["a"]
    (sentence,) = share_messages(dark, ["a"])
    assert "No light of the capture flares" in sentence and "has a alone" in sentence


def test_the_plates_lack_the_flare(run: Run, tmp_path: Path) -> None:
    capture = run.open_capture()
    assert len(list((run.folder / PLATES).glob("*.png"))) == FRAMES
    remove_fitted_flare(run, capture, capture.views, tmp_path / "clean", Progress())
    before, after = [], []
    for view in capture.views:
        exact, frame = capture.clean_frame(view).linear(), capture.frame(view).linear()
        clean = linear_from_srgb(_read(tmp_path / "clean" / view.name))
        before.append(np.mean((frame - exact) ** 2))
        after.append(np.mean((clean - exact) ** 2))
    assert np.mean(after) < np.mean(before) / 4
    off = capture.views[min(OFF)]
    np.testing.assert_allclose(_read(tmp_path / "clean" / off.name), capture.frame(off).display(), atol=0.03)


def _read(path: Path) -> np.ndarray:
    from core.images.read import read_picture

    return read_picture(path).display()


def test_the_layers_of_a_bake_add_up(run: Run, tmp_path: Path) -> None:
    """The baked scene and flares add up to the frame."""
    capture = run.open_capture(need_frames=False)
    cameras = {view.name: view.camera for view in capture.views}
    frames = number_views(cameras)[:2]
    bake(run, frames, cameras, tmp_path)
    layers = read_layers(tmp_path / frames[1].file)
    frame = capture.frame(capture.views[1]).linear()
    np.testing.assert_allclose(layers.scene + sum(layers.flares.values()), frame, atol=0.06)


def test_a_stopped_fit_continues_as_if_it_had_not_stopped(shot: Path, tmp_path: Path) -> None:
    capture = Capture.open(shot, need_cameras=False)
    whole = fit(capture, quick(30), tmp_path / "whole")
    with pytest.raises(Cancelled):
        fit(capture, quick(30), tmp_path / "parts", StopAfter(17, "fit"))
    assert (tmp_path / "parts" / CHECKPOINT).is_file()
    parts = fit(capture, quick(30), tmp_path / "parts", resume=True)
    assert parts.fingerprint == whole.fingerprint


def test_plates_show_no_other_camera(run: Run) -> None:
    """A run over plates renders no camera but those of its frames, and has no scene Gaussians."""
    camera = run.open_capture().views[0].camera
    with pytest.raises(RunError, match="one plate per frame"):
        run.render(type(camera)(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
                                camera.world_to_camera))
    with pytest.raises(RunError, match="it has no 3D"):
        _ = run.gaussians


def test_plates_need_clean_frames(tmp_path: Path) -> None:
    folder = make_shot(tmp_path)
    for part in ("removed", "truth/scene"):
        for path in (folder / part).iterdir():
            path.unlink()
        (folder / part).rmdir()
    with pytest.raises(CaptureError, match="no clean frames"):
        fit(Capture.open(folder, need_cameras=False), quick(30), tmp_path / "run")
