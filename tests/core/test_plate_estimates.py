# SPDX-License-Identifier: GPL-3.0-or-later
"""Plates are improved by neighbouring frames: missed ghosts go, light on walls and what hides the background stay."""
from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.fit.plate_estimates import PlateEstimator, ShotFrames

WIDTH, HEIGHT, FRAMES, CHOSEN = 240, 136, 24, 12
BOX = np.array([0.85, 0.25, 0.3], np.float32)
"""Colour of a box that crosses the picture."""
NAMES = [f"{number:04d}.png" for number in range(FRAMES)]
Pixels = NDArray[np.float32]


def _wall(width: int = WIDTH) -> Pixels:
    """A wall with texture of several sizes, display values."""
    random = np.random.default_rng(1)
    wall = np.full((HEIGHT, width, 3), 0.4, np.float32)
    for size in (2, 6, 15):
        coarse = random.uniform(-0.08, 0.08, (HEIGHT // size + 1, width // size + 1, 3)).astype(np.float32)
        wall += cv2.resize(coarse, (width, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return wall.clip(0.05, 0.95)


def _ghost(number: int) -> Pixels:
    """A ghost that moves through the shot, display values."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    inside = (x - 20 - 5 * number) ** 2 + (y - 40) ** 2 < 36
    return np.asarray(inside[..., None] * np.array([0.2, 0.12, 0.05]), np.float32)


@pytest.fixture(scope="module")
def standing() -> tuple[ShotFrames, dict[str, Pixels]]:
    """Frames of a standing camera with a ghost, whose estimated plates still hold all of the ghost; and the exact
    plates.

    The light on the wall changes, and a box crosses.
    """
    wall, frames, exact = _wall(), {}, {}
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for number, name in enumerate(NAMES):
        light = 1 + 0.3 * np.sin(number / 4) * np.exp(-((x - 40) ** 2 + (y - 20) ** 2) / 4000)[..., None]
        plate = (wall * light).astype(np.float32)
        plate[60:85, 4 * number:4 * number + 18] = BOX
        exact[name] = plate
        frames[name] = np.clip(plate + _ghost(number), 0, 1)
    return ShotFrames(frames, dict(frames)), exact


def test_a_ghost_that_the_network_misses_goes(standing: tuple[ShotFrames, dict[str, Pixels]]) -> None:
    """A small ghost that the network left in the plates is removed by the neighbouring frames."""
    shot, exact = standing
    name = NAMES[CHOSEN]
    plate = PlateEstimator(shot).estimate(name)
    ghost = _ghost(CHOSEN).max(-1) > 0
    before = np.abs(shot.frames[name] - exact[name])[ghost].mean()
    assert np.abs(plate - exact[name])[ghost].mean() < before / 3
    assert np.abs(plate - exact[name])[~ghost].mean() < 0.01


def _ring(number: int) -> Pixels:
    """A wide ring that moves through the shot, linear light."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    distance = np.hypot(x - 20 - 9 * number, y - 68)
    return np.asarray(0.05 * np.exp(-((distance - 34) / 9) ** 2)[..., None] * np.array([1.0, 0.8, 0.6]), np.float32)


def test_of_a_standing_camera_a_wide_flare_goes_and_light_on_walls_stays_where_the_network_removed_it(
        standing: tuple[ShotFrames, dict[str, Pixels]]) -> None:
    """With a standing camera a wide ring is removed, and lamp light that the network took off a wall returns."""
    _, exact = standing
    frames = {name: srgb_from_linear(np.clip(linear_from_srgb(plate) + _ring(number), 0, 1))
              for number, (name, plate) in enumerate(exact.items())}
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    lamp_spot = np.exp(-((x - 40) ** 2 + (y - 20) ** 2) / 4000)[..., None]
    network = {name: np.asarray(frame * (1 - 0.12 * lamp_spot), np.float32) for name, frame in frames.items()}
    estimator = PlateEstimator(ShotFrames(frames, network))
    assert estimator.alignment.stands
    plate, name = estimator.estimate(NAMES[CHOSEN]), NAMES[CHOSEN]
    ring = _ring(CHOSEN).max(-1) > 0.02
    missed = np.abs(frames[name] - exact[name])[ring].mean()
    assert np.abs(plate - exact[name])[ring].mean() < missed / 2
    spot = (lamp_spot[..., 0] > 0.7) & ~ring
    assert np.abs(plate - exact[name])[spot].mean() < np.abs(network[name] - exact[name])[spot].mean() / 2


def test_what_hides_the_background_stays(standing: tuple[ShotFrames, dict[str, Pixels]]) -> None:
    """A box that crosses the shot stays in the plate."""
    shot, _ = standing
    plate = PlateEstimator(shot).estimate(NAMES[CHOSEN])
    box = np.s_[62:83, 4 * CHOSEN + 2:4 * CHOSEN + 16]
    assert np.abs(plate[box] - BOX).max() < 0.02


def test_cleaned_neighbours_show_the_background(standing: tuple[ShotFrames, dict[str, Pixels]]) -> None:
    shot, exact = standing
    name = NAMES[CHOSEN]
    ghost = _ghost(CHOSEN).max(-1) > 0
    plate = PlateEstimator(shot).estimate(name, exact)
    assert np.abs(plate - exact[name])[ghost].mean() < 0.03


def test_frames_of_a_turning_camera_are_aligned() -> None:
    wall, frames, exact = _wall(WIDTH + 4 * FRAMES), {}, {}
    for number, name in enumerate(NAMES):
        exact[name] = wall[:, 4 * number:4 * number + WIDTH].copy()
        frames[name] = np.clip(exact[name] + _ghost(number), 0, 1)
    estimator = PlateEstimator(ShotFrames(frames, dict(frames)))
    assert not estimator.alignment.travels and not estimator.alignment.stands
    plate, ghost = estimator.estimate(NAMES[CHOSEN]), _ghost(CHOSEN).max(-1) > 0
    before = np.abs(frames[NAMES[CHOSEN]] - exact[NAMES[CHOSEN]])[ghost].mean()
    assert np.abs(plate - exact[NAMES[CHOSEN]])[ghost].mean() < before / 2


def test_frames_of_a_travelling_camera_are_aligned_by_flow() -> None:
    """The lower parts of the picture are nearer and move faster."""
    wall, frames, exact = _wall(WIDTH + 5 * FRAMES), {}, {}
    for number, name in enumerate(NAMES):
        exact[name] = np.concatenate([wall[top:top + 34, speed * number:speed * number + WIDTH]
                                      for top, speed in ((0, 1), (34, 2), (68, 4), (102, 5))])
        frames[name] = np.clip(exact[name] + _ghost(2 * number)[::-1], 0, 1)
    estimator = PlateEstimator(ShotFrames(frames, dict(frames)))
    assert estimator.alignment.travels
    name = NAMES[CHOSEN // 2]
    plate, ghost = estimator.estimate(name), frames[name] != exact[name]
    before = np.abs(frames[name] - exact[name])[ghost].mean()
    assert np.abs(plate - exact[name])[ghost].mean() < 0.75 * before
    assert np.abs(plate - exact[name])[~ghost].mean() < 0.01


def test_a_shot_of_one_frame_stays_as_it_is() -> None:
    picture = _wall()
    estimator = PlateEstimator(ShotFrames({"a": picture}, {"a": picture}))
    np.testing.assert_array_equal(estimator.estimate("a"), picture)
