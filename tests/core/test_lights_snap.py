# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights that were given beside their flares are put where those are; others stay as they were given, to the bit."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from core.capture import Camera
from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.lights.snap import FlareView, flare_view, snap_lights
from tests.core.flared import HEIGHT, WIDTH, cameras

LAMP, SPOT = np.array([0.3, -0.6, 1.5]), np.array([-0.9, 0.3, 2.0])
SCALE = 3


def glow(small: Camera, lights: Sequence[tuple[NDArray[np.float64], float]]) -> FlareView:
    """Return a view of a grey scene with, for each (place, strength), a clipped core in its glow, and a ghost
    opposite."""
    camera = small.scaled(SCALE * WIDTH, SCALE * HEIGHT)
    across, down = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    scene = np.full((camera.height, camera.width), 0.1)
    flare = np.zeros_like(scene)
    for place, strength in lights:
        (pixel,), (depth,) = camera.project(place)
        if depth <= 0:
            continue
        away = np.hypot(across - pixel[0], down - pixel[1])
        scene = np.where(away < 3, 4.0, scene)
        flare += strength * (0.5 / (1 + (away / 4) ** 2) + 0.02 * np.exp(-0.5 * ((away - 25) / 3) ** 2))
        ghost = np.hypot(across - 2 * camera.cx + pixel[0], down - 2 * camera.cy + pixel[1])
        flare += strength * 0.05 * (ghost < 12)
    return seen_by(camera, scene, flare)


def seen_by(camera: Camera, scene: NDArray[np.float64], flare: NDArray[np.float64]) -> FlareView:
    """Of grey linear light (height, width)."""
    frame, clean = (np.repeat(srgb_from_linear(np.clip(light, 0, 1))[..., None], 3, -1).astype(np.float32)
                    for light in (scene + flare, scene))
    return flare_view(camera, frame, clean)


def ghosts_alone(small: Camera, light: NDArray[np.float64]) -> FlareView:
    """Return a view of what a light outside the frame leaves in it: two soft ghosts on its line through the centre."""
    camera = small.scaled(SCALE * WIDTH, SCALE * HEIGHT)
    across, down = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    (pixel,), _ = camera.project(light)
    flare = np.zeros((camera.height, camera.width))
    for mu in (0.5, -0.4):
        x, y = (middle + mu * (at - middle) for middle, at in zip((camera.cx, camera.cy), pixel, strict=True))
        flare += 0.3 * np.exp(-0.5 * (np.hypot(across - x, down - y) / 5) ** 2)
    return seen_by(camera, np.full_like(flare, 0.1), flare)


def sights(*lights: tuple[NDArray[np.float64], float]) -> list[FlareView]:
    return [glow(camera, lights) for camera in cameras(9)]


def off(seen: Sequence[FlareView], found: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Mean distance in the pictures, of their width."""
    return float(np.mean([np.linalg.norm(np.subtract(*(one.camera.project(place)[0][0] for place in (found, truth))))
                          / one.camera.width for one in seen]))


@pytest.mark.parametrize("moved", [(0.3, 0.2, -0.1), (-0.25, 0.3, 0.4), (0.0, -0.4, 0.0), (0.1, 0.0, -0.6)])
def test_a_light_beside_its_flare_is_snapped_to_it(moved: tuple[float, float, float]) -> None:
    seen = sights((LAMP, 1.0))
    given = LAMP + np.array(moved)
    found = snap_lights(seen, [given])[0]
    assert off(seen, given, LAMP) > 0.02
    assert off(seen, found, LAMP) < 0.004


def test_an_accurate_light_is_unchanged_beside_a_brighter_one() -> None:
    given = LAMP + np.array([0.004, -0.003, 0.01])
    assert (snap_lights(sights((LAMP, 1.0)), [given])[0] == given).all()
    near = LAMP + np.array([0.5, 0.1, 0.0])
    seen = sights((LAMP, 0.4), (near, 4.0))
    assert (snap_lights(seen, [LAMP])[0] == LAMP).all()
    assert (snap_lights(seen, [LAMP, near]) == [LAMP, near]).all()


def sun(small: Camera, light: NDArray[np.float64]) -> FlareView:
    """Return a view of a sun in a clipped part of the sky with its middle to the right of the sun, with glow and a
    ghost."""
    camera = small.scaled(SCALE * WIDTH, SCALE * HEIGHT)
    across, down = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    (pixel,), _ = camera.project(light)
    away = np.hypot(across - pixel[0], down - pixel[1])
    sky = np.hypot(across - pixel[0] - 0.07 * camera.width, down - pixel[1]) < 0.12 * camera.width
    ghost = np.hypot(across - pixel[0], down - pixel[1] - 0.2 * camera.width) < 0.02 * camera.width
    return seen_by(camera, np.where(sky, 3.0, 0.1), 0.2 / (1 + (away / 8) ** 2) + 0.2 * ghost)


def test_a_sun_in_a_clipped_sky_stays_where_it_is() -> None:
    far = np.array([3.0, -6.0, 80.0])
    views = [sun(camera, far) for camera in cameras(9)]
    assert any(view.observed is not None for view in views)
    assert (snap_lights(views, [far])[0] == far).all()


def test_a_lamp_of_a_usual_size_hides_nothing() -> None:
    assert all(view.observed is None for view in sights((LAMP, 1.0)))


def test_two_lights_find_one_flare_each() -> None:
    seen = sights((LAMP, 1.0), (SPOT, 0.5))
    given = np.add([LAMP, SPOT], [[0.2, 0.25, 0.1], [0.15, -0.3, 0.2]])
    found = snap_lights(seen, given)
    assert off(seen, found[0], LAMP) < 0.004 and off(seen, found[1], SPOT) < 0.004


def test_two_lights_do_not_climb_one_flare() -> None:
    """The second light has no flare of its own."""
    seen = sights((LAMP, 1.0))
    given = np.add(LAMP, [[0, 0, 0], [0.3, 0.1, 0.0]])
    assert (snap_lights(seen, given) == given).all()


@pytest.mark.parametrize("height", [-1.9, -2.3])
def test_a_light_out_of_frame_is_not_snapped_to_its_ghost(height: float) -> None:
    light = np.array([0.3, height, 1.5])
    assert all(camera.project(light)[0][0, 1] < 0 for camera in cameras(9))
    assert (snap_lights([ghosts_alone(camera, light) for camera in cameras(9)], [light])[0] == light).all()


def test_without_a_flare_nothing_moves() -> None:
    given = np.array([LAMP, SPOT])
    assert (snap_lights(sights(), given) == given).all()
    behind = np.array([[0.0, 0.0, -9.0]])
    assert (snap_lights(sights((LAMP, 1.0)), behind) == behind).all()
    assert snap_lights(sights((LAMP, 1.0)), np.zeros((0, 3))).shape == (0, 3)
    assert (snap_lights([], given) == given).all()


def test_the_brightness_of_a_flare_is_measured_in_linear_light() -> None:
    camera = cameras(1)[0]
    clean = np.full((camera.height, camera.width, 3), 0.5, np.float32)
    bright, dark = (float(linear_from_srgb(np.float32(value))) for value in (0.7, 0.5))
    np.testing.assert_allclose(flare_view(camera, clean + np.float32(0.2), clean).flare, bright - dark, rtol=1e-4)
