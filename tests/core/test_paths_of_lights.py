# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights on paths in lights.json, and shots whose cameras are not solved."""
from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from core.capture import Capture, read_lights
from core.errors import CaptureError
from tests.core.captures import make_capture, picture

XY = {"0001.png": {"xy": [10.0, 20.0], "on": 1.0}, "0003.png": {"xy": [30.0, 10.0], "on": 0.5, "confidence": 0.4},
      "0004.png": {"xy": [34.0, 8.0], "on": 0.0}}


def make_shot(folder: Path, number: int = 5, size: tuple[int, int] = (64, 48)) -> Path:
    """Write frames 0001.png to N without a camera solve."""
    (folder / "images").mkdir(parents=True)
    for index in range(1, number + 1):
        cv2.imwrite(str(folder / "images" / f"{index:04d}.png"), picture(index, size))
    return folder


def write(folder: Path, *entries: dict[str, Any]) -> None:
    (folder / "lights.json").write_text(json.dumps({"lights": list(entries)}))


def states(capture: Capture) -> list[Any]:
    return [capture.light_state(capture.lights[0], view) for view in capture.views]


class TestPaths:
    def test_a_path_on_the_picture_is_interpolated_between_its_frames_and_holds_beyond_them(self, tmp_path: Path
                                                                                           ) -> None:
        write(make_shot(tmp_path), {"name": "torch", "frames": XY})
        capture = Capture.open(tmp_path, need_cameras=False)
        by_view = states(capture)
        np.testing.assert_allclose([state.xy for state in by_view], [[10, 20], [20, 15], [30, 10], [34, 8], [34, 8]])
        assert [state.on for state in by_view] == [1.0, 0.75, 0.5, 0.0, 0.0]
        assert [state.interpolated for state in by_view] == [False, True, False, False, True]
        assert [state.confidence for state in by_view] == [1.0, 0.4, 0.4, 1.0, 1.0]

    def test_interpolated_frames_are_counted(self, tmp_path: Path) -> None:
        write(make_shot(tmp_path), {"name": "torch", "frames": {**XY, "0099.png": {"xy": [1, 1]}}})
        capture = Capture.open(tmp_path, need_cameras=False)
        (missing, unknown) = capture.light_warnings
        assert "'torch' has no place in 2 of 5 frames (0002.png, 0005.png)" in missing
        assert "1 frames that are not in the capture (0099.png)" in unknown
        assert {missing, unknown} <= set(capture.warnings)

    def test_a_place_on_the_picture_lies_on_its_ray(self, tmp_path: Path) -> None:
        write(make_capture(tmp_path, 4), {"name": "lamp", "xy": [-8.0, 30.0]})
        capture = Capture.open(tmp_path)
        for view in capture.views:
            state = capture.light_state(capture.lights[0], view)
            np.testing.assert_allclose(view.camera.project(state.xyz)[0][0], [-8, 30], atol=1e-9)
            np.testing.assert_allclose(state.camera_xyz[2], capture.extent)

    def test_a_path_in_the_world_is_projected(self, tmp_path: Path) -> None:
        folder = make_capture(tmp_path, 4)
        names = [view.name for view in Capture.open(folder).views]
        write(folder, {"name": "car", "frames": {names[0]: {"xyz": [0, 0, 0]}, names[3]: {"xyz": [0.6, 0, 0]}}})
        capture = Capture.open(folder)
        for part, view in enumerate(capture.views):
            state = capture.light_state(capture.lights[0], view)
            np.testing.assert_allclose(state.xyz, [0.2 * part, 0, 0], atol=1e-12)
            np.testing.assert_allclose(state.xy, view.camera.project([[0.2 * part, 0, 0]])[0][0])

    def test_a_light_that_stands_may_go_out(self, tmp_path: Path) -> None:
        folder = make_capture(tmp_path, 4)
        names = [view.name for view in Capture.open(folder).views]
        write(folder, {"name": "lamp", "xyz": [0, 0, 0.5], "frames": {names[1]: {"on": 0.25}}})
        capture = Capture.open(folder)
        assert not capture.lights[0].moves and not capture.light_warnings
        assert [state.on for state in states(capture)] == [0.25] * 4
        assert not any(state.interpolated for state in states(capture))

    def test_a_light_behind_the_camera_has_no_pixel(self, tmp_path: Path) -> None:
        write(make_capture(tmp_path, 3), {"name": "sun", "xyz": [0, 0, -100]})
        assert all(np.isnan(state.xy).all() and state.camera_xyz[2] < 0 for state in states(Capture.open(tmp_path)))

    def test_files_of_lights_that_stand_are_read_as_before(self, tmp_path: Path) -> None:
        write(tmp_path, {"name": "lamp", "xyz": [1, 2, 3], "colour": [1, 1, 1], "support": 3})
        (light,) = read_lights(tmp_path / "lights.json")
        assert light.numbers == ["lamp", [1.0, 2.0, 3.0]] and not light.moves

    def test_a_light_on_a_path_stays_on_it_when_a_fit_moves_the_others(self, tmp_path: Path) -> None:
        write(make_shot(tmp_path), {"name": "torch", "frames": XY})
        capture = Capture.open(tmp_path, need_cameras=False).with_lights_at({"torch": np.zeros(3)})
        assert capture.lights[0].moves and states(capture)[0].xy.tolist() == [10, 20]


class TestShots:
    def test_frames_without_cameras_are_a_shot_if_the_caller_allows_it(self, tmp_path: Path) -> None:
        make_shot(tmp_path)
        with pytest.raises(CaptureError, match="no camera solve"):
            Capture.open(tmp_path)
        capture = Capture.open(tmp_path, need_cameras=False)
        assert [view.name for view in capture.views] == [f"{index:04d}.png" for index in range(1, 6)]
        assert not capture.has_cameras and capture.is_rotation_only and capture.extent == 1
        assert capture.views[0].camera.fx == pytest.approx(0.85 * 64) and "usual" in capture.focal_source
        assert not capture.reopen().has_cameras

    def test_a_folder_of_pictures_is_a_shot(self, tmp_path: Path) -> None:
        make_shot(tmp_path)
        assert len(Capture.open(tmp_path / "images", need_cameras=False).views) == 5

    def test_the_focal_length_is_the_callers_then_that_of_the_file(self, tmp_path: Path) -> None:
        make_shot(tmp_path)
        (tmp_path / "camera.json").write_text('{"focal_px": 100, "width": 128}')
        assert Capture.open(tmp_path, need_cameras=False).views[0].camera.fx == 50
        capture = Capture.open(tmp_path, need_cameras=False, focal=70)
        assert capture.views[0].camera.fx == capture.reopen().views[0].camera.fx == 70

    @pytest.mark.parametrize("text", ['{"focal_px": 0, "width": 64}', '{"focal_px": 100}', "[]",
                                      '{"focal_px": true, "width": 64}', '{"focal_px": 1e9, "width": 64}'])
    def test_an_impossible_focal_length_is_refused(self, tmp_path: Path, text: str) -> None:
        (make_shot(tmp_path) / "camera.json").write_text(text)
        with pytest.raises(CaptureError, match="focal"):
            Capture.open(tmp_path, need_cameras=False)

    def test_a_solved_capture_is_no_shot(self, tmp_path: Path) -> None:
        assert Capture.open(make_capture(tmp_path), need_cameras=False).has_cameras

    def test_a_folder_without_frames_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(CaptureError, match="no frames"):
            Capture.open(tmp_path, need_cameras=False)

    def test_places_in_the_world_need_cameras(self, tmp_path: Path) -> None:
        write(make_shot(tmp_path), {"name": "lamp", "xyz": [0, 0, 1]})
        with pytest.raises(CaptureError, match="no camera solve"):
            Capture.open(tmp_path, need_cameras=False)
