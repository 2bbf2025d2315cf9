# SPDX-License-Identifier: GPL-3.0-or-later
"""The sky about a far light is far, however plain; a plain wall about a lamp is not."""
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.capture import Camera, Capture
from core.capture.colmap import PointCloud
from core.capture.lights import Light
from core.fit.even_sky import Sky, segment_sky, select_far_lights
from core.fit.far_layer import find_far_layer
from core.fit.frames import Frames
from core.fit.sweep_views import SweepView
from tests.core.captures import look_at, make_capture, orbit

Floats = NDArray[np.float64]
SIZE = (96, 72)
PITCH = 1.7 / (0.9 * SIZE[0])
WALL_Z, WALL_TOP = 2.0, -0.3
"""The textured wall: its depth, and the height above which the sky shows; the world's y points down."""
SUN = 4000.0 * np.array([0.05, -0.16, 1.0])
LAMP = 7.0 * np.array([0.05, -0.16, 1.0])


def cast(camera: Camera) -> tuple[Floats, Floats]:
    """Return the rays (n, 3) of a camera's pixels, and where they meet the plane of the wall (n, 3), or far out."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.rays(np.stack([x.ravel(), y.ravel()], 1))
    return rays, camera.position + (WALL_Z - camera.position[2]) / np.maximum(rays[:, 2:], 0.05) * rays


def picture(camera: Camera, exposure: float = 1.0) -> NDArray[np.float32]:
    """Return what a camera sees, (height, width, 3): a textured wall below an even sky, brighter towards the horizon,
    with a plain grey door in the wall."""
    rays, wall = cast(camera)
    rng = np.random.default_rng(1)
    waves, phases = rng.normal(0, 9.0, (24, 3)), rng.uniform(0, 6, 24)
    colours = (0.45 + np.sin(wall @ waves.T + phases) @ rng.normal(0, 0.12, (24, 3))).clip(0, 1)
    colours[(np.abs(wall[:, 0]) < 0.6) & (wall[:, 1] > 0.3)] = 0.7
    elevation = -rays[:, 1:2] / np.linalg.norm(rays, axis=1, keepdims=True)
    sky = (np.array([0.95, 0.97, 1.0]) - elevation * (1.1, 0.8, 0.3)) * exposure
    colours = np.where(wall[:, 1:2] < WALL_TOP, sky.clip(0, 1), colours)
    return colours.reshape(camera.height, camera.width, 3).astype(np.float32)


def wall_points() -> NDArray[np.float32]:
    """Return points (300, 3) on the textured part of the wall."""
    xyz = np.random.default_rng(3).uniform((-3, WALL_TOP, WALL_Z), (3, 1.5, WALL_Z), (300, 3))
    return xyz[(np.abs(xyz[:, 0]) > 0.6) | (xyz[:, 1] < 0.3)].astype(np.float32)


def sweep(cameras: list[Camera]) -> list[SweepView]:
    return [SweepView(camera, picture(camera, 0.9 + 0.02 * (index % 6)), None) for index, camera in enumerate(cameras)]


def turned(camera: Camera, yaw: float) -> Camera:
    """Return a camera turned about the vertical by `yaw` radians."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]]
    return replace(camera, world_to_camera=pose @ camera.world_to_camera)


def shares(sky: Sky, view: SweepView) -> tuple[float, float]:
    """Return the shares of a view's pixels of sky, and of those of the wall, that are in directions of the sky."""
    rays, wall = cast(view.camera)
    found, is_sky = sky.contains(rays / np.linalg.norm(rays, axis=1, keepdims=True)), wall[:, 1] < WALL_TOP
    return float(found[is_sky].mean()), float(found[~is_sky].mean())


def test_segmentation_covers_the_even_sky_about_a_far_light_and_not_the_wall() -> None:
    views = sweep(orbit(9, size=SIZE))
    sky = segment_sky(views, SUN[None], wall_points(), PITCH)
    assert sky is not None
    for view, mask in zip(views, sky.masks, strict=True):
        in_sky, on_wall = shares(sky, view)
        assert in_sky > 0.9
        assert on_wall < 0.2, "only directions in which other views see above the wall, and those next to them"
        assert not mask[-20:].any(), "the door is plain, too"


def test_segmentation_propagates_to_views_without_the_light() -> None:
    cameras = orbit(9, size=SIZE)
    cameras = [camera if index < 2 else turned(camera, -0.08 * (index - 1)) for index, camera in enumerate(cameras)]
    views = sweep(cameras)
    assert sum(bool(camera.contains(*camera.project(SUN[None]))[0]) for camera in cameras) <= 4
    sky = segment_sky(views, SUN[None], wall_points(), PITCH)
    assert sky is not None
    assert min(shares(sky, view)[0] for view in views) > 0.9


def test_a_view_with_an_occluded_light_has_no_seed() -> None:
    views = sweep(orbit(9, size=SIZE))
    leaf = np.zeros((*SIZE[::-1], 1), np.float32)
    leaf[:34, 20:70] = 1
    hidden = [replace(view, picture=view.picture * (1 - leaf) + 0.15 * leaf) if index < 3 else view
              for index, view in enumerate(views)]
    sky = segment_sky(hidden, SUN[None], wall_points(), PITCH)
    assert sky is not None
    assert not any(mask[:30, 26:64].any() for mask in sky.masks[:3])
    assert min(shares(sky, view)[0] for view in views) > 0.9, "the sky goes on behind the leaf"


@pytest.mark.parametrize("place", [LAMP, -SUN], ids=["lamp", "behind"])
def test_without_a_far_light_in_view_there_is_no_sky(place: Floats) -> None:
    views = sweep(orbit(9, size=SIZE))
    assert segment_sky(views, SUN[None], wall_points(), PITCH) is not None
    lights = select_far_lights(place[None], wall_points(), [view.camera for view in views])
    assert len(lights) == (0 if place is LAMP else 1)
    assert segment_sky(views, lights, wall_points(), PITCH) is None


def test_a_light_occluded_in_every_view_gives_no_sky() -> None:
    views = [replace(view, picture=view.picture * 0.15) for view in sweep(orbit(9, size=SIZE))]
    assert segment_sky(views, SUN[None], wall_points(), PITCH) is None


def test_a_plain_surface_with_points_is_no_sky() -> None:
    """A white wall before the sun, on which the solve has points."""
    views = sweep(orbit(9, size=SIZE))
    x, y = np.meshgrid(np.linspace(-4, 4, 60), np.linspace(-3, WALL_TOP, 40))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, WALL_Z)], 1).astype(np.float32)
    assert segment_sky(views, SUN[None], np.concatenate([wall_points(), points]), PITCH) is None


def test_a_point_on_the_edge_of_the_frame_belongs_to_its_last_pixel() -> None:
    views = sweep(orbit(9, size=SIZE))
    camera = views[0].camera
    ray = camera.rays(np.array([[float(camera.width), float(camera.height)]]))[0]
    edge = (camera.position + 3 * ray / np.linalg.norm(ray)).astype(np.float32)
    assert segment_sky(views, SUN[None], np.concatenate([wall_points(), edge[None]]), PITCH) is not None


def test_a_region_that_covers_little_of_the_seed_is_no_sky() -> None:
    """Its edge lies two pixels from the sun, and it is as plain as the sky."""
    views, masks = [], []
    for view in sweep(orbit(9, size=SIZE)):
        column = int(view.camera.project(SUN[None])[0][0, 0]) + 2
        wall = np.zeros(view.picture.shape[:2], bool)
        wall[:, column:] = True
        views.append(replace(view, picture=np.where(wall[..., None], np.float32(0.55), view.picture)))
        masks.append(wall)
    sky = segment_sky(views, SUN[None], wall_points()[:40], PITCH)
    assert sky is not None
    for mask, wall in zip(sky.masks, masks, strict=True):
        assert (mask & wall).sum() <= 0.05 * wall.sum()


def test_sky_segmentation_is_limited_to_the_mask() -> None:
    views = sweep(orbit(9, size=SIZE))
    mask = np.ones(views[0].picture.shape[:2], bool)
    mask[:, 60:] = False
    sky = segment_sky([replace(view, mask=mask) for view in views], SUN[None], wall_points(), PITCH)
    assert sky is not None and all(found[:, :58].any() and not found[:, 62:].any() for found in sky.masks)


def test_a_lamp_that_shows_no_parallax_is_not_far_if_it_is_no_farther_than_the_room() -> None:
    cameras = [replace(camera, world_to_camera=look_at((0.01 * index, 0.0, -4.0))) for index, camera
               in enumerate(orbit(9, size=SIZE))]
    assert not len(select_far_lights(LAMP[None], wall_points(), cameras))
    assert len(select_far_lights(SUN[None], wall_points(), cameras))


@pytest.fixture(scope="module")
def castle(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """A capture of the wall below the sky, with points on the wall only."""
    folder = make_capture(tmp_path_factory.mktemp("castle") / "capture", 9, size=SIZE)
    for number, camera in enumerate(orbit(9, size=SIZE)):
        codes = (picture(camera)[..., ::-1] * 255 + 0.5).astype(np.uint8)
        cv2.imwrite(str(folder / "images" / f"{number:04d}.png"), codes)
    xyz = wall_points()
    points = PointCloud(xyz, np.full(xyz.shape, 128, np.uint8), np.zeros(len(xyz), np.float32))
    return Capture.open(folder).with_points(points, {})


def test_far_points_cover_the_sky_about_a_sun_in_its_colours(castle: Capture) -> None:
    capture = castle.with_lights([Light("sun", SUN)])
    layer = find_far_layer(capture, capture.views, Frames(capture))
    assert layer is not None
    for view in capture.views[::4]:
        pixels, depth = view.camera.project(layer.points.xyz)
        x, y = pixels[view.camera.contains(pixels, depth)].astype(int).T
        colours = layer.points.rgb[view.camera.contains(pixels, depth)]
        frame = picture(view.camera)
        is_sky = (cast(view.camera)[1][:, 1] < WALL_TOP).reshape(frame.shape[:2])
        covered = np.zeros(frame.shape[:2], np.uint8)
        covered[y, x] = 1
        is_covered = cv2.dilate(covered, np.ones((9, 9), np.uint8)) > 0
        assert is_covered[is_sky].mean() > 0.9
        above = is_sky[y, x]
        assert above.mean() > 0.6
        assert np.median(np.abs(frame[y, x][above] * 255 - colours[above])) < 6


def test_the_same_pictures_with_a_lamp_have_no_far_points(castle: Capture) -> None:
    for lights in ([], [Light("lamp", LAMP)], [Light("path", np.full(3, np.nan))]):
        capture = castle.with_lights(lights)
        assert find_far_layer(capture, capture.views, Frames(capture)) is None
