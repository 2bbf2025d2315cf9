# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras of Nuke scripts and .chan files: what the plates show lies where the camera says."""
from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from core.capture import Capture
from core.capture.nuke_camera import read_nuke_camera, write_nuke_capture
from core.errors import CaptureError
from core.images.write import write_exr
from core.system.progress import Progress
from tests.core.captures import picture

NUMBERS = (1001, 1002, 1003)
TRANSLATE = np.array([[0.0, 1.5, 10.0], [0.5, 1.5, 9.5], [1.0, 1.6, 9.0]])
ROTATE = np.array([[-5.0, 20.0, 3.0], [-6.0, 24.0, 2.0], [-7.0, 28.0, 1.0]])
FOCAL, APERTURE = 35.0, 24.576


def test_a_camera_that_stands_has_its_pose_in_every_plate(tmp_path: Path) -> None:
    script = tmp_path / "still.nk"
    script.write_text("Camera2 {\n translate {1 2 3}\n rotate {0 10 0}\n focal 30\n}\n")
    plates = {}
    for number in NUMBERS:
        plates[number] = tmp_path / f"plate.{number}.png"
        cv2.imwrite(str(plates[number]), np.full((48, 64, 3), 90, np.uint8))
    tally = write_nuke_capture(read_nuke_camera(script), plates, tmp_path / "capture", Progress())
    views = Capture.open(tmp_path / "capture").views
    assert len(views) == len(NUMBERS) == tally.used
    assert all((view.camera.world_to_camera == views[0].camera.world_to_camera).all() for view in views)


def turn(axis: int, degrees: float) -> np.ndarray:
    """A right-handed rotation about an axis, by Rodrigues' formula."""
    vector = np.eye(3)[axis] * math.radians(degrees)
    return np.asarray(cv2.Rodrigues(vector)[0])


def in_frame(point: np.ndarray, number: int, order: str = "ZXY", size: tuple[int, int] = (64, 48),
             aspect: float = 1.0) -> np.ndarray:
    """Return the pixel of a point of Nuke's world in frame `number`. order: in which Nuke applies the rotations."""
    rotation = np.eye(3)
    for axis in order:
        rotation = turn("XYZ".index(axis), ROTATE[number - 1001]["XYZ".index(axis)]) @ rotation
    x, y, z = rotation.T @ (point - TRANSLATE[number - 1001])
    focal = FOCAL / APERTURE * size[0]
    return np.array([size[0] / 2 - focal * x / z, size[1] / 2 + focal * aspect * y / z])


def curves(values: np.ndarray) -> str:
    return "{" + " ".join("{curve i x1001 " + " ".join(map(str, column)) + "}" for column in values.T) + "}"


def script(order: str = "", extra: str = "", node: str = "Camera2", pose: str = "") -> str:
    pose = pose or f" translate {curves(TRANSLATE)}\n rotate {curves(ROTATE)}\n"
    return ('set cut_paste_input [stack 0]\nversion 12.2 v4\nRoot {\n name "a \\{ b"\n}\npush 0\n'
            f"{node} {{\n inputs 0\n{f' rot_order {order}' if order else ''}\n{pose} focal {FOCAL}\n"
            f" haperture {APERTURE}\n{extra} name shotcam\n}}\n")


def plates(folder: Path, numbers: tuple[int, ...] = NUMBERS) -> dict[int, Path]:
    folder.mkdir()
    for number in numbers:
        cv2.imwrite(str(folder / f"sh.{number}.png"), picture(number))
    return {number: folder / f"sh.{number}.png" for number in numbers}


def capture_of(text: str, folder: Path, suffix: str = ".nk") -> Capture:
    (folder / f"camera{suffix}").write_text(text)
    camera = read_nuke_camera(folder / f"camera{suffix}")
    write_nuke_capture(camera, plates(folder / "plates"), folder / "c", Progress())
    return Capture.open(folder / "c")


def check(capture: Capture, **how: str) -> None:
    """A point of Nuke's world, y up, is the point (x, -z, y) of the capture's."""
    for point in np.array([[1.0, 2.0, -3.0], [-2.0, 0.0, 1.0], [0.3, 1.1, 0.0]]):
        for number, view in zip(NUMBERS, capture.views, strict=True):
            local = view.camera.world_to_camera @ [point[0], -point[2], point[1], 1]
            pixel = np.array([view.camera.fx, view.camera.fy]) * local[:2] / local[2] + [view.camera.cx, view.camera.cy]
            assert local[2] > 0
            np.testing.assert_allclose(pixel, in_frame(point, number, **how), atol=1e-6)


@pytest.mark.parametrize("order", ["", "ZXY", "XYZ", "YZX"])
def test_a_camera_of_a_script_sees_its_points_in_their_pixels(order: str, tmp_path: Path) -> None:
    check(capture_of(script(order), tmp_path), order=order or "ZXY")


def test_a_matrix_is_read_where_it_is_used(tmp_path: Path) -> None:
    rows = []
    for number in range(3):
        pose = np.eye(4)
        for axis in (2, 0, 1):
            pose[:3, :3] = turn(axis, ROTATE[number, axis]) @ pose[:3, :3]
        pose[:3, 3] = TRANSLATE[number]
        rows.append(pose.ravel())
    text = f" useMatrix true\n matrix {curves(np.array(rows))}\n rotate {{0 90 0}}\n"
    check(capture_of(script(pose=text, node="Camera3"), tmp_path))


def test_a_chan_file_has_nukes_default_order_and_a_vertical_field_of_view(tmp_path: Path) -> None:
    angle = 2 * math.degrees(math.atan(48 / 2 / (FOCAL / APERTURE * 64)))
    lines = [" ".join(map(repr, (number, *map(float, TRANSLATE[at]), *map(float, ROTATE[at]), angle)))
             for at, number in enumerate(NUMBERS)]
    check(capture_of("# chan\n" + "\n".join(lines) + "\n", tmp_path, ".chan"))


def test_squeezed_plates_have_their_pixel_aspect(tmp_path: Path) -> None:
    (tmp_path / "camera.nk").write_text(script())
    files = {number: tmp_path / f"sh.{number}.exr" for number in NUMBERS}
    for path in files.values():
        write_exr(path, dict.fromkeys("RGB", np.ones((48, 64))), header={"pixelAspectRatio": 2.0})
    write_nuke_capture(read_nuke_camera(tmp_path / "camera.nk"), files, tmp_path / "c", Progress())
    camera = Capture.open(tmp_path / "c").views[0].camera
    assert camera.fy == pytest.approx(2 * camera.fx) and camera.fx == pytest.approx(FOCAL / APERTURE * 64)


def test_plates_without_a_key_are_counted_and_named(tmp_path: Path) -> None:
    (tmp_path / "camera.nk").write_text(script())
    camera = read_nuke_camera(tmp_path / "camera.nk")
    tally = write_nuke_capture(camera, plates(tmp_path / "p", (1002, 1003, 1004)), tmp_path / "c", Progress())
    assert tally.summary() == "2 frames written; 1 left out: sh.1004.png (the camera has no key there)."
    with pytest.raises(CaptureError, match="the camera has the frames 1001 to 1003, and the plates 7 to 8"):
        write_nuke_capture(camera, plates(tmp_path / "q", (7, 8)), tmp_path / "d", Progress())


@pytest.mark.parametrize(("text", "problem"), [
    ("Blur {\n size 3\n}\n", "holds no Camera node"),
    (script() + script().replace("shotcam", "other"), "holds the cameras shotcam, other; export one camera"),
    (script(extra=" win_translate {0.1 0}\n"), "shotcam: win_translate is not 0"),
    (script(extra=" pivot {0 {curve x1 2}  0}\n"), "pivot is not 0"),
    (script(extra=" projection_mode orthographic\n"), "its projection is orthographic"),
    (script(order="ZYZ"), "its rotation order is ZYZ"),
    (script(pose=" translate {{parent.Axis1.translate.x} 0 0}\n"), "translate is an expression or damaged"),
    (script(pose=" translate {{curve x1 0 x11 1 2} 0 0}\n"), "translate is an expression or damaged"),
    (script(pose=" translate {{curve x1 0 1} 0 0}\n rotate {{curve x5 0 1} 0 0}\n"), "no frame in common"),
    (script(extra=" focal 0\n"), "the camera's numbers make no sense"),
    (script(pose=" useMatrix true\n matrix {" + "2 " * 16 + "}\n"), "its matrix is no rotation"),
])
def test_a_camera_that_cannot_be_read_is_refused_by_name(text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "camera.nk").write_text(text)
    with pytest.raises(CaptureError, match=rf"camera\.nk.*{problem}"):
        read_nuke_camera(tmp_path / "camera.nk")


@pytest.mark.parametrize("text", ["", "1 2 3", "1 0 0 0 0 0 0", "1 0 0 0 0 0 0 180", "a b c d e f g h",
                                  "1.5 0 0 0 0 0 0 40", "1 nan 0 0 0 0 0 40", "1e400 0 0 0 0 0 0 40"])
def test_a_damaged_chan_file_is_refused_by_name(text: str, tmp_path: Path) -> None:
    (tmp_path / "camera.chan").write_text(text)
    with pytest.raises(CaptureError, match=r"camera\.chan"):
        read_nuke_camera(tmp_path / "camera.chan")
