# SPDX-License-Identifier: GPL-3.0-or-later
"""Lens equations against COLMAP's own, and what is left after them."""
from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from core.capture import Capture, Lens
from core.capture.lens import MODELS, PINHOLES
from core.errors import CaptureError
from tests.core.captures import make_capture, make_transforms

EXTRA: dict[str, list[float]] = {
    "SIMPLE_RADIAL": [-0.1], "RADIAL": [-0.2, 0.05], "OPENCV": [-0.2, 0.05, 0.001, -0.002],
    "FULL_OPENCV": [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.003],
    "OPENCV_FISHEYE": [0.02, -0.01, 0.003, -0.001], "SIMPLE_RADIAL_FISHEYE": [0.03],
    "RADIAL_FISHEYE": [0.03, -0.01], "FOV": [0.9], "EUCM": [0.6, 1.1],
    "THIN_PRISM_FISHEYE": [0.02, -0.01, 0.001, 0.002, 0.003, -0.001, 0.001, -0.001],
    "RAD_TAN_THIN_PRISM_FISHEYE": [0.02, -0.01, 0.003, -0.001, 5e-4, -1e-4, 1e-3, 2e-3, 1e-3, -5e-4, 7e-4, 3e-4],
    "SIMPLE_DIVISION": [-0.1], "DIVISION": [-0.1],
}


def lens(model: str, size: tuple[int, int] = (640, 480), extra: list[float] | None = None) -> Lens:
    width, height = size
    if model == "EQUIRECTANGULAR":
        return Lens(model, (2.0 * height, float(height)), 2 * height, height)
    f = 0.62 * width
    focal = [f, 0.98 * f] if MODELS[model][1][0] == "fx" else [f]
    centre = [0.51 * width, 0.49 * height]
    return Lens(model, (*focal, *centre, *(EXTRA.get(model, []) if extra is None else extra)), width, height)


def test_every_model_of_the_installed_colmap_is_known() -> None:
    theirs = {name: int(value) for name, value in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    assert theirs.items() <= {name: number for name, (number, _) in MODELS.items()}.items()


@pytest.mark.parametrize("model", MODELS)
def test_equations_are_colmaps(model: str) -> None:
    """Distortion and its inverse agree with pycolmap's for every lens model."""
    ours = lens(model)
    try:
        theirs = pycolmap.Camera(model=model, width=ours.width, height=ours.height, params=list(ours.params))
    except (ValueError, RuntimeError):
        pytest.skip(f"this pycolmap has no {model}")
    rng = np.random.default_rng(0)
    plane = rng.uniform(-0.7, 0.7, (400, 2))
    expected = theirs.img_from_cam(np.concatenate([plane, np.ones((400, 1))], axis=1))
    np.testing.assert_allclose(ours.distort(plane), expected, atol=1e-6)
    np.testing.assert_allclose(ours.undistort(ours.distort(plane)), plane, atol=1e-8)
    pixels = rng.uniform(0.15, 0.85, (200, 2)) * (ours.width, ours.height)
    back = np.asarray(theirs.cam_from_img(pixels))
    if back.shape[1] == 3:
        pixels, back = pixels[back[:, 2] > 0.1], back[back[:, 2] > 0.1]
        back = back[:, :2] / back[:, 2:]
    ahead = np.linalg.norm(back, axis=1) < 2.7  # within 70 degrees; a panorama goes on behind the camera
    pixels, back = pixels[ahead], back[ahead]
    assert len(pixels) > 40
    np.testing.assert_allclose(ours.distort(back), pixels, atol=1e-3)
    np.testing.assert_allclose(ours.undistort(pixels), back, atol=1e-5)


def test_no_direction_leads_outside_a_folded_polynomial() -> None:
    folded = Lens("SIMPLE_RADIAL", (100.0, 50.0, 50.0, -0.4), 100, 100)  # reaches 61 px from the centre at most
    assert np.isnan(folded.undistort([(150.0, 50.0)])).all()
    assert not np.isnan(folded.undistort([(100.0, 50.0)])).any()


@pytest.mark.parametrize("model", MODELS)
def test_the_undistorted_view_is_covered_and_as_wide_as_possible(model: str) -> None:
    ours = lens(model)
    fx, fy, cx, cy = ours.pinhole
    assert (cx, cy) == ours.centre and fx / fy == pytest.approx(ours.focal[0] / ours.focal[1])
    u, v = np.meshgrid(np.linspace(0, ours.width, 41), np.linspace(0, ours.height, 41))
    plane = np.stack([(u - cx) / fx, (v - cy) / fy], axis=-1)
    pixels = ours.distort(plane).reshape(41, 41, 2)
    assert pixels.min() >= -0.05 and (pixels <= np.array([ours.width, ours.height]) + 0.05).all()
    if model in PINHOLES:
        assert fx == ours.focal[0]
        return
    wider = ours.distort(plane * 1.003).reshape(41, 41, 2)
    touches = wider.min() < 0 or (wider > (ours.width, ours.height)).any()
    corner = np.degrees(np.arctan(np.linalg.norm(plane, axis=-1).max()))
    assert touches or corner == pytest.approx(60.0, abs=0.1)


def test_no_distortion_changes_nothing() -> None:
    none = lens("OPENCV", extra=[0.0, 0.0, 0.0, 0.0])
    assert none.pinhole == (*none.focal, *none.centre)


def test_a_lens_without_undistorted_view_is_refused() -> None:
    with pytest.raises(CaptureError, match="simpler model"):
        _ = Lens("SIMPLE_RADIAL", (100.0, 50.0, 50.0, -1e5), 100, 100).pinhole
    with pytest.raises(CaptureError, match="simpler model"):
        _ = Lens("SIMPLE_RADIAL", (100.0, -500.0, 50.0, 0.1), 100, 100).pinhole


@pytest.mark.parametrize("model", ["OPENCV", "FOV", "THIN_PRISM_FISHEYE", "EUCM", "SIMPLE_DIVISION", "EQUIRECTANGULAR"])
@pytest.mark.parametrize("scale", [1, 2])
def test_frames_are_undistorted(tmp_path: Path, model: str, scale: int) -> None:
    """Dots drawn through the lens land where the pinhole camera of the view puts them."""
    ours = lens(model, (320, 240))
    folder = make_capture(tmp_path / "c", views=1, size=(ours.width, ours.height), model=model, params=ours.params)
    rng = np.random.default_rng(3)
    view = Capture.open(folder).views[0]
    world = view.camera.position + rng.uniform(1, 3, (40, 1)) * view.camera.rays(
        rng.uniform(0.1, 0.9, (40, 2)) * view.camera.size)
    plane, _ = view.camera.project_normalised(world)
    size = (ours.width * scale, ours.height * scale)
    v, u = np.mgrid[:size[1], :size[0]] + 0.5
    for at in range(0, 40, 8):  # a few dots a picture, so that none hides another
        drawn = np.zeros((size[1], size[0]))
        for x, y in ours.distort(plane[at:at + 8]) * scale:
            drawn = np.maximum(drawn, np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * (2.0 * scale) ** 2)))
        cv2.imwrite(str(folder / "images/0000.png"), (drawn * 255).astype(np.uint8))
        capture = Capture.open(folder)
        view = capture.views[0]
        assert view.camera.size == size and view.lens is not None
        frame = capture.frame(view).pixels[..., 0]
        for x, y in view.camera.project(world[at:at + 8])[0]:
            window = frame * (np.hypot(u - x, v - y) < 6 * scale)
            found = np.array([(window * u).sum(), (window * v).sum()]) / window.sum()
            neighbours = np.sort(np.linalg.norm(view.camera.project(world[at:at + 8])[0] - (x, y), axis=1))
            if neighbours[1] > 16 * scale:
                assert np.linalg.norm(found - (x, y)) < 0.15 * scale


@pytest.mark.parametrize(("model", "coefficients"), [
    ("OPENCV", {"k1": -0.1, "k2": 0.02, "k3": -0.003, "p1": 0.004, "p2": -0.005}),
    ("OPENCV_FISHEYE", {"k1": -0.1, "k2": 0.02, "k3": -0.003, "k4": 0.0006})])
def test_coefficients_of_transforms_json_are_read_by_name(model: str, coefficients: dict[str, float],
                                                          tmp_path: Path) -> None:
    found = Capture.open(make_transforms(tmp_path / "c", camera_model=model, **coefficients)).views[0].lens
    assert {name: found.parameters[name] for name in coefficients} == coefficients


def test_fields_of_view_give_focal_lengths(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "c", camera_angle_x=1.0, camera_angle_y=0.7)
    meta = json.loads((folder / "transforms.json").read_text())
    del meta["fl_x"], meta["fl_y"]
    (folder / "transforms.json").write_text(json.dumps(meta))
    camera = Capture.open(folder).views[0].camera
    np.testing.assert_allclose((camera.fx, camera.fy), (32 / np.tan(0.5), 24 / np.tan(0.35)))
