# SPDX-License-Identifier: GPL-3.0-or-later
"""The far layer: what lies beyond the parallax of a capture is found, stays on its sphere, and hides no light."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from core.capture import Camera, Capture
from core.capture.colmap import PointCloud
from core.fit import checkpoint
from core.fit.far_layer import SweepView, classify_patches, find_far_layer
from core.fit.frames import Frames
from core.fit.initialise import initial_scene
from core.fit.overrides import override_settings
from core.fit.settings import preset
from core.fit.trainer import Trainer
from core.flare.visibility import light_visibility
from core.gaussians.densification import Classic, ClassicSettings, Mcmc
from core.gaussians.far_sphere import FarSphere
from core.gaussians.optimiser import Adam
from core.gaussians.ply import read_ply, write_ply
from core.gaussians.scene import SceneGaussians
from tests.core.captures import make_capture, orbit

Floats = NDArray[np.float64]
SIZE = (80, 60)


def texture(points: Floats, seed: int) -> Floats:
    """Return smooth random colours (n, 3) of points (n, 3), of about a quarter of a unit."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 9.0, (24, 3))
    phases, amplitudes = rng.uniform(0, 6, 24), rng.normal(0, 0.12, (24, 3))
    return np.asarray((0.5 + np.sin(points @ waves.T + phases) @ amplitudes).clip(0, 1))


def picture(camera: Camera, radius: float) -> NDArray[np.float32]:
    """Return what a camera sees, (height, width, 3): a textured board at the origin, inside a textured sphere of
    `radius`."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.rays(np.stack([x.ravel(), y.ravel()], 1))
    middle = camera.position @ rays.T
    along = -middle + np.sqrt(middle**2 - camera.position @ camera.position + radius**2)
    surround = texture((camera.position + along[:, None] * rays) / radius, 1)
    board = camera.position - camera.position[2] / rays[:, 2:] * rays
    is_board = (np.abs(board[:, :2]) < (0.7, 0.5)).all(1)
    colours = np.where(is_board[:, None], texture(board / 2, 2), surround)
    return colours.reshape(camera.height, camera.width, 3).astype(np.float32)


def sweep(radius: float, plain: bool = False) -> list[SweepView]:
    cameras = orbit(12, size=SIZE)
    return [SweepView(camera, np.full((*SIZE[::-1], 3), 0.5, np.float32) if plain else picture(camera, radius), None)
            for camera in cameras]


@pytest.fixture(scope="module")
def exterior(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """A capture of the board before a far surrounding, with points on the board only."""
    folder = make_capture(tmp_path_factory.mktemp("exterior") / "capture", 12, size=SIZE)
    for number, camera in enumerate(orbit(12, size=SIZE)):
        codes = (picture(camera, 1e6)[..., ::-1] * 255 + 0.5).astype(np.uint8)
        cv2.imwrite(str(folder / "images" / f"{number:04d}.png"), codes)
    capture = Capture.open(folder)
    xyz = np.random.default_rng(3).uniform((-0.7, -0.5, 0), (0.7, 0.5, 0), (60, 3))
    rgb = (texture(xyz / 2, 2) * 255).astype(np.uint8)
    return capture.with_points(PointCloud(xyz.astype(np.float32), rgb, np.zeros(60, np.float32)), {})


def test_a_surrounding_without_parallax_is_far_and_a_room_is_not() -> None:
    patches = classify_patches(sweep(1e6))
    assert patches is not None
    assert patches.are_far(np.array([[0.5, 0.05, 0.9], [-0.5, 0.0, 0.9], [0.0, -0.35, 0.95]])).all()
    assert classify_patches(sweep(8.0)) is None
    assert classify_patches(sweep(70.0)) is None, "a parallax of two pixels is one"
    assert classify_patches(sweep(8.0, plain=True)) is None, "a plain wall says nothing"


def test_a_board_in_front_of_a_far_surrounding_is_not_far(exterior: Capture) -> None:
    views, frames = exterior.views, Frames(exterior)
    layer = find_far_layer(exterior, views, frames)
    assert layer is not None
    centre = np.array(layer.sphere.centre)
    np.testing.assert_allclose(np.linalg.norm(layer.points.xyz - centre, axis=1), layer.sphere.radius, rtol=1e-4)
    view = views[6]
    pixels, depth = view.camera.project(layer.points.xyz)
    shown = view.camera.contains(pixels, depth)
    x, y = pixels[shown].astype(int).T
    codes = (frames.frame(view).numpy()[y, x] * 255)
    differences = np.abs(codes - layer.points.rgb[shown]).mean(1)
    on_board = (np.abs(pixels[shown] - np.array(SIZE) / 2) < np.array(SIZE) * (0.1, 0.1)).all(1)
    assert shown.sum() > 150 and on_board.sum() < 0.1 * shown.sum()
    assert np.median(differences) < 12


def test_the_far_layer_has_no_parallax_in_the_frames(exterior: Capture) -> None:
    layer = find_far_layer(exterior, exterior.views, Frames(exterior))
    assert layer is not None
    focal = exterior.views[0].camera.focal_length
    assert exterior.extent / 1.1 * focal / layer.sphere.radius <= 0.25 + 1e-6


def test_a_capture_without_parallax_or_without_far_parts_has_no_far_layer(tmp_path: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "random", 6))
    assert find_far_layer(capture, capture.views, Frames(capture)) is None
    settings = preset("draft", mode="3dgs", iterations=10)
    assert initial_scene(capture, settings, capture.views, Frames(capture)).far is None


def test_far_gaussians_stay_on_their_sphere_while_they_turn(exterior: Capture) -> None:
    settings = preset("draft", mode="3dgs", iterations=15)
    trainer = Trainer(exterior, settings)
    sphere = trainer.scene.far
    assert sphere is not None
    rows = trainer.scene.far_rows()
    assert 0 < len(rows) < len(trainer.scene)
    before = trainer.scene.means.detach()[rows]
    trainer.step()
    angles = (trainer.scene.means.detach()[rows] - before).norm(dim=-1) / sphere.radius
    assert float(angles.max()) > 1e-5, "a step of the means' rate at the extent"
    for _ in range(14):
        trainer.step()
    far = trainer.scene.means.detach()[trainer.scene.far_rows()]
    distances = (far - torch.tensor(sphere.centre)).norm(dim=-1)
    torch.testing.assert_close(distances, torch.full_like(distances, sphere.radius), rtol=0.05, atol=0)
    assert trainer.losses and max(trainer.losses.values()) < 0.5


def test_a_resumed_fit_with_a_far_layer_equals_an_uninterrupted_one(tmp_path: Path, exterior: Capture) -> None:
    settings = preset("draft", mode="3dgs", iterations=16)
    whole, first = Trainer(exterior, settings), Trainer(exterior, settings)
    for number in range(16):
        whole.step()
        if number < 7:
            first.step()
    checkpoint.save(tmp_path / "state.pt", first.state())
    resumed = Trainer(exterior, settings)
    resumed.load_state(checkpoint.load(tmp_path / "state.pt"))
    while resumed.iteration < 16:
        resumed.step()
    assert torch.equal(resumed.scene.means, whole.scene.means)


def with_far_layer(opacity: float = 0.9) -> SceneGaussians:
    """Return a scene of two near Gaussians with a far layer of two on +z. opacity: of the far layer."""
    points = PointCloud(np.array([[0, 0, 5], [1, 0, 5]], np.float32), np.full((2, 3), 128, np.uint8),
                        np.zeros(2, np.float32))
    far = PointCloud(np.array([[0, 0, 1000], [9, 0, 1000]], np.float32), np.full((2, 3), 90, np.uint8),
                     np.zeros(2, np.float32))
    scene = SceneGaussians.from_points(points)
    scene.add_far_layer(far, FarSphere((0.0, 0.0, 0.0), 1000.0), opacity)
    return scene


def test_the_far_layer_of_a_scene_is_exported_and_read(tmp_path: Path) -> None:
    scene = with_far_layer()
    write_ply(tmp_path / "scene.ply", scene)
    restored = read_ply(tmp_path / "scene.ply")
    assert restored.far == scene.far and torch.equal(restored.means, scene.means)
    assert restored.far_rows().tolist() == [2, 3]
    text = (tmp_path / "scene.ply").read_bytes()
    for damaged in (b"far_sphere 0 0 0 nan", b"far_sphere 0 0 0 -10", b"far_sphere 0 0 zero 1000"):
        (tmp_path / "damaged.ply").write_bytes(text.replace(b"far_sphere 0 0 0 1000", damaged))
        assert read_ply(tmp_path / "damaged.ply").far is None


@pytest.mark.parametrize("distance", [100.0, 5000.0])
def test_the_far_layer_hides_no_light_however_far_that_is(distance: float) -> None:
    scene = with_far_layer(0.99)
    with torch.no_grad():
        scene.opacity_logits[:2] = -20.0
        scene.log_scales[2:] = 6.0
    camera, light = torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0.0, distance], dtype=torch.float64)
    assert float(light_visibility(scene, camera, light).detach()) > 0.99
    scene.far = None
    hidden = float(light_visibility(scene, camera, light).detach())
    assert (hidden < 0.1) == (distance > 1000), "the same Gaussians of a scene without a far layer"


def test_densification_measures_far_gaussians_by_angle() -> None:
    scene = with_far_layer()
    adam = Adam(dict(scene.named_parameters()), 0.0)
    strategy = Classic(scene, adam, 5.0, torch.Generator().manual_seed(0),
                       ClassicSettings(start=0, every=1, reset_every=1))
    with torch.no_grad():
        scene.log_scales[:] = np.log(0.1)
        scene.log_scales[2] = np.log(20.0)  # as 0.1 at the extent
        scene.log_scales[3] = np.log(500.0)
    assert isinstance(scene.units(5.0), torch.Tensor)
    strategy.update(2)
    assert len(scene.far_rows()) == 1, "the large one is pruned, the other is not"
    mcmc = Mcmc(scene, adam, torch.Generator().manual_seed(0), extent=5.0)
    assert float(mcmc.regulariser()) < 0.1


def test_a_plain_scene_has_units_of_one() -> None:
    scene = with_far_layer()
    scene.far = None
    assert scene.units(5.0) == 1.0 and not len(scene.far_rows())


def test_the_far_layer_can_be_switched_off(exterior: Capture) -> None:
    settings = override_settings(preset("draft", mode="3dgs", iterations=10), {"scene.far_layer": False})
    assert initial_scene(exterior, settings, exterior.views, Frames(exterior)).far is None
    assert replace(settings.scene, far_layer=True) == preset("draft", mode="3dgs", iterations=10).scene
