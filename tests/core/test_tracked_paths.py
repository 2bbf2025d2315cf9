# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths of lights through frames that do not show them."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.colour.srgb import linear_from_srgb
from core.images.homographies import HomographyMatcher, apply_homography
from core.lights import path_interpolation
from core.lights.tracks import track_lights
from tests.core.test_light_tracks import SIZE, Lamp, lit, make_shot

TURN_PX = 19
"""Pixels by which the background moves from frame to frame."""


def turning_frame(index: int, lamp: Lamp, contrast: float = 0.3) -> NDArray[np.float64]:
    """A lamp before a textured wall that goes to the left by TURN_PX a frame."""
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.random((SIZE[1], 1400)).astype(np.float32), (0, 0), 1.2)
    texture = linear_from_srgb(np.clip(0.35 + contrast * (wall - 0.5) * 6, 0, 0.75))
    left = TURN_PX * index
    return lit([lamp]) + texture[:, left:left + SIZE[0], None]


class TestStaticLight:
    def test_goes_with_the_background_out_of_the_frame(self, tmp_path: Path) -> None:
        path = [(230.0 - TURN_PX * i, 80.0) for i in range(18)]
        (light,) = track_lights(make_shot(tmp_path, 18, lambda i: turning_frame(i, (*path[i], 1.0)))).lights
        keys = [light.keys[f"{i + 1:04d}.png"] for i in range(17)]
        assert keys[-1].xy is not None and keys[-1].xy[0] < -60
        np.testing.assert_allclose([key.xy for key in keys], path[:17], atol=1.0)
        assert not light.doubtful

    def test_keeps_its_place_while_it_is_hidden_and_the_camera_turns_unevenly(self, tmp_path: Path) -> None:
        # The wall stays for a while and then moves on: a path from the light's own motion would miss by some 30 px.
        lefts = [0, 1, 2, 3, 3, 3, 3, 6, 9, 9, 9, 9, 9, 10, 11, 12]
        path = [(250.0 - TURN_PX * left, 70.0) for left in lefts]
        hidden = range(5, 11)
        (light,) = track_lights(make_shot(tmp_path, 16, lambda i: turning_frame(
            lefts[i], (*path[i], 0.0 if i in hidden else 1.0)))).lights
        keys = list(light.keys.values())
        np.testing.assert_allclose([key.xy for key in keys], path, atol=1.2)
        assert all(keys[i].on == 0 for i in hidden)

    def test_is_not_assumed_of_a_lamp_that_moves_before_the_wall(self, tmp_path: Path) -> None:
        path = [(60.0 + 15 * i, 80.0) for i in range(17)]
        (light,) = track_lights(make_shot(tmp_path, 17, lambda i: turning_frame(
            i, (*path[i], 0.0 if 6 <= i < 9 else 1.0)))).lights
        np.testing.assert_allclose([key.xy for key in list(light.keys.values())[:16]], path[:16], atol=2.5)

    def test_without_texture_continues_at_constant_velocity(self, tmp_path: Path) -> None:
        path = [(230.0 - TURN_PX * i, 80.0) for i in range(16)]
        (light,) = track_lights(make_shot(tmp_path, 16, lambda i: lit([(*path[i], 1.0)]))).lights
        assert light.doubtful


class TestInterpolation:
    @pytest.mark.parametrize("gap", [3, 5, 7])
    def test_keeps_the_acceleration_of_a_light_that_comes_back(self, gap: int) -> None:
        frames = np.arange(30)
        path = np.stack([150 + 190 * np.sin(frames / 4.6), 90 + 60 * np.cos(frames / 6)], 1)
        noisy = path + np.random.default_rng(1).normal(0, 0.3, path.shape)
        missing = range(12, 12 + gap)
        measured = np.array([frame for frame in frames if frame not in missing])
        between = path_interpolation.interpolate_path(measured, noisy[measured], 0.5)
        errors = [float(np.linalg.norm(between[frame] - path[frame])) for frame in missing]
        straight = np.linalg.norm(path[12 + gap // 2] - (path[11] + path[12 + gap]) / 2)
        assert sorted(between) == list(missing) and max(errors) < 0.2 * straight + 1

    def test_of_a_steady_motion_is_the_straight_line(self) -> None:
        frames = np.array([0, 1, 2, 3, 12, 13, 14])
        places = np.stack([10 + 5.0 * frames, 80 - 2.0 * frames], 1)
        between = path_interpolation.interpolate_path(frames, places, 0.5)
        for frame in range(4, 12):
            np.testing.assert_allclose(between[frame], [10 + 5 * frame, 80 - 2 * frame], atol=0.2)

    @pytest.mark.parametrize("frames", [[3], [3, 9], [2, 5, 9]])
    def test_of_few_measured_frames_stays_between_them(self, frames: list[int]) -> None:
        places = np.stack([4.0 * np.array(frames), np.full(len(frames), 7.0)], 1)
        between = path_interpolation.interpolate_path(np.array(frames), places, 0.5)
        assert sorted(between) == sorted({*range(frames[0], frames[-1] + 1)} - {*frames})
        for frame, place in between.items():
            np.testing.assert_allclose(place, [4 * frame, 7], atol=0.2)


class TestHomography:
    def test_maps_points_and_leaves_out_those_behind_the_camera(self) -> None:
        focal, turn = 300.0, np.radians(40)
        intrinsics = np.array([[focal, 0, 160], [0, focal, 90], [0, 0, 1]])
        rotation = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
        matrix = intrinsics @ rotation @ np.linalg.inv(intrinsics)
        points = np.array([[160.0, 90.0], [300.0, 40.0], [-2000.0, 90.0]])
        rays = (rotation @ np.linalg.inv(intrinsics) @ np.column_stack([points, np.ones(3)]).T).T
        expected = (rays / rays[:, 2:]) @ intrinsics.T
        mapped = apply_homography(-2.5 * matrix, points)  # a homography has no scale and no sign
        np.testing.assert_allclose(mapped[:2], expected[:2, :2], atol=1e-9)
        assert np.isnan(mapped[2]).all() and rays[2, 2] < 0

    def test_of_pictures_without_features_is_none(self) -> None:
        black = np.zeros((60, 80, 3), np.float32)
        match = HomographyMatcher(lambda _: black, 0.4).match("a", "b")
        assert match.matrix is None and match.inlier_share is None
