# SPDX-License-Identifier: GPL-3.0-or-later
"""Captures are read as they were written, whatever wrote them."""
from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest

from core.capture import Camera, Capture
from core.capture.ply import read_points
from core.errors import CaptureError, FrameError
from core.images.write import write_exr, write_png
from core.removal.jobs.provenance import has_exact_clean_frames
from tests.core.captures import SIZE, look_at, make_capture, make_transforms, orbit, picture


def test_a_text_model_is_read(tmp_path: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "c"))
    assert [view.name for view in capture.views] == ["0000.png", "0001.png", "0002.png", "0003.png"]
    for view, camera in zip(capture.views, orbit(4), strict=True):
        np.testing.assert_allclose(view.camera.world_to_camera, camera.world_to_camera, atol=1e-12)
        np.testing.assert_allclose(view.camera.intrinsics, camera.intrinsics)
        assert view.lens is None
    assert len(capture.points) == 20
    assert capture.points.rgb[3].tolist() == [3, 20, 30]
    assert capture.points.error[0] == 0.5
    assert not capture.has_clean_frames and not capture.has_truth and not capture.lights
    np.testing.assert_allclose(capture.frame(capture.views[2]).pixels, picture(2)[..., ::-1] / np.float32(255))


@pytest.mark.filterwarnings("error")
def test_errors_beyond_floats_are_clipped(tmp_path: Path) -> None:
    """Reprojection errors of points that float32 cannot hold become large and finite."""
    folder = make_capture(tmp_path / "c")
    points = folder / "sparse/0/points3D.txt"
    points.write_text("".join(" ".join([*line.split()[:7], "1e200", *line.split()[8:]]) + "\n"
                              for line in points.read_text().splitlines()))
    error = Capture.open(folder).points.error
    assert np.isfinite(error).all() and (error > 1e20).all()


@pytest.mark.filterwarnings("error")
def test_nan_colours_are_black(tmp_path: Path) -> None:
    """A NaN channel of a point's colour in a PLY is read as 0."""
    names = ("float x", "float y", "float z", "float red", "float green", "float blue")
    (tmp_path / "points.ply").write_text("\n".join([
        "ply", "format ascii 1.0", "element vertex 1", *(f"property {name}" for name in names), "end_header",
        "0 1 2 nan 1 0.5", ""]))
    assert read_points(tmp_path / "points.ply").rgb.tolist() == [[0, 255, 128]]


def test_binary_model_equals_text(tmp_path: Path) -> None:
    import pycolmap

    folder = make_capture(tmp_path / "c", model="OPENCV", params=(57, 58, 31, 25, -0.05, 0.01, 0.001, 0.002))
    text = Capture.open(folder)
    reconstruction = pycolmap.Reconstruction()
    reconstruction.read_text(str(folder / "sparse" / "0"))
    for file in (folder / "sparse" / "0").iterdir():
        file.unlink()
    reconstruction.write_binary(str(folder / "sparse" / "0"))
    binary = Capture.open(folder)
    assert [v.name for v in binary.views] == [v.name for v in text.views]
    for a, b in zip(binary.views, text.views, strict=True):
        np.testing.assert_allclose(a.camera.world_to_camera, b.camera.world_to_camera, atol=1e-12)
        assert a.lens is not None and b.lens is not None
        assert (a.lens.model, a.lens.params) == (b.lens.model, b.lens.params)
    order_a, order_b = np.argsort(binary.points.xyz[:, 0]), np.argsort(text.points.xyz[:, 0])
    np.testing.assert_array_equal(binary.points.xyz[order_a], text.points.xyz[order_b])
    np.testing.assert_array_equal(binary.points.rgb[order_a], text.points.rgb[order_b])


def test_transforms_json_equals_colmap(tmp_path: Path) -> None:
    ply = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\ncomment end_header?\n" + b"".join(
        b"property float %c\n" % c for c in b"xyz") + b"".join(
        b"property uchar %s\n" % c for c in (b"red", b"green", b"blue")) + b"end_header\n"
    ply += np.array([1, 2, 3], "<f4").tobytes() + bytes([9, 8, 7]) + np.zeros(3, "<f4").tobytes() + bytes(3)
    folder = make_transforms(tmp_path / "t", ply_file_path="points.ply",
                             applied_transform=[[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
    (folder / "points.ply").write_bytes(ply)
    capture = Capture.open(folder)
    assert [view.name for view in capture.views] == ["0000.png", "0001.png", "0002.png"]
    for view, camera in zip(capture.views, orbit(3), strict=True):
        np.testing.assert_allclose(view.camera.world_to_camera, camera.world_to_camera, atol=1e-9)
        assert view.camera.fx == 57.6
    assert capture.points.xyz[0].tolist() == [1, 2, 3] and capture.points.rgb[0].tolist() == [9, 8, 7]
    assert capture.frame(capture.views[0]).size == SIZE


def test_transforms_points_of_a_colmap_model_follow_the_applied_transform(tmp_path: Path) -> None:
    model = make_capture(tmp_path / "m")
    folder = make_transforms(tmp_path / "t", applied_transform=[[1, 0, 0, 5], [0, 0, 1, 0], [0, -1, 0, 0]])
    (folder / "colmap" / "sparse").mkdir(parents=True)
    (model / "sparse" / "0").rename(folder / "colmap" / "sparse" / "0")
    xyz = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    expected = np.stack([xyz[:, 0] + 5, xyz[:, 2], -xyz[:, 1]], axis=1)
    np.testing.assert_allclose(Capture.open(folder).points.xyz, expected, atol=1e-6)


def test_transforms_per_frame_intrinsics_and_names_without_suffix(tmp_path: Path) -> None:
    """Frames of transforms.json may have intrinsics of their own, lack a suffix, or leave sizes to the pictures."""
    folder = make_transforms(tmp_path / "t")
    meta = json.loads((folder / "transforms.json").read_text())
    meta["frames"][1].update(fl_x=70.0, cx=30.0)
    meta["frames"][2].update(k1=-0.1, p1=0.001)
    meta["frames"][0]["file_path"] = "images/0000"
    for key in ("w", "h", "fl_y", "cx", "cy"):
        del meta[key]
    (folder / "transforms.json").write_text(json.dumps(meta))
    first, second, third = Capture.open(folder).views
    assert first.name == "0000.png" and first.camera.intrinsics.tolist() == [[57.6, 0, 32], [0, 57.6, 24], [0, 0, 1]]
    assert (second.camera.fx, second.camera.fy, second.camera.cx) == (70.0, 70.0, 30.0)
    assert third.lens is not None and third.lens.model == "FULL_OPENCV"


def test_transforms_with_an_angle_and_a_fisheye(tmp_path: Path) -> None:
    """A transforms.json with a field of view in place of focal lengths is read, and its fisheye lens too."""
    folder = make_transforms(tmp_path / "t", camera_angle_x=1.0, camera_model="OPENCV_FISHEYE", k1=0.01)
    meta = json.loads((folder / "transforms.json").read_text())
    del meta["fl_x"], meta["fl_y"]
    (folder / "transforms.json").write_text(json.dumps(meta))
    lens = Capture.open(folder).views[0].lens
    assert lens is not None and lens.model == "THIN_PRISM_FISHEYE"
    assert lens.focal[0] == lens.focal[1] == pytest.approx(32 / np.tan(0.5))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr"])
def test_frames_of_every_format_are_read(tmp_path: Path, suffix: str) -> None:
    folder = make_capture(tmp_path / "c", suffix=".png" if suffix == ".exr" else suffix)
    if suffix == ".exr":
        text = (folder / "sparse/0/images.txt").read_text().replace(".png", ".exr")
        (folder / "sparse/0/images.txt").write_text(text)
        for i in range(4):
            bgr = picture(i).astype(np.float32) / 16
            write_exr(folder / "images" / f"{i:04d}.exr", dict(zip("BGR", np.moveaxis(bgr, 2, 0), strict=True)))
    capture = Capture.open(folder)
    frame = capture.frame(capture.views[1])
    assert frame.encoding == ("linear" if suffix == ".exr" else "srgb")
    expected = picture(1)[..., ::-1] / (16 if suffix == ".exr" else 255)
    tolerance = {".jpg": 0.02, ".exr": 0.01}.get(suffix, 1e-6)
    assert np.abs(frame.pixels - expected).mean() < tolerance


def test_sixteen_bit_frames_keep_their_depth(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    deep = picture(0, depth=np.uint16)
    cv2.imwrite(str(folder / "images" / "0000.png"), deep)
    capture = Capture.open(folder)
    np.testing.assert_allclose(capture.frame(capture.views[0]).pixels, deep[..., ::-1] / np.float32(65535))


def test_frames_at_a_uniform_scale_of_the_model_scale_the_camera(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    for i in range(4):
        cv2.imwrite(str(folder / "images" / f"{i:04d}.png"), picture(i, (32, 24)))
    capture = Capture.open(folder)
    assert capture.views[0].camera.size == (32, 24)
    assert capture.views[0].camera.intrinsics.tolist() == [[28.8, 0, 16], [0, 28.8, 12], [0, 0, 1]]
    assert capture.frame(capture.views[0]).size == (32, 24)


def test_a_capture_may_have_several_cameras(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    sparse = folder / "sparse" / "0"
    with open(sparse / "cameras.txt", "a") as file:
        file.write("7 SIMPLE_PINHOLE 32 24 30 16 12\n")
    text = (sparse / "images.txt").read_text().replace(" 1 0003.png", " 7 0003.png")
    (sparse / "images.txt").write_text(text)
    cv2.imwrite(str(folder / "images" / "0003.png"), picture(3, (32, 24)))
    capture = Capture.open(folder)
    assert [view.camera.width for view in capture.views] == [64, 64, 64, 32]
    assert capture.frame(capture.views[3], (16, 12)).size == (16, 12)


def test_frames_in_subfolders_keep_their_names(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    (folder / "images" / "cam a").mkdir()
    (folder / "images" / "0001.png").rename(folder / "images" / "cam a" / "0001.png")
    sparse = folder / "sparse" / "0"
    text = (sparse / "images.txt").read_text().replace(" 1 0001.png", " 1 cam a/0001.png")
    (sparse / "images.txt").write_text(text)
    capture = Capture.open(folder)
    assert capture.frame(capture.view("cam a/0001.png")).size == SIZE


def test_clean_frames_and_truth_are_read(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c", model="SIMPLE_RADIAL", params=(57.6, 32, 24, -0.1))
    (folder / "removed").mkdir()
    (folder / "truth" / "scene").mkdir(parents=True)
    for i in range(4):
        cv2.imwrite(str(folder / "removed" / f"{i:04d}.png"), picture(i))
        cv2.imwrite(str(folder / "truth" / "scene" / f"{i:04d}.tif"), picture(i, (32, 24)))
    write_exr(folder / "truth" / "flare" / "0001.exr", dict.fromkeys("RGB", np.full((48, 64), 3.0)))
    capture = Capture.open(folder)
    view = capture.views[1]
    assert capture.has_clean_frames and capture.has_truth
    removed, scene, flare = capture.clean_frame(view), capture.truth_scene(view), capture.truth_flare(view)
    assert removed is not None and scene is not None and flare is not None
    np.testing.assert_array_equal(removed.pixels, capture.frame(view).pixels)  # undistorted alike
    assert scene.size == SIZE and np.abs(scene.pixels - removed.pixels).mean() < 0.03
    assert flare.encoding == "linear" and np.allclose(flare.pixels, 3.0)
    assert capture.truth_flare(capture.views[0]) is None


def test_a_capture_has_clean_frames_only_if_every_view_has_one(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    (folder / "removed").mkdir()
    for i in range(4):
        cv2.imwrite(str(folder / "removed" / f"{i:04d}.png"), picture(i))
        capture = Capture.open(folder, need_frames=False)  # as Blender opens it
        assert capture.has_clean_frames == has_exact_clean_frames(capture) == (i == 3)


def test_clean_frames_may_have_another_suffix(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    (folder / "removed").mkdir()
    for i in range(4):
        cv2.imwrite(str(folder / "removed" / f"{i:04d}.png"), picture(i))
        (folder / "removed" / f"{i:04d}.png").rename(folder / "removed" / f"{i:04d}.PNG")
    assert Capture.open(folder).has_clean_frames
    for path in (folder / "removed").iterdir():
        path.rename(path.with_name(f"clean_{path.name}"))
    with pytest.raises(CaptureError, match=r"removed holds 4 pictures, the first clean_0000\.PNG, and none has"):
        Capture.open(folder)


def test_views_are_split_by_file_or_interval(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c", views=10)
    capture = Capture.open(folder)

    def names(holdout: str | int | Path | None) -> list[str]:
        train, test = capture.split(holdout)
        assert {v.name for v in train} | {v.name for v in test} == {v.name for v in capture.views}
        assert len(train) + len(test) == 10
        return [view.name[:4] for view in test]

    assert names(None) == ["0000", "0008"]
    assert names(5) == names("5") == ["0000", "0005"]
    assert names(0) == []
    (folder / "split.json").write_text('{"test": ["0003.png", "0001.png"]}')
    (tmp_path / "other.json").write_text('{"test": ["0009.png"]}')
    assert names(None) == ["0001", "0003"]
    assert names(tmp_path / "other.json") == names(str(tmp_path / "other.json")) == ["0009"]


def test_lights_are_read_and_checked(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    (folder / "lights.json").write_text(
        '{"lights": [{"name": "lamp", "xyz": [1, 2.5, -3], "support": 4}, {"name": "sun", "xyz": [0, -1e6, 0]}]}')
    lamp, sun = Capture.open(folder).lights
    assert (lamp.name, lamp.xyz.tolist()) == ("lamp", [1, 2.5, -3]) and sun.xyz[1] == -1e6


def test_a_capture_without_points_opens(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c", points=0)
    assert len(Capture.open(folder).points) == 0
    (folder / "sparse/0/points3D.txt").unlink()
    assert Capture.open(folder).points.xyz.shape == (0, 3)


def test_a_capture_without_frames_opens(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    for file in (folder / "images").iterdir():
        file.unlink()
    capture = Capture.open(folder, need_frames=False)
    assert len(capture.views) == 4
    with pytest.raises(FrameError, match=r"0000\.png is missing"):
        capture.frame(capture.views[0])


def test_frames_that_exist_set_the_size_where_none_are_needed(tmp_path: Path) -> None:
    """Layers are baked to lie over the frames, which may be smaller than those that were solved."""
    folder = make_capture(tmp_path / "c")
    solved = Capture.open(folder).views[0].camera
    size = solved.width // 2, solved.height // 2
    for file in (folder / "images").iterdir():
        write_png(file, np.zeros((size[1], size[0], 3)))
    (folder / "images" / "0001.png").unlink()
    (folder / "images" / "0002.png").write_bytes(b"none")
    capture = Capture.open(folder, need_frames=False)
    assert [view.camera.size for view in capture.views] == [size, solved.size, solved.size, size]
    assert capture.views[0].camera.fx == solved.fx / 2
    assert [view.camera.size for view in capture.with_frame_size(size).views] == [size, size, solved.size, size]
    assert capture.with_frame_size((33, 7)).views[1].camera.size == solved.size, "of another shape"


def test_the_jacobian_is_the_derivative_of_the_projection() -> None:
    camera, point = orbit(3)[1], np.array([0.2, -0.1, 0.3])
    moved = [(camera.project(point + step)[0][0] - camera.project(point - step)[0][0]) / 2e-5
             for step in 1e-5 * np.eye(3)]
    np.testing.assert_allclose(camera.jacobian(point), np.transpose(moved), rtol=1e-5, atol=1e-5)


def test_extent_and_camera() -> None:
    """A camera projects, casts rays, tests its frame and is scaled consistently."""
    camera = Camera(100, 50, 80, 90, 48, 26, look_at((1.0, 2.0, -3.0), (0.5, 0.0, 2.0)))
    np.testing.assert_allclose(camera.position, (1, 2, -3), atol=1e-12)
    np.testing.assert_allclose(camera.camera_to_world @ camera.world_to_camera, np.eye(4), atol=1e-12)
    pixels, depth = camera.project([(0.5, 0.0, 2.0), (0.7, 0.2, 3.0), (1.0, 2.0, -8.0)])
    np.testing.assert_allclose(pixels[0], (48, 26), atol=1e-9)
    assert (depth[:2] > 0).all() and depth[2] < 0
    assert camera.contains(pixels, depth).tolist() == [True, True, False]
    along = (0.7, 0.2, 3.0) - camera.position
    np.testing.assert_allclose(camera.rays(pixels)[1], along / np.linalg.norm(along), atol=1e-12)
    half = camera.scaled(50, 25).project([(0.7, 0.2, 3.0)])[0]
    np.testing.assert_allclose(half[0] * 2, pixels[1])


def test_the_extent_follows_the_cameras(tmp_path: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "c"))
    positions = np.array([view.camera.position for view in capture.views])
    assert capture.extent == pytest.approx(1.1 * np.linalg.norm(positions - positions.mean(0), axis=1).max())
    assert Capture.open(make_capture(tmp_path / "one", views=1)).extent == pytest.approx(
        np.median(np.linalg.norm(capture.points.xyz - orbit(1)[0].position, axis=1)), rel=1e-6)


def test_the_extent_reads_each_camera_a_few_times_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = Capture.open(make_capture(tmp_path / "c", views=12))
    calls, position = [], Camera.position.fget
    monkeypatch.setattr(Camera, "position", property(lambda camera: calls.append(camera) or position(camera)))
    assert capture.extent > 0
    assert len(calls) < 12 * 12 / 2


@pytest.mark.parametrize("slip", [0.0, 1e-15, 1e-7, 1e-4])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_the_extent_of_a_rotating_camera_is_that_of_its_points(slip: float, offset: float, tmp_path: Path) -> None:
    """The positions come from rotated vectors, whose rounding is no path."""
    whole = Capture.open(make_capture(tmp_path / "c"))
    random = np.random.default_rng(0)
    poses = [view.camera.world_to_camera.copy() for view in whole.views]
    for pose in poses:
        pose[:3, 3] = -pose[:3, :3] @ (np.array([0.4, 0.1, -5]) + offset + slip * random.normal(size=3))
    views = [replace(view, camera=replace(view.camera, world_to_camera=pose))
             for view, pose in zip(whole.views, poses, strict=True)]
    points = replace(whole.points, xyz=whole.points.xyz + offset)
    tripod = Capture(whole.folder, views, points, frames={view.name: whole.folder for view in views})
    away = np.linalg.norm(whole.points.xyz - (0.4, 0.1, -5), axis=1)
    assert tripod.extent == pytest.approx(np.median(away), rel=0.05)
    assert tripod.is_rotation_only and not whole.is_rotation_only


def test_the_picture_cache_is_bounded(tmp_path: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "c"), cache_bytes=2 * 64 * 48 * 12)
    first = capture.frame(capture.views[0])
    assert capture.frame(capture.views[0]) is first
    assert not first.pixels.flags.writeable
    for view in capture.views:
        capture.frame(view)
    again = capture.frame(capture.views[0])
    assert again is not first
    np.testing.assert_array_equal(again.pixels, first.pixels)


def test_memory_of_many_large_frames(tmp_path: Path) -> None:
    """A walk over many 1080p frames takes no more than the cache and a few frames."""
    size = (1920, 1080)
    folder = make_capture(tmp_path / "c", views=2, size=size, suffix=".jpg")
    images = folder / "sparse/0/images.txt"
    pose = images.read_text().splitlines()[1].split(" ", 1)[1].rsplit(" ", 1)[0]
    images.write_text("".join(f"{i} {pose} {i:04d}.jpg\n\n" for i in range(30)))
    for i in range(2, 30):
        (folder / "images" / f"{i:04d}.jpg").hardlink_to(folder / "images" / "0000.jpg")
    room = 100 << 20  # four frames of 25 MB
    capture = Capture.open(folder, cache_bytes=room)
    capture.frame(capture.views[0])
    process = psutil.Process()
    before = process.memory_info().rss
    most = 0
    for view in capture.views:
        capture.frame(view)
        most = max(most, process.memory_info().rss - before)
    assert most < room + (160 << 20)


def test_opening_needs_numpy_alone(tmp_path: Path) -> None:
    make_capture(tmp_path / "c", model="OPENCV", params=(57, 58, 31, 25, -0.05, 0.01, 0.001, 0.002))
    code = ("import sys; from core.capture import Capture; "
            f"c = Capture.open({str(tmp_path / 'c')!r}); assert len(c.views) == 4; "
            "bad = {'torch', 'cv2', 'OpenEXR', 'pycolmap', 'scipy', 'bpy'} & set(sys.modules); assert not bad, bad")
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_view_is_found_by_name(tmp_path: Path) -> None:
    capture = Capture.open(make_capture(tmp_path / "c"))
    assert capture.view("0002.png") is capture.views[2]
    with pytest.raises(CaptureError, match=r"9999\.png"):
        capture.view("9999.png")
