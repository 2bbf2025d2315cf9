# SPDX-License-Identifier: GPL-3.0-or-later
"""A part of a window or of a lit wall is no light, and a lamp that something hides in part stays one."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.capture import Camera, Capture
from core.images.picture import Picture
from core.lights import Detection, find_lights
from core.lights.detection import measure_detection
from core.lights.found_light import FoundLight
from core.lights.surfaces import detection_rate, shape_consistency, split_surfaces
from tests.core.captures import make_capture, orbit

SIZE = (320, 240)
PLACE = np.array([0.1, -0.1, 0.0])
RADIUS = 0.06
"""Radius of the lamp, world units."""


@pytest.fixture(scope="module")
def cameras() -> dict[str, Camera]:
    return {f"{number:04d}.png": camera for number, camera in enumerate(orbit(9, size=SIZE))}


def disc(camera: Camera, radius: float) -> NDArray[np.bool_]:
    """The mask (height, width) of a lamp at PLACE; radius in world units."""
    (pixel,), (depth,) = camera.project(PLACE[None])
    v, u = np.mgrid[:camera.height, :camera.width] + 0.5
    return np.asarray(np.hypot(u - pixel[0], v - pixel[1]) < radius * camera.fx / depth)


def light_of(masks: dict[str, NDArray[np.bool_]], far: bool = False) -> FoundLight:
    """The light that is detected with these masks (height, width), by name of the view."""
    found = []
    for name, mask in masks.items():
        v, u = np.nonzero(mask)
        tight = mask[v.min():v.max() + 1, u.min():u.max() + 1]
        found.append((name, Detection(np.array([u.mean(), v.mean()]) + 0.5, float(np.sqrt(mask.sum() / np.pi)), 1.0,
                                      np.ones(3), tight, (int(u.min()), int(v.min())), False)))
    radius = float(np.median([detection.radius for _, detection in found]))
    return FoundLight(PLACE, far, tuple(masks), 9, 0.5, 0.1, np.ones(3), radius, detections=tuple(found))


def stripe(mask: NDArray[np.bool_], number: int) -> NDArray[np.bool_]:
    """The part of a mask (height, width) that shows between two bars, another in each view."""
    columns = np.flatnonzero(mask.any(axis=0))
    part = mask.copy()
    part[:, :columns[len(columns) * (number % 3) // 3]] = False
    part[:, columns[(len(columns) * (number % 3 + 1) - 1) // 3] + 1:] = False
    return part


def dark(cameras: dict[str, Camera]) -> dict[str, NDArray[np.bool_]]:
    return {name: np.zeros(SIZE[::-1], bool) for name in cameras}


def is_lamp(light: FoundLight, cameras: dict[str, Camera], maps: dict[str, NDArray[np.bool_]]) -> bool:
    lamps, surfaces = split_surfaces([light], cameras, maps)
    assert len(lamps) + len(surfaces) == 1
    return bool(lamps)


def test_a_lamp_shows_one_shape_and_a_window_behind_bars_many(cameras: dict[str, Camera]) -> None:
    lamp = light_of({name: disc(camera, RADIUS) for name, camera in cameras.items()})
    consistency = shape_consistency(lamp, cameras)
    assert consistency is not None and consistency > 0.7 and is_lamp(lamp, cameras, dark(cameras))
    masks = [stripe(disc(camera, 2 * RADIUS), number) for number, camera in enumerate(cameras.values())]
    window = light_of(dict(zip(cameras, masks, strict=True)))
    assert not is_lamp(window, cameras, dark(cameras))
    assert is_lamp(replace(window, far=True), cameras, dark(cameras)), "a sun behind branches stays a light"


def test_a_disc_of_a_few_pixels_has_no_shape(cameras: dict[str, Camera]) -> None:
    masks = {name: stripe(disc(camera, 0.7 * RADIUS), number) for number, (name, camera) in enumerate(cameras.items())}
    spot = light_of(masks)
    assert spot.radius < 2.5 and shape_consistency(spot, cameras) is None and is_lamp(spot, cameras, dark(cameras))


def test_a_lamp_that_is_hidden_in_part_in_some_views_stays(cameras: dict[str, Camera]) -> None:
    masks = {name: disc(camera, RADIUS) for name, camera in cameras.items()}
    for number, name in enumerate(list(masks)[:5]):
        masks[name] = stripe(masks[name], number)
    assert is_lamp(light_of(masks), cameras, dark(cameras)), "its whole shape recurs in four of nine views"


def test_a_large_surface_is_bright_where_it_is_not_detected(cameras: dict[str, Camera]) -> None:
    masks = {name: disc(camera, 2 * RADIUS) for name, camera in cameras.items()}
    board = light_of(dict(list(masks.items())[:6]))
    assert is_lamp(board, cameras, dark(cameras)), "something may hide it in the other views"
    assert not is_lamp(board, cameras, masks)
    lit = replace(board, detections=tuple((name, replace(detection, surround=0.5))
                                          for name, detection in board.detections))
    assert is_lamp(lit, cameras, masks), "a glow on all sides"
    small = light_of({name: disc(camera, 0.5 * RADIUS) for name, camera in list(cameras.items())[:6]})
    assert is_lamp(small, cameras, masks), "a small lamp before a wall is missed in some views"
    rare = light_of({name: disc(camera, 0.5 * RADIUS) for name, camera in list(cameras.items())[:3]})
    assert detection_rate(rare, cameras, masks) == pytest.approx(1 / 3)
    assert not is_lamp(rare, cameras, masks), "what most views show bright without a spot is a wall"


def test_a_large_light_needs_views_that_show_it_whole(cameras: dict[str, Camera]) -> None:
    def cut(radius: float) -> FoundLight:
        light = light_of({name: disc(camera, radius) for name, camera in cameras.items()})
        return replace(light, detections=tuple((name, replace(detection, is_cut=True))
                                               for name, detection in light.detections))

    assert not is_lamp(cut(2 * RADIUS), cameras, dark(cameras))
    assert is_lamp(cut(0.5 * RADIUS), cameras, dark(cameras))
    assert shape_consistency(cut(RADIUS), cameras) is None


class Fixed:
    """A detector that finds these detections, a frame each."""

    def __init__(self, light: FoundLight) -> None:
        self.found = [detection for _, detection in light.detections]

    def detect(self, _picture: Picture) -> list[Detection]:
        return [self.found.pop(0)]


@pytest.mark.parametrize("lamp", [False, True])
def test_the_search_reports_surfaces_as_doubtful(tmp_path: Path, cameras: dict[str, Camera], lamp: bool) -> None:
    folder = make_capture(tmp_path / "capture", 9, size=SIZE)
    masks = {}
    for number, (name, camera) in enumerate(cameras.items()):
        masks[name] = disc(camera, RADIUS) if lamp else stripe(disc(camera, 2 * RADIUS), number)
        cv2.imwrite(str(folder / "images" / name), np.where(masks[name], 255, 40).astype(np.uint8))
    findings = find_lights(Capture.open(folder), Fixed(light_of(masks)))
    assert len(findings.lights) == lamp
    assert [light.rejection for light in findings.doubtful] == ([] if lamp else ["surface"])
    assert any("surfaces" in message for message in findings.messages) != lamp


@pytest.mark.parametrize(("dark_side", "surround"), [(False, 0.5), (True, 0.0)])
def test_the_surround_is_that_of_the_darker_sides(dark_side: bool, surround: float) -> None:
    v, u = np.mgrid[:60, :80] + 0.5
    mask = np.hypot(u - 40, v - 30) < 10
    linear = np.where(mask, 1.0, 0.5)
    if dark_side:
        linear[:, :30] = 0
    picture = Picture(np.repeat(linear[..., None], 3, axis=2).astype(np.float32), "linear")
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    tight = mask[rows[0]:rows[-1] + 1, columns[0]:columns[-1] + 1]
    detection = measure_detection(tight, (int(columns[0]), int(rows[0])), picture, picture.display(), 1.0)
    assert detection.surround == pytest.approx(surround, abs=1e-3)
