# SPDX-License-Identifier: GPL-3.0-or-later
"""Structure from motion on small rendered shots, and every way in which there is nothing to solve."""
from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.capture import Camera, Capture
from core.capture.camera import quaternion_from_rotation, rotation_from_quaternion
from core.capture.colmap import ObservedFrame, PointCloud, read_model, write_model
from core.capture.lens import Lens
from core.capture.solve import SolveSettings, develop, solve
from core.capture.solve.mapping import Model, Solved, SolvedFrame
from core.capture.solve.pairs import choose_matching, choose_pairs
from core.capture.solve.source_frames import SourceFrame, choose_sharpest, feature_mask, prepare_frames
from core.capture.solve.world import up_direction
from core.colour.srgb import linear_from_srgb
from core.errors import Cancelled, CaptureError, FrameError, RunError, SettingsError
from core.images.picture import Picture
from core.images.read import read_picture, read_stored_pixels
from core.images.size import picture_size
from core.images.write import write_exr
from core.system.files import atomic_path
from core.system.folder_lock import folder_lock
from core.system.progress import Progress
from tests.core import videos
from tests.core.captures import look_at, make_capture, orbit
from tests.core.recording_progress import RecordingProgress

SIZE = (320, 240)
QUICK = SolveSettings(features=800)


def texture(seed: int) -> NDArray[np.uint8]:
    """A wall with detail at every scale, (512, 512, 3)."""
    rng = np.random.default_rng(seed)
    wall = np.zeros((512, 512, 3))
    for cells in (8, 24, 64, 160):
        wall += cv2.resize(rng.uniform(0, 1, (cells, cells, 3)), (512, 512), interpolation=cv2.INTER_CUBIC) / 4
    return (np.clip((wall - 0.5) * 2 + 0.5, 0.05, 0.9) * 255).astype(np.uint8)


WALLS = [(texture(i), corner, right, down) for i, (corner, right, down) in enumerate((
    ((-3.0, -2.0, 2.5), (6.0, 0.0, 0.0), (0.0, 4.0, 0.0)),    # behind
    ((-3.0, 1.0, -2.0), (6.0, 0.0, 0.0), (0.0, 0.0, 4.5)),    # floor
    ((-0.9, -0.6, 0.3), (1.2, 0.0, 0.5), (0.0, 1.6, 0.0)),    # in front
))]


def render(camera: Camera) -> NDArray[np.uint8]:
    """Return a camera's picture of three textured walls, (h, w, 3) B G R."""
    frame = np.full((camera.height, camera.width, 3), 60, np.uint8)
    for wall, corner, right, down in WALLS:
        across = np.stack([*np.array([right, down]) / 512, corner], axis=1)
        turn = camera.world_to_camera[:3, :3] @ across
        turn[:, 2] += camera.world_to_camera[:3, 3]
        to_frame = camera.intrinsics @ turn
        drawn = cv2.warpPerspective(wall, to_frame, camera.size, flags=cv2.INTER_AREA)
        mask = cv2.warpPerspective(np.full((512, 512), 255, np.uint8), to_frame, camera.size)
        frame = np.where(mask[..., None] > 127, drawn, frame)
    return frame


def shoot(folder: Path, cameras: list[Camera], suffix: str = ".png") -> Path:
    """Frames of the walls."""
    folder.mkdir(parents=True)
    for i, camera in enumerate(cameras):
        cv2.imwrite(str(folder / f"{i:03d}{suffix}"), render(camera))
    return folder


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Camera], dict[str, Any]]:
    """A shot filmed through a lens with distortion, one frame broken, and solved: its folder, true cameras, and
    report."""
    folder = tmp_path_factory.mktemp("solve")
    cameras = orbit(10, size=SIZE, arc=0.9)
    frames = shoot(folder / "frames", cameras)
    lens = Lens("SIMPLE_RADIAL", (0.9 * SIZE[0], SIZE[0] / 2, SIZE[1] / 2, -0.08), *SIZE)
    v, u = np.mgrid[:SIZE[1], :SIZE[0]] + 0.5
    bent = (lens.undistort(np.stack([u, v], axis=-1)) * lens.focal + lens.centre - 0.5).reshape(*SIZE[::-1], 2)
    for file in frames.iterdir():
        straight = cv2.imread(str(file))
        cv2.imwrite(str(file), cv2.remap(straight, bent.astype(np.float32), None, cv2.INTER_CUBIC))
    (frames / "004.png").write_bytes(b"\x89PNG\r\n\x1a\nbroken")
    report = solve(frames, folder / "out", QUICK)
    return folder / "out", cameras, report


def test_solved_cameras_match_the_truth(solved: tuple[Path, list[Camera], dict[str, Any]]) -> None:
    out, cameras, report = solved
    capture = Capture.open(out)
    assert report["registered"] == len(capture.views) == 9 and report["reprojection_error_px"] < 0.6
    true = np.array([cameras[int(view.name[:3])].position for view in capture.views])
    ours = np.array([view.camera.position for view in capture.views])
    extent = np.linalg.norm(np.ptp(true, axis=0))
    a, b = true - true.mean(axis=0), ours - ours.mean(axis=0)
    left, size, right = np.linalg.svd(a.T @ b)
    flip = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    moved = b @ (left @ flip @ right).T * (size * np.diag(flip)).sum() / (b ** 2).sum()
    assert np.linalg.norm(moved - a, axis=1).max() < 0.005 * extent
    up = left @ flip @ right @ np.array([0, 0, 1.0])
    assert up @ np.array([0, -1.0, 0]) > 0.99  # the shot's world has y down
    assert capture.views[0].camera.fx == pytest.approx(0.9 * SIZE[0], rel=0.05)


def test_solved_frames_are_undistorted_and_show_their_points(solved: tuple[Path, list[Camera], dict[str, Any]]) -> None:
    """Every view is a pinhole's, and the points' colours are those of the pixels they fall on."""
    capture = Capture.open(solved[0])
    off, beside = [], []
    for view in capture.views:
        assert view.lens is None and view.camera.size == SIZE
        pixels, depth = view.camera.project(capture.points.xyz)
        seen = view.camera.contains(pixels, depth) & (capture.points.error < 0.5)
        column, row = pixels[seen].astype(int).T
        off.append(np.abs(capture.frame(view).pixels[row, column] * 255 - capture.points.rgb[seen]).mean(axis=1))
        # A few pixels further, and the same points fall on other colours.
        column, row = np.clip((pixels[seen] + 6).astype(int), 0, np.array(SIZE) - 1).T
        beside.append(np.abs(capture.frame(view).pixels[row, column] * 255 - capture.points.rgb[seen]).mean(axis=1))
    assert np.median(np.concatenate(off)) < 0.5 * np.median(np.concatenate(beside))


def test_colmap_reads_the_solved_model(solved: tuple[Path, list[Camera], dict[str, Any]]) -> None:
    import pycolmap

    model = pycolmap.Reconstruction(str(solved[0] / "sparse" / "0"))
    assert model.num_reg_images() == 9 and model.num_points3D() == solved[2]["points"]
    error = model.compute_mean_reprojection_error()
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() == pytest.approx(error, rel=0.02)  # tracks belong to points
    assert error < 0.7


def test_the_report_has_the_figures_of_the_solve(solved: tuple[Path, list[Camera], dict[str, Any]]) -> None:
    out, _, report = solved
    assert json.loads((out / "solve.json").read_text()) == report
    assert len(report["left_out"]) == 1 and "004.png" in report["left_out"][0]
    assert report["track_length"] > 3 and report["cameras"][0]["model"] == "RADIAL"
    sheet = cv2.imread(str(out / "solve.png"))
    assert sheet.shape[1] > 1000 and (sheet < 128).any()
    assert not (out / ".solve").exists()


def test_a_solved_shot_is_not_solved_again(solved: tuple[Path, list[Camera], dict[str, Any]]) -> None:
    out, _, report = solved
    before = (out / "solve.json").stat().st_mtime_ns
    with folder_lock(out):  # which nobody needs who writes nothing
        assert solve(out.parent / "frames", out, QUICK) == report
    assert (out / "solve.json").stat().st_mtime_ns == before


def test_lights_of_an_earlier_solve_are_refused(solved: tuple[Path, list[Camera], dict[str, Any]],
                                                tmp_path: Path) -> None:
    shutil.copytree(solved[0], tmp_path / "out")
    (tmp_path / "out" / "lights.json").write_text('{"lights": []}')
    assert solve(solved[0].parent / "frames", tmp_path / "out", QUICK) == solved[2]
    with pytest.raises(CaptureError, match=r"lights\.json of an earlier solve"):
        solve(solved[0].parent / "frames", tmp_path / "out", replace(QUICK, seed=QUICK.seed + 1))


class Stopping(Progress):
    """Asks to stop at the `count`-th step of a stage, and notes all stages."""

    def __init__(self, stage: str = "", count: int = 1) -> None:
        super().__init__()
        self.at, self.count, self.seen = stage, count, {}

    def stage(self, name: str, total: int, done: int = 0) -> None:
        self.seen[name] = (total, done)
        super().stage(name, total, done)

    def advance(self, steps: int = 1, **figures: float) -> None:
        if self._stage == self.at:
            self.count -= 1
            if self.count <= 0:
                self.request_stop()
        super().advance(steps, **figures)


def test_a_stopped_solve_resumes(tmp_path: Path) -> None:
    frames = shoot(tmp_path / "frames", orbit(9, size=SIZE, arc=0.9))
    out = tmp_path / "out"
    for stage in ("read frames", "find features", "match frames", "place cameras", "write frames"):
        with pytest.raises(Cancelled):
            solve(frames, out, QUICK, Stopping(stage))
        for name in (".DS_Store", f"._{stage}.png", "Thumbs.db"):  # left by who looks at the folder meanwhile
            (frames / name).write_bytes(stage.encode())
        assert not (out / "sparse").exists() and not (out / "images").exists() and not (out / "solve.json").exists()
    last = Stopping()
    report = solve(frames, out, QUICK, last)
    assert last.seen["find features"] == (9, 9) and last.seen["match frames"] == (36, 36)
    assert "place cameras" not in last.seen
    assert report["registered"] == 9 and len(Capture.open(out).views) == 9


def test_partial_files_of_a_killed_solve_are_not_in_the_capture(stopped: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(stopped / "out", out)
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    for name in ("images/000.png", "images/of_no_frame.png", "sparse/0/cameras.bin"):
        target = out / ".solve" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(target) as half:
            left = half.with_name(half.name.replace(f"-{os.getpid()}@", f"-{gone.pid}@"))
            left.write_bytes(b"half")
        target.unlink()
    solve(stopped / "frames", out, QUICK)
    assert not list(out.rglob(".*"))


def test_two_solves_cannot_write_to_one_folder(stopped: Path, tmp_path: Path) -> None:
    with folder_lock(tmp_path / "out"), pytest.raises(RunError, match="Another process is using"):
        solve(stopped / "frames", tmp_path / "out", QUICK)


@pytest.mark.parametrize("damaged", ["request.json", "stills.json", "mapped.json", "database.db",
                                     "models/0/points3D.bin"])
def test_damaged_intermediate_files_are_made_again(stopped: Path, tmp_path: Path, damaged: str) -> None:
    out, heard = tmp_path / "out", RecordingProgress()
    shutil.copytree(stopped / "out", out)
    file = out / ".solve" / damaged
    file.write_bytes(file.read_bytes()[:file.stat().st_size // 2])
    assert solve(stopped / "frames", out, QUICK, heard)["registered"] == 6
    assert any("starts over" in line and file.name in line for line in heard.texts), heard.texts


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """frames/ and out/, a solve of them that was stopped before its last stage."""
    folder = tmp_path_factory.mktemp("stopped")
    with pytest.raises(Cancelled):
        solve(shoot(folder / "frames", orbit(6, size=SIZE, arc=0.6)), folder / "out", QUICK, Stopping("write frames"))
    return folder


class Failing(Progress):
    """Cannot tell of the `count`-th step of a stage."""

    def __init__(self, stage: str, count: int) -> None:
        super().__init__()
        self.at, self.count = stage, count

    def advance(self, steps: int = 1, **figures: float) -> None:
        if self._stage == self.at:
            self.count -= 1
            if self.count == 0:
                raise OSError("nobody listens")
        super().advance(steps, **figures)


@pytest.mark.parametrize("count", [1, 5])
def test_a_failure_during_mapping_is_raised_and_no_model_recorded(stopped: Path, tmp_path: Path,
                                                                  count: int) -> None:
    """At the first pair, and at the last frame, when there is a model already."""
    out, heard = tmp_path / "out", Stopping()
    shutil.copytree(stopped / "out", out)
    (out / ".solve" / "mapped.json").unlink()
    with pytest.raises(OSError, match="nobody listens"):
        solve(stopped / "frames", out, QUICK, Failing("place cameras", count))
    assert not (out / ".solve" / "mapped.json").exists()
    assert solve(stopped / "frames", out, QUICK, heard)["registered"] == 6
    assert "place cameras" in heard.seen


def test_a_mapping_that_ends_with_a_failure_is_not_recorded(stopped: Path, tmp_path: Path,
                                                            monkeypatch: pytest.MonkeyPatch) -> None:
    """pycolmap looks at its token between steps, so that it may come back with what it has."""
    import pycolmap

    def mapping(*_: Any, initial_image_pair_callback: Callable[[], None], **__: Any) -> dict[int, Any]:
        initial_image_pair_callback()
        return {}

    out = tmp_path / "out"
    shutil.copytree(stopped / "out", out)
    (out / ".solve" / "mapped.json").unlink()
    monkeypatch.setattr(pycolmap, "incremental_mapping", mapping)
    monkeypatch.setattr("core.capture.solve.run_in_child",
                        lambda function, *args, progress: function(*args, progress))  # where it is replaced
    with pytest.raises(OSError, match="nobody listens"):
        solve(stopped / "frames", out, QUICK, Failing("place cameras", 1))
    assert not (out / ".solve" / "mapped.json").exists()


def test_frames_of_different_sizes_are_solved(tmp_path: Path) -> None:
    cameras = orbit(10, size=SIZE, arc=0.9)
    cameras[7:] = [camera.scaled(400, 300) for camera in cameras[7:]]
    frames = shoot(tmp_path / "frames", cameras)
    for file in frames.iterdir():
        file.rename(frames / f"IMG (1) {file.name}")  # COLMAP takes a space for the end of a name
    report = solve(frames, tmp_path / "out", QUICK)
    capture = Capture.open(tmp_path / "out")
    assert capture.views[0].name == "IMG (1) 000.png"
    assert report["registered"] == 10 and len(report["cameras"]) == 2
    assert [view.camera.width for view in capture.views] == [320] * 7 + [400] * 3
    assert capture.views[0].camera.fx == pytest.approx(capture.views[9].camera.fx * 320 / 400, rel=0.05)


def test_squeezed_frames_keep_their_pixel_aspect(tmp_path: Path) -> None:
    """EXRs whose pixels are twice as wide as high: the cameras are those of the frames as filmed."""
    cameras = [camera.scaled(SIZE[0] // 2, SIZE[1]) for camera in orbit(8, size=SIZE, arc=0.9)]
    frames = tmp_path / "frames"
    frames.mkdir()
    for number, camera in enumerate(cameras):
        light = linear_from_srgb(render(camera)[..., ::-1] / 255)
        write_exr(frames / f"{number:03d}.exr", dict(zip("RGB", np.moveaxis(light, 2, 0), strict=True)),
                  header={"pixelAspectRatio": 2.0})
    report = solve(frames, tmp_path / "out", QUICK)
    found = Capture.open(tmp_path / "out").views[0].camera
    assert report["registered"] == 8 and found.size == (SIZE[0] // 2, SIZE[1])
    assert found.fx == pytest.approx(cameras[0].fx, rel=0.05) and found.fy == pytest.approx(cameras[0].fy, rel=0.05)


@pytest.mark.parametrize(("name", "kind", "top", "suffix"), [
    ("a.png", np.uint8, 1.0, ".png"), ("a.png", np.uint16, 1.0, ".png"), ("a.tif", np.uint8, 1.0, ".png"),
    ("a.tif", np.uint16, 1.0, ".png"), ("a.tif", np.float32, 1e5, ".exr")])
def test_undistorted_frames_keep_the_depth_of_their_files(name: str, kind: type, top: float, suffix: str,
                                                          tmp_path: Path) -> None:
    full = 1 if kind is np.float32 else np.iinfo(kind).max
    stored = np.zeros((48, 64, 3), kind)
    stored[:, :] = kind(0.1 * full)
    stored[16:32, 20:44] = kind(top * full)
    cv2.imwrite(str(tmp_path / name), stored, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    still = SourceFrame("000000.png", str(tmp_path / name), 64, 48, None, 1)
    lens = Lens("SIMPLE_RADIAL", (58.0, 32.0, 24.0, -0.1), 64, 48)
    frame = SolvedFrame(0, lens, np.eye(4), np.zeros((0, 2)), np.zeros(0, np.int64))
    model = Model(np.zeros((1, 3)), np.zeros((1, 3), np.uint8), np.zeros(1), np.zeros(1, np.int64), [frame])
    out = tmp_path / "out"
    out.mkdir()
    develop.write_capture([still], Solved(model, [1], "exhaustive", 0), out, tmp_path / "work", 0, Progress())
    (written,) = (out / "images").iterdir()
    assert written.name == "a" + suffix and read_picture(written).pixels.max() == pytest.approx(top, rel=1e-3)
    if suffix == ".png":
        assert read_stored_pixels(written).dtype == kind


def write_video(path: Path, frames: list[NDArray[np.uint8]]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25, SIZE)
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def test_a_video_is_solved(tmp_path: Path) -> None:
    """The sharpest frame of each stretch is taken: two of three are blurred here."""
    frames = [render(camera) for camera in orbit(30, size=SIZE, arc=0.9)]
    frames = [frame if i % 3 == 1 else cv2.GaussianBlur(frame, (0, 0), 3) for i, frame in enumerate(frames)]
    video = write_video(tmp_path / "shot.mp4", frames)
    report = solve(video, tmp_path / "out", SolveSettings(frames=10, features=800))
    names = [view.name for view in Capture.open(tmp_path / "out").views]
    assert report["matching"] == "sequential" and report["registered"] == 10
    assert names == [f"{i:06d}.png" for i in range(1, 30, 3)]


def test_a_truncated_video_is_reported(tmp_path: Path) -> None:
    """An AVI has its frames before its index: what there is of it can be read."""
    video, heard = tmp_path / "shot.avi", RecordingProgress()
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 25, SIZE)
    for camera in orbit(12, size=SIZE, arc=0.3):
        writer.write(render(camera))
    writer.release()
    prepare_frames(video, tmp_path / "whole", 4, 400, heard)
    assert not heard.texts
    video.write_bytes(video.read_bytes()[:video.stat().st_size // 2])
    prepare_frames(video, tmp_path / "cut", 4, 400, heard)
    assert len(heard.texts) == 1 and "shot.avi declares 12 frames, and " in heard.texts[0], heard.texts


def test_the_small_frames_of_a_squeezed_video_are_not(tmp_path: Path) -> None:
    """Stills keep the pixels of an anamorphic video; the small frames and masks of the solve are unsqueezed."""
    frames = [render(camera) for camera in orbit(4, size=SIZE, arc=0.3)]
    video = videos.write_video(tmp_path / "shot.mp4", "libx264", "yuv420p", [frame / 255 for frame in frames],
                               aspect=Fraction(4, 3))
    stills, _ = prepare_frames(video, tmp_path / "work", 0, 400, Progress())
    assert [(still.width, still.height) for still in stills] == [SIZE] * 4
    assert picture_size(tmp_path / "work" / "small" / stills[0].name) == (400, 225)
    assert picture_size(tmp_path / "work" / "masks" / f"{stills[0].name}.png") == (400, 225)


def refusal(source: Path, out: Path, settings: SolveSettings = QUICK) -> str:
    """The sentence with which a solve is refused; nothing of a capture is left."""
    with pytest.raises((CaptureError, FrameError)) as caught:
        solve(source, out, settings)
    assert not any((out / name).exists() for name in ("images", "sparse", "solve.json"))
    message = str(caught.value)
    assert message.endswith(".") and "\n" not in message
    return message


def test_a_video_without_motion_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    still = render(orbit(1, size=SIZE)[0]).astype(np.float64)
    frames = [np.clip(still + rng.normal(0, 6, still.shape), 0, 255).astype(np.uint8) for _ in range(12)]
    message = refusal(write_video(tmp_path / "still.mp4", frames), tmp_path / "out", SolveSettings(frames=6))
    assert "same picture" in message or "hardly moves" in message


def test_identical_frames_are_refused(tmp_path: Path) -> None:
    frames = shoot(tmp_path / "frames", orbit(1, size=SIZE) * 6)
    assert "same picture" in refusal(frames, tmp_path / "out")


def test_a_rotating_camera_is_refused(tmp_path: Path) -> None:
    turn = [cv2.Rodrigues(np.array([0.0, 0.05 * i, 0.0]))[0] for i in range(7)]
    still = look_at((0.0, -0.3, -3.0))
    cameras = []
    for rotation in turn:
        pose = still.copy()
        pose[:3] = rotation @ pose[:3]
        cameras.append(Camera(*SIZE, 288, 288, 160, 120, pose))
    assert "parallax" in refusal(shoot(tmp_path / "frames", cameras), tmp_path / "out")


def test_frames_without_overlap_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    for i in range(4):
        cv2.imwrite(str(folder / f"{i}.png"), cv2.resize(texture(100 + i), SIZE))
    assert "overlap" in refusal(folder, tmp_path / "out")


@pytest.mark.parametrize("case", ["absent", "empty", "two", "broken", "text", "own images", "own folder", "theirs",
                                  "file", "damaged"])
def test_a_source_without_frames_is_refused(tmp_path: Path, case: str) -> None:
    source, out = tmp_path / "frames", tmp_path / "out"
    if case not in ("absent", "text"):
        shoot(source, orbit(2 if case in ("two", "broken") else 4, size=SIZE))
    if case == "empty":
        for file in source.iterdir():
            file.unlink()
    elif case == "broken":
        (source / "000.png").write_bytes(b"")
    elif case == "text":
        source = tmp_path / "notes.txt"
        source.write_text("no video")
    elif case == "own images":
        source.rename(tmp_path / "images")
        source, out = tmp_path / "images", tmp_path
    elif case == "own folder":
        out = source
    elif case == "theirs":
        (out / "sparse" / "0").mkdir(parents=True)
    elif case == "file":
        out.write_text("")
    elif case == "damaged":
        out.mkdir()
        (out / "solve.json").write_text("[]")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(CaptureError) as caught:
        solve(source, out, QUICK)
    assert str(caught.value).endswith(".")
    assert [path for path in sorted(tmp_path.rglob("*")) if ".solve" not in path.parts and path != out] == [
        path for path in before if path != out]


def test_an_invalid_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "shot.mp4").write_bytes(b"no video at all")
    assert "shot.mp4" in refusal(tmp_path / "shot.mp4", tmp_path / "out")


@pytest.mark.parametrize("bad", [{"lens": "PERISCOPE"}, {"frames": -1}, {"matching": "none"}, {"size": 10}])
def test_invalid_settings_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(SettingsError):
        SolveSettings(**bad)


def test_the_sharpest_frame_of_each_stretch_is_chosen() -> None:
    assert choose_sharpest([1, 5, 2, 9, 1, 1, 3, 4], 4) == [1, 3, 4, 7]
    assert choose_sharpest([1, 2, 3], 0) == choose_sharpest([1, 2, 3], 9) == [0, 1, 2]


def test_pairs_follow_the_matching() -> None:
    """Frames are paired exhaustively, or in sequence with loops to similar frames, as the matching says."""
    rng = np.random.default_rng(0)
    places = rng.integers(0, 256, (5, 300, 128)).astype(np.uint8)  # five places, visited again and again
    def descriptors(i: int) -> NDArray[np.uint8]:
        noise = rng.integers(-8, 9, (300, 128))
        return np.clip(places[i % 5].astype(int) + noise, 0, 255).astype(np.uint8)

    assert choose_matching("auto", 20, False) == "exhaustive" and choose_matching("auto", 500, False) == "similar"
    assert choose_matching("auto", 20, True) == "sequential"
    assert len(choose_pairs("exhaustive", 20, descriptors)) == 190
    pairs = choose_pairs("sequential", 60, descriptors)
    assert all(0 <= i < j < 60 for i, j in pairs) and len(pairs) == len(set(pairs)) < 900
    assert {(i, i + 1) for i in range(59)} <= set(pairs)
    loops = [(i, j) for i, j in pairs if j - i > 16 and j - i not in (32,)]
    assert len(loops) > 40 and np.mean([(j - i) % 5 == 0 for i, j in loops]) > 0.9


def test_feature_masks_exclude_clipped_pixels_and_ghost_lines() -> None:
    pixels = np.full((240, 320, 3), 0.4, np.float32)
    cv2.circle(pixels, (60, 50), 8, (1.0, 1.0, 1.0), -1)
    pixels[200, 300] = 1.0  # sparkle
    free = feature_mask(Picture(pixels, "srgb"))
    assert not free[50, 60] and not free[50, 69] and free[200, 300]
    assert not free[120, 160] and not free[190, 260]  # the line through the middle, and its far side
    assert free[50, 260] and free[190, 60] and free.mean() > 0.85
    pixels[30:120, 150:300] = 1.0  # a bright wall clips but casts no line
    assert feature_mask(Picture(pixels, "srgb"))[230, 60]


def test_masks_of_linear_frames_do_not_depend_on_their_exposure() -> None:
    light = np.full((240, 320, 3), 0.18, np.float32)
    cv2.circle(light, (60, 50), 8, (30.0, 30.0, 30.0), -1)
    masks = [feature_mask(Picture(light * np.float32(gain), "linear")) for gain in (1 / 16, 1, 16)]
    assert not masks[1][50, 60] and masks[1].mean() > 0.85
    assert all((mask == masks[1]).all() for mask in masks)


def test_the_up_direction_is_found() -> None:
    rng = np.random.default_rng(0)
    up = np.array([0.2, -0.9, 0.3])
    up /= np.linalg.norm(up)
    rotations = []
    for _ in range(20):
        ahead = rng.normal(size=3)
        ahead += (0.4 * rng.normal() - ahead @ up) * up  # anywhere round, a little up or down
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, up)
        right /= np.linalg.norm(right)
        rotations.append(cv2.Rodrigues(rng.normal(0, 0.02, 3))[0] @ np.stack([right, np.cross(ahead, right), ahead]))
    assert up_direction(rotations) @ up > 0.999
    assert up_direction(rotations[:1] * 5) @ -rotations[0][1] > 0.9  # all look one way: the frames' own up


@pytest.mark.parametrize(("offset", "warnings"), [(0, 0), (1, 1)])
@pytest.mark.parametrize("as_video", [True, False])
def test_interlaced_footage_raises_a_warning(offset: int, warnings: int, as_video: bool, tmp_path: Path) -> None:
    """Every other line comes from the next frame."""
    frames = [render(camera) for camera in orbit(8, size=SIZE, arc=0.9)]
    for first, second in pairwise(list(frames)):
        if offset:
            first[1::2] = second[1::2]
    if as_video:
        source = write_video(tmp_path / "shot.mp4", frames)
    else:
        source = tmp_path / "frames"
        source.mkdir()
        for number, frame in enumerate(frames):
            cv2.imwrite(str(source / f"{number:03d}.png"), frame)
    heard = RecordingProgress()
    prepare_frames(source, tmp_path / "work", 6, 480, heard)
    assert sum("interlaced" in text for text in heard.texts) == warnings


def test_models_are_written_as_read(tmp_path: Path) -> None:
    import pycolmap

    lens = Lens("OPENCV", (50.0, 51.0, 32.0, 24.0, 0.1, 0.01, 0.0, 0.001), 64, 48)
    rng = np.random.default_rng(0)
    cloud = PointCloud(rng.normal(size=(5, 3)).astype(np.float32), rng.integers(0, 256, (5, 3)).astype(np.uint8),
                       rng.uniform(size=5).astype(np.float32))
    poses = [rotated(rng) for _ in range(3)]
    frames = [ObservedFrame(f"ä {i}.png", lens, pose, rng.uniform(0, 48, (3, 2)), np.array([0, 2, 4]))
              for i, pose in enumerate(poses)]
    write_model(tmp_path, frames, cloud)
    posed, again = read_model(tmp_path)
    for one, frame in zip(posed, frames, strict=True):
        assert one.name == frame.name and one.lens.params == lens.params
        assert one.points.tolist() == [0, 2, 4]
        np.testing.assert_allclose(one.world_to_camera, frame.world_to_camera, atol=1e-12)
    np.testing.assert_array_equal(again.xyz, cloud.xyz)
    np.testing.assert_array_equal(again.rgb, cloud.rgb)
    theirs = pycolmap.Reconstruction(str(tmp_path))
    assert theirs.num_reg_images() == 3 and theirs.points3D[3].track.length() == 3
    assert theirs.images[2].points2D[1].point3D_id == 3
    text = tmp_path / "text"
    text.mkdir()
    theirs.write_text(str(text))
    posed, cloud = read_model(text)
    kept = {float(cloud.xyz[index, 0]) for index in posed[1].points}
    assert kept == {float(again.xyz[index, 0]) for index in (0, 2, 4)}, "the numbers are not the indices"


def test_observations_of_missing_points_are_left_out(tmp_path: Path) -> None:
    folder = make_capture(tmp_path / "c")
    images = folder / "sparse" / "0" / "images.txt"
    lines = images.read_text(encoding="utf-8").splitlines()
    poses = [line for line in lines if len(line.split()) == 10]
    images.write_text("\n".join(f"{pose}\n{found}" for pose, found in zip(poses, (
        "1 1 1 2 2 -1 3 3 5 4 4 5", "1 1 999 2 2 99999999999999999999", "what is this", ""), strict=True)) + "\n",
        encoding="utf-8")
    assert [view.points.tolist() for view in Capture.open(folder).views] == [[0, 4], [], [], []]


def rotated(rng: np.random.Generator) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rng.normal(size=3) * 2)[0]
    pose[:3, 3] = rng.normal(size=3)
    return pose


def test_quaternions_convert_to_rotations_and_back() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        rotation = rotated(rng)[:3, :3]
        np.testing.assert_allclose(rotation_from_quaternion(quaternion_from_rotation(rotation)), rotation, atol=1e-12)
    for axis in np.eye(3):  # half turns
        rotation = 2 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(rotation_from_quaternion(quaternion_from_rotation(rotation)), rotation, atol=1e-12)


LISTENS = """
import signal, threading, time
from core.capture.solve.mapping import load_pycolmap
signal.signal(signal.SIGTERM, lambda *_: received.set())
received = threading.Event()
load_pycolmap()
signal.raise_signal(signal.SIGTERM)
print("stopped as asked" if received.wait(5) else "not stopped")
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signal")
def test_a_solve_keeps_the_handler_of_sigterm() -> None:
    """pycolmap's logging would end the process with a trace of its stack."""
    done = subprocess.run([sys.executable, "-c", LISTENS], cwd=Path(__file__).resolve().parents[2], text=True,
                          capture_output=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "stopped as asked"), done.stderr[-500:]


def test_frames_whose_names_differ_by_case_or_suffix_get_distinct_files(tmp_path: Path) -> None:
    stills = []
    for folder, name in (("one", "a.jpg"), ("two", "A.jpeg"), ("one", "b.jpg")):
        (tmp_path / folder).mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / folder / name), np.zeros((8, 8, 3), np.uint8))
        stills.append(SourceFrame(name, str(tmp_path / folder / name), 8, 8, None, 1))
    assert develop._file_names(stills) == ["a.png", "A.jpeg.png", "b.png"]
