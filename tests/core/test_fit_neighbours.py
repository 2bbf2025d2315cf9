# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits of captures with masks or without points, and of scenes of another world or with a mip filter."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from core.capture import Camera, Capture, PointCloud
from core.errors import CaptureError
from core.fit import preset
from core.fit.frames import Frames, masked
from core.fit.initial_points import RANDOM_POINTS, ensure_points, triangulate_pair
from core.fit.metering import PointObservations
from core.fit.overrides import override_settings
from core.fit.settings import FitSettings
from core.fit.trainer import Trainer
from core.gaussians.loss import l1_ssim
from core.gaussians.ply import read_ply, write_ply
from core.gaussians.scene import SceneGaussians
from core.system.progress import Progress
from tests.core.captures import look_at, make_capture, make_transforms
from tests.core.flared import HEIGHT, WIDTH, flared_capture


def quick(**changes: object) -> FitSettings:
    return override_settings(preset("draft", iterations=20), {"flare.count": 20, "flare.occlusion": False, **changes})


def mask_left(folder: Path) -> Path:
    """Mask the left half of every frame."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, WIDTH // 2:] = 255
    (folder / "masks").mkdir()
    for path in (folder / "images").iterdir():
        cv2.imwrite(str(folder / "masks" / f"{path.stem}.png"), mask)
    return folder


# Masks.

def test_masked_pixels_have_no_loss_and_no_gradient() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(20, 24, 3, generator=generator, requires_grad=True)
    target = torch.rand(20, 24, 3, generator=generator)
    mask = torch.ones(20, 24, dtype=torch.bool)
    mask[:, :12] = False
    l1_ssim(masked(image, target, mask), target, 0.8).backward()
    assert image.grad is not None and not image.grad[:, :12].any() and image.grad[:, 12:].any()
    assert masked(image, target, None) is image
    assert float(l1_ssim(masked(image.detach(), target, mask & False), target, 0.8)) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("mode", ["default", "split", "estimated", "in-flare", "3dgs"])
def test_what_is_masked_changes_no_fit(tmp_path: Path, mode: str) -> None:
    """A passer-by in the masked half leaves the fitted scene as it is."""
    scenes = []
    for name in ("empty", "passer-by"):
        folder = mask_left(flared_capture(tmp_path / name, 6))
        if name == "passer-by":
            for layer in ("images", "removed"):
                for path in sorted((folder / layer).iterdir())[::2]:
                    frame = cv2.imread(str(path))
                    frame[10:30, 2:20] = (0, 0, 255)
                    cv2.imwrite(str(path), frame)
        trainer = Trainer(Capture.open(folder), quick(mode=mode, exposure="fixed"))
        for _ in range(8):
            trainer.step()
        scenes.append(torch.cat([value.flatten() for value in trainer.scene.state_dict().values()]))
    assert torch.equal(*scenes)


def test_exposures_are_not_measured_on_masked_points(tmp_path: Path) -> None:
    folder = mask_left(flared_capture(tmp_path / "c", 4))
    capture = Capture.open(folder)
    every = np.arange(len(capture.points))
    capture = capture.with_points(capture.points, {view.name: every for view in capture.views})
    observations = PointObservations.of(capture, capture.views, Frames(capture), Progress())
    assert len(observations.points)
    for number, view in enumerate(capture.views):
        seen = observations.points[observations.views == number]
        assert (view.camera.project(capture.points.xyz[seen])[0][:, 0] >= WIDTH // 2 - 1).all()


def test_another_mask_ends_a_resume(tmp_path: Path) -> None:
    """A fit does not resume after a mask was changed."""
    folder = mask_left(flared_capture(tmp_path / "c", 6))
    settings = quick(exposure="fixed")
    state = Trainer(Capture.open(folder), settings).state()
    Trainer(Capture.open(folder), settings).load_state(state)
    path = sorted((folder / "masks").iterdir())[1]
    cv2.imwrite(str(path), np.full((HEIGHT, WIDTH), 255, np.uint8))
    with pytest.raises(Exception, match="another frame, clean frame or camera"):
        Trainer(Capture.open(folder), settings).load_state(state)


# Poses without points.

def textured_capture(folder: Path, views: int = 5) -> Path:
    """Write a capture without points of a textured plane at z = 0, 4 units before the cameras."""
    size = (240, 160)
    make_capture(folder, views, size=size, points=0)
    plane = np.random.default_rng(3).uniform(0, 255, (60, 90, 3)).astype(np.uint8)
    plane = cv2.resize(plane, (900, 600), interpolation=cv2.INTER_CUBIC)
    for view in Capture.open(folder).views:
        camera = view.camera
        to_plane = np.array([[6 / 900, 0, -3], [0, 4 / 600, -2], [0, 0, 0], [0, 0, 1]])  # pixel of the plane to world
        projection = np.eye(3, 4) @ camera.world_to_camera
        homography = camera.intrinsics @ projection @ to_plane
        cv2.imwrite(str(folder / "images" / view.name), cv2.warpPerspective(plane, homography, size))
    return folder


def test_points_are_triangulated_from_matches(tmp_path: Path) -> None:
    capture = Capture.open(textured_capture(tmp_path / "c"))
    found, [sentence] = ensure_points(capture, quick(), Progress())
    assert "has no 3D points: the fit starts from" in sentence and "triangulated" in sentence
    triangulated = found.points.xyz
    assert len(triangulated) > 200 and np.quantile(np.abs(triangulated[:, 2]), 0.9) < 0.1
    view = found.views[2]
    assert len(view.points) > 50
    pixels, _ = view.camera.project(triangulated[view.points])
    colours = capture.frame(view).pixels[tuple(pixels.astype(int).clip(0, (239, 159)).T[::-1])]
    assert np.median(np.abs(colours - found.points.rgb[view.points] / 255)) < 0.1


@pytest.mark.parametrize("kind", ["blank frames", "one place", "parallel"])
def test_random_points_lie_in_the_cameras_view(tmp_path: Path, kind: str) -> None:
    folder = make_transforms(tmp_path / "c", 4)
    for path in (folder / "images").iterdir():
        cv2.imwrite(str(path), np.full((48, 64, 3), 90, np.uint8))
    capture = Capture.open(folder)
    if kind != "blank frames":
        place = (0, 0, -4) if kind == "one place" else None
        views = [replace(view, camera=replace(view.camera, world_to_camera=look_at(
            place or (i, 0, -4), (0.1 * i, 0, 0) if place else (i, 0, 0)))) for i, view in enumerate(capture.views)]
        capture = Capture(folder, views, PointCloud.empty(), frames={view.name: capture.frame_path(view)
                                                                     for view in capture.views})
    found, [sentence] = ensure_points(capture, quick(), Progress())
    assert "random ones in the cameras' view" in sentence and len(found.points) >= RANDOM_POINTS
    for camera in (view.camera for view in found.views):
        assert camera.contains(*camera.project(found.points.xyz)).mean() > 0.2
    assert (found.points.rgb == 90).all()
    again, _ = ensure_points(capture, quick(), Progress())
    np.testing.assert_array_equal(found.points.xyz, again.points.xyz)


def test_a_capture_with_points_keeps_them(tmp_path: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "c"))
    assert ensure_points(capture, quick(), Progress()) == (capture, ())


def test_a_pair_of_cameras_gives_the_points() -> None:
    """Triangulation from two views finds the points, and rejects a too distant one and a false match."""
    first, second = (Camera(640, 480, 500, 500, 320, 240, look_at((x, 0, -4))) for x in (-0.5, 0.5))
    xyz = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 3))
    xyz[0] = (0.0, 0.0, 4000.0)  # too far for the base
    pixels, others = first.project(xyz)[0], second.project(xyz)[0]
    others[1] += (0, 9)
    points, sound = triangulate_pair(first, second, pixels, others)
    assert not sound[0] and not sound[1] and sound[2:].all()
    np.testing.assert_allclose(points[2:], xyz[2:], atol=1e-9)


# Scenes from elsewhere.

def scene_at(xyz: np.ndarray) -> SceneGaussians:
    return SceneGaussians.from_points(PointCloud(xyz.astype(np.float32), np.full((len(xyz), 3), 128, np.uint8),
                                                 np.zeros(len(xyz), np.float32)))


@pytest.mark.parametrize("offset", [(0, 0, -60), (500, 0, 0), (0, 1e6, 0)])
def test_a_scene_of_another_world_is_refused(tmp_path: Path, offset: tuple[float, float, float]) -> None:
    capture = Capture.open(flared_capture(tmp_path / "c", 6))
    write_ply(tmp_path / "s.ply", scene_at(capture.points.xyz + np.array(offset)))
    with pytest.raises(CaptureError, match=r"s\.ply is of another world .*: 5 of 5 views have none of its 150"):
        Trainer(capture, quick(**{"scene.start": str(tmp_path / "s.ply"), "scene.frozen": True}))
    stray = np.concatenate([capture.points.xyz + np.array(offset), capture.views[1].camera.position[None]
                            + capture.views[1].camera.rays([(0.5, 0.5)])])
    write_ply(tmp_path / "s.ply", scene_at(stray))
    with pytest.raises(CaptureError, match=r"s\.ply is of another world"):
        Trainer(capture, quick(**{"scene.start": str(tmp_path / "s.ply"), "scene.frozen": True}))
    write_ply(tmp_path / "s.ply", scene_at(capture.points.xyz))
    Trainer(capture, quick(**{"scene.start": str(tmp_path / "s.ply"), "scene.frozen": True}))


@pytest.mark.parametrize("comment", ["SplatRenderMode: mip", "antialiased 1", "antialiased: true",
                                     "rasterize_mode antialiased", "splatrendermode mip"])
def test_a_mip_filter_is_read_and_kept(tmp_path: Path, comment: str) -> None:
    write_ply(tmp_path / "s.ply", scene_at(np.eye(3)), comments=[comment])
    scene = read_ply(tmp_path / "s.ply")
    assert scene.antialiased
    write_ply(tmp_path / "again.ply", scene)
    assert read_ply(tmp_path / "again.ply").antialiased


@pytest.mark.parametrize("comment", ["SplatRenderMode: default", "antialiased 0", "mip", "made by mip 1"])
def test_other_comments_name_no_mip_filter(tmp_path: Path, comment: str) -> None:
    write_ply(tmp_path / "s.ply", scene_at(np.eye(3)), comments=[comment])
    assert not read_ply(tmp_path / "s.ply").antialiased


@pytest.mark.parametrize("kernels", ["torch", "cpu", "tiles"])
def test_thin_gaussians_of_a_mip_filter_are_as_faint_as_they_are_thin(kernels: str) -> None:
    """With opacity a, sizes (x, y) and a filter of 0.3 px², the light is that of the Gaussian without the filter."""
    camera = Camera(32, 32, 100.0, 100.0, 16.5, 16.5, np.eye(4))
    scene = SceneGaussians(torch.tensor([[0.0, 0, 10]]), torch.tensor([[0.3, 0.02, 0.02]]).log(),
                           torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([0.0]), torch.zeros(1, 16, 3))
    plain = scene.render(camera, kernels=kernels).alpha
    scene.antialiased = True
    filtered = scene.render(camera, kernels=kernels).alpha
    x, y = 9.0, 0.04  # variances, px²
    ratio = np.sqrt(x * y / ((x + 0.3) * (y + 0.3)))
    assert ratio < 0.35
    np.testing.assert_allclose((filtered[16, 16] / plain[16, 16]).item(), ratio, rtol=1e-3)
    filtered.sum().backward()
    assert all(parameter.grad is None or parameter.grad.isfinite().all() for parameter in scene.parameters())


def test_a_fit_refines_a_scene_with_a_mip_filter(tmp_path: Path) -> None:
    capture = Capture.open(flared_capture(tmp_path / "c", 6))
    write_ply(tmp_path / "s.ply", scene_at(capture.points.xyz), comments=["SplatRenderMode: mip"])
    trainer = Trainer(capture, quick(**{"scene.start": str(tmp_path / "s.ply")}))
    first = trainer.step()["scene_loss"]
    for _ in range(11):
        last = trainer.step()["scene_loss"]
    assert trainer.scene.antialiased and last < first
    trainer.check_finite()


@pytest.mark.parametrize(("name", "value", "read"), [("opacity", np.inf, 1.0), ("opacity", -np.inf, 0.0),
                                                     ("scale_1", -np.inf, 0.0), ("scale_2", -np.inf, 0.0)])
def test_legal_infinities_of_gaussians_are_read(tmp_path: Path, name: str, value: float, read: float) -> None:
    write_ply(tmp_path / "s.ply", scene_at(np.eye(3)))
    data = (tmp_path / "s.ply").read_bytes()
    head, body = data.split(b"end_header\n", 1)
    names = [line.split()[-1].decode() for line in head.splitlines() if line.startswith(b"property")]
    table = np.frombuffer(body, "<f4").reshape(3, -1).copy()
    table[1, names.index(name)] = value
    (tmp_path / "s.ply").write_bytes(head + b"end_header\n" + table.tobytes())
    scene = read_ply(tmp_path / "s.ply")
    values = scene.opacities if name == "opacity" else scene.scales[:, int(name[-1])]
    assert float(values[1].detach()) == pytest.approx(read, abs=1e-8)
    assert all(parameter.isfinite().all() for parameter in scene.parameters())
    camera = Camera(64, 48, 60, 60, 32, 24, look_at((0, 0, -4), (0.3, 0.3, 0.3)))
    assert scene.render(camera).colour.isfinite().all()
