# SPDX-License-Identifier: GPL-3.0-or-later
"""`--plate-space`: commands read frames in the space that it names, keep it in the capture, and write plates in it."""
from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from core.bake.exr import read_layers
from core.capture import Capture
from core.capture.plate_space import FILE, read_plate_space, record_plate_space
from core.capture.solve.develop import _file_names
from core.capture.solve.source_frames import prepare_frames, read_full_size
from core.colour import colour_space
from core.images.read import read_picture, read_stored_pixels
from core.system.progress import Progress
from tests.core.captures import SIZE, make_capture
from tests.core.picture_files import scene, tiff_16
from tests.core.removal_cases import network_file
from tests.core.videos import stripes, write_video

LOOK = Path(__file__).resolve().parents[2] / "flare_addon" / "library_looks" / "Clean Prime.flare"
SPACE = "logc4"
Run = Callable[..., list[dict[str, Any]]]


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def light() -> NDArray[np.float32]:
    return scene(*SIZE)


@pytest.fixture
def filmed(tmp_path: Path, light: NDArray[np.float32]) -> Path:
    """A capture whose frames are TIFFs with a camera's logarithm that they do not declare."""
    folder = make_capture(tmp_path / "shot", views=3, suffix=".tif")
    for path in (folder / "images").iterdir():
        tiff_16(path, colour_space(SPACE).from_linear(light))
    (folder / "lights.json").write_text('{"lights": [{"name": "sun", "xyz": [0.2, -0.3, 0.5]}]}')
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return network_file(tmp_path_factory.mktemp("weights") / "everywhere.safetensors", bias=0.1)


def texts(events: list[dict[str, Any]]) -> str:
    return " ".join(event.get("text", "") for event in events)


def test_fit_and_eval_keep_the_space_in_the_capture(filmed: Path, light: NDArray[np.float32], run: Run,
                                                    tmp_path: Path) -> None:
    run("fit", filmed, "--out", tmp_path / "run", "--mode", "3dgs", "--iterations", 1, "--holdout", 0, "--plate-space",
        "LogC4")
    assert json.loads((filmed / FILE).read_text()) == {"space": "LogC4", "ocio": None}
    np.testing.assert_allclose(Capture.open(filmed).frame(Capture.open(filmed).views[0]).linear(), light, atol=1e-3)
    scores = {}
    for words in ((), ("--plate-space", "auto"), ("--plate-space", SPACE)):
        run("eval", tmp_path / "run", "--views", "all", *words)
        scores[words] = json.loads((tmp_path / "run" / "eval.json").read_text())["composite"]["psnr"]
        assert (read_plate_space(filmed) is None) == ("auto" in words)
    assert scores[()] == scores["--plate-space", SPACE] != scores["--plate-space", "auto"]


def test_lights_keeps_the_space_and_refuses_an_undefined_space(filmed: Path, run: Run) -> None:
    run("lights", filmed, "--plate-space", SPACE, "--keep")
    assert read_plate_space(filmed) is not None
    problem = run("lights", filmed, "--plate-space", "no such space", "--keep", status=2)[-1]["text"]
    assert "'no such space' is not one of" in problem and read_plate_space(filmed) is not None
    assert "--ocio defines the space" in run("lights", filmed, "--ocio", "a.ocio", status=2)[-1]["text"]


def test_solve_develops_frames_to_light(filmed: Path, light: NDArray[np.float32], run: Run, tmp_path: Path,
                                        monkeypatch: pytest.MonkeyPatch) -> None:
    frames, _ = prepare_frames(filmed / "images", tmp_path / "work", 0, 64, Progress(), (SPACE, None))
    assert _file_names(frames) == ["0000.exr", "0001.exr", "0002.exr"]
    np.testing.assert_allclose(read_full_size(frames[0]).linear(), light, atol=1e-3)
    settings: list[Any] = []

    def record_settings(_source: Path, _out: Path, chosen: Any, _progress: Progress) -> dict[str, Any]:
        settings.append(chosen)
        return {"registered": 3, "frames": 3, "points": 0, "reprojection_error_px": 0, "track_length": 0,
                "unregistered": [], "left_out": []}

    monkeypatch.setattr("fit_flare.core.capture.solve.solve", record_settings)
    run("solve", filmed / "images", "--out", tmp_path / "c", "--plate-space", SPACE)
    assert settings[0].plate_space == SPACE


def test_a_video_with_a_logarithm_is_solved_and_cleaned_as_light(light: NDArray[np.float32], weights: Path, run: Run,
                                                                 tmp_path: Path) -> None:
    signal = colour_space(SPACE).from_linear(light)
    video = write_video(tmp_path / "log.mkv", "ffv1", "gbrp16le", [signal] * 3, matrix=0)
    frames, _ = prepare_frames(video, tmp_path / "work", 3, 64, Progress(), (SPACE, None))
    np.testing.assert_allclose(read_full_size(frames[0]).linear(), light, atol=1e-3)
    run("remove", video, "--out", tmp_path / "clean", "--flare", tmp_path / "flare", "--weights", weights, "--stills",
        "--frames", 1, "--plate-space", SPACE)
    clean = read_picture(tmp_path / "clean" / "log.000001.png", space=colour_space(SPACE)).linear()
    flare = read_picture(tmp_path / "flare" / "log.000001.exr").linear()
    assert flare.max() > 0.01
    np.testing.assert_allclose((clean + flare).mean((0, 1)), light.mean((0, 1)), rtol=2e-3)


@pytest.mark.parametrize("command", ["remove", "solve"])
def test_a_video_that_declares_its_transfer_refuses_a_plate_space(command: str, run: Run, tmp_path: Path) -> None:
    video = write_video(tmp_path / "pq.mkv", "ffv1", "yuv444p10le", [stripes(64)] * 3, matrix=9, tags=(9, 16, 9))
    problem = run(command, video, "--out", tmp_path / "out", "--plate-space", SPACE, status=1)[-1]["text"]
    assert "pq.mkv names its own colours (PQ), and --plate-space logc4 others" in problem


def test_remove_reads_frames_in_the_space_of_their_capture(filmed: Path, light: NDArray[np.float32], weights: Path,
                                                           run: Run, tmp_path: Path) -> None:
    record_plate_space(filmed, SPACE, None)
    words = ("--weights", weights, "--stills", "--frames", 0)
    said = texts(run("remove", filmed / "images", "--out", tmp_path / "a", "--flare", tmp_path / "flare", *words))
    assert f"in the colour space {SPACE}, which {filmed / FILE} names" in said
    clean, flare = tmp_path / "a" / "0000.tif", read_picture(tmp_path / "flare" / "0000.exr").linear()
    seen = read_picture(clean, space=colour_space(SPACE)).linear() + flare
    np.testing.assert_allclose(seen.mean((0, 1)), light.mean((0, 1)), rtol=2e-3)
    before, after = (read_stored_pixels(path) for path in (filmed / "images" / "0000.tif", clean))
    untouched = (flare == 0).all(-1)
    np.testing.assert_array_equal(before[untouched], after[untouched])
    assert not untouched.all() and before.dtype == after.dtype
    assert "colour space" not in texts(run("remove", filmed / "images", "--out", tmp_path / "b", *words,
                                           "--plate-space", "auto"))
    run("remove", filmed / "images" / "0000.tif", "--out", tmp_path / "c", *words, "--plate-space", SPACE)
    assert (tmp_path / "c" / "0000.tif").read_bytes() == clean.read_bytes()


def test_plates_of_captures_with_different_spaces_are_not_cleaned_at_once(filmed: Path, run: Run,
                                                                          tmp_path: Path) -> None:
    record_plate_space(filmed, SPACE, None)
    (tmp_path / "other").mkdir()
    cv2.imwrite(str(tmp_path / "other" / "b.png"), np.zeros((64, 64, 3), np.uint8))
    problem = run("remove", filmed / "images", tmp_path / "other", "--out", tmp_path / "clean", status=2)[-1]["text"]
    assert f"{filmed / FILE} names the colour space of some of the plates only" in problem


@pytest.mark.parametrize("lens", ["PINHOLE", "OPENCV"])
def test_transfer_reads_frames_in_the_space_of_their_capture(lens: str, light: NDArray[np.float32], run: Run,
                                                             tmp_path: Path) -> None:
    """Distorted ones as well, whose light is the same all over."""
    params = None if lens == "PINHOLE" else (57.6, 57.6, 32, 24, 0.02, 0, 0, 0)
    folder = make_capture(tmp_path / "shot", views=2, suffix=".tif", model=lens, params=params)
    grey = np.broadcast_to(np.float32([0.6, 0.3, 0.1]), light.shape)
    for path in (folder / "images").iterdir():
        tiff_16(path, colour_space(SPACE).from_linear(grey))
    (folder / "lights.json").write_text('{"lights": [{"name": "sun", "xyz": [0.2, -0.3, 0.5]}]}')
    record_plate_space(folder, SPACE, None)
    run("transfer", LOOK, "--to", folder, "--out", tmp_path / "out")
    layers = read_layers(tmp_path / "out" / "layers.0001.exr")
    np.testing.assert_allclose(layers.scene, grey, atol=1e-3)
    if lens == "PINHOLE":
        plate = read_picture(tmp_path / "out" / "frames" / "0001.tif", space=colour_space(SPACE)).linear()
        assert layers.flare.max() > 0.001
        np.testing.assert_allclose(plate - layers.flare, grey, atol=5e-3)  # layers are half floats
    run("transfer", LOOK, "--to", folder, "--out", tmp_path / "srgb", "--plate-space", "srgb")
    assert np.abs(read_layers(tmp_path / "srgb" / "layers.0001.exr").scene - grey).max() > 0.05


def test_lights_on_a_logarithmic_plate_are_detected_in_light(run: Run, tmp_path: Path) -> None:
    """A lamp is white in light, and grey in the codes of a logarithm."""
    x, y = np.meshgrid(np.arange(160), np.arange(120))
    picture = np.where((np.hypot(x - 50, y - 40) < 6)[..., None], np.float32(8), np.float32([0.1, 0.12, 0.15]))
    tiff_16(tmp_path / "plate.tif", colour_space(SPACE).from_linear(picture))
    words = ("transfer", LOOK, "--to", tmp_path / "plate.tif", "--out", tmp_path / "out")
    assert "No light was found" in run(*words, status=2)[-1]["text"]
    run(*words, "--plate-space", SPACE)
    assert read_layers(tmp_path / "out" / "layers.0001.exr").flare.max() > 0.001


def test_a_space_of_an_opencolorio_configuration_is_named_with_it(filmed: Path, light: NDArray[np.float32],
                                                                  run: Run) -> None:
    pytest.importorskip("PyOpenColorIO")
    config = "ocio://studio-config-v2.1.0_aces-v1.3_ocio-v2.3"
    run("lights", filmed, "--keep", "--plate-space", "ARRI LogC4", "--ocio", config)
    assert json.loads((filmed / FILE).read_text()) == {"space": "ARRI LogC4", "ocio": config}
    np.testing.assert_allclose(Capture.open(filmed).frame(Capture.open(filmed).views[0]).linear(), light, atol=1e-3)
