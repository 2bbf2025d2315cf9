# SPDX-License-Identifier: GPL-3.0-or-later
"""A gap through which a bright far surrounding shows is no light, and a lamp in front of a board stays one."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.capture import Camera, Capture
from core.images.picture import Picture
from core.lights import Detection, find_lights
from core.lights.found_light import FoundLight
from core.lights.surroundings import brightness_map, explained_share, split_gaps
from tests.core.captures import make_capture, orbit

SIZE = (160, 120)
GAP = np.array([0.1, -0.1, 0.0])


def seen_through(camera: Camera, lamp: bool) -> NDArray[np.float32]:
    """Return a frame (height, width, 3) of a board in the plane z = 0.

    Without `lamp` the board has a hole, through which a bright band of the far sky shows; with it there is a bright
    lamp in place of the hole, and no band.
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.rays(np.stack([x.ravel(), y.ravel()], 1))
    wall = camera.position - camera.position[2] / rays[:, 2:] * rays
    away = np.linalg.norm(wall - GAP, axis=1)
    board = (np.abs(wall[:, :2] - GAP[:2]) < 0.35).all(1)
    bright = away < 0.06 if lamp else (np.abs(rays[:, 1]) < 0.12) & (~board | (away < 0.06))
    return np.repeat(np.where(bright, 1.0, 0.15), 3).reshape(camera.height, camera.width, 3).astype(np.float32)


def detection(camera: Camera) -> Detection:
    return Detection(camera.project(GAP[None])[0][0], 2.0, 1.0, np.ones(3), np.ones((3, 3), bool), (1, 1), False)


def light(cameras: dict[str, Camera], far: bool = False) -> FoundLight:
    return FoundLight(GAP, far, tuple(cameras), len(cameras), 0.5, 0.1, np.ones(3), 2.0,
                      detections=tuple((name, detection(camera)) for name, camera in cameras.items()))


@pytest.fixture(scope="module")
def cameras() -> dict[str, Camera]:
    return {f"{number:04d}.png": camera for number, camera in enumerate(orbit(9, size=SIZE))}


def maps_of(cameras: dict[str, Camera], lamp: bool) -> dict[str, NDArray[np.bool_]]:
    return {name: brightness_map(Picture(seen_through(camera, lamp), "srgb")) for name, camera in cameras.items()}


def test_a_bright_surrounding_explains_a_gap_and_not_a_lamp(cameras: dict[str, Camera]) -> None:
    shares = [explained_share(light(cameras), cameras, maps_of(cameras, lamp)) for lamp in (False, True)]
    assert shares[0] is not None and shares[0] > 0.5
    assert shares[1] is not None and shares[1] < 0.05
    lamps, gaps = split_gaps([light(cameras)], cameras, maps_of(cameras, False))
    assert (len(lamps), len(gaps)) == (0, 1)
    lamps, gaps = split_gaps([light(cameras)], cameras, maps_of(cameras, True))
    assert (len(lamps), len(gaps)) == (1, 0)


def test_over_exposed_frames_explain_nothing(cameras: dict[str, Camera]) -> None:
    white = {name: np.ones(SIZE[::-1], bool) for name in cameras}
    assert split_gaps([light(cameras)], cameras, white)[1] == []


def test_a_sun_in_a_bright_sky_is_not_taken_for_a_gap(cameras: dict[str, Camera]) -> None:
    white = {name: np.ones(SIZE[::-1], bool) for name in cameras}
    assert explained_share(light(cameras, far=True), cameras, white) is None
    still = dict.fromkeys(cameras, cameras["0000.png"])
    assert explained_share(light(still), still, white) is None, "without parallax no view decides"


class Fixed:
    """A detector that finds the place in every frame."""

    def __init__(self, cameras: dict[str, Camera]) -> None:
        self.found = [detection(camera) for camera in cameras.values()]

    def detect(self, _picture: Picture) -> list[Detection]:
        return [self.found.pop(0)]


@pytest.mark.parametrize("lamp", [False, True])
def test_the_search_reports_gaps_as_doubtful(tmp_path: Path, cameras: dict[str, Camera], lamp: bool) -> None:
    folder = make_capture(tmp_path / "capture", 9, size=SIZE)
    for name, camera in cameras.items():
        cv2.imwrite(str(folder / "images" / name), (seen_through(camera, lamp) * 255).astype(np.uint8))
    findings = find_lights(Capture.open(folder), Fixed(cameras))
    assert len(findings.lights) == lamp and len(findings.doubtful) == (not lamp)
    assert any("gaps" in message for message in findings.messages) != lamp
