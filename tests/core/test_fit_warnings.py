# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings about footage in which a fit can hardly separate the flare; mode split uses frames alone."""
from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from core.capture import Capture
from core.errors import Cancelled, CaptureError
from core.fit import fit, preset
from core.fit.frames import Frames
from core.fit.warnings import footage_warnings, outlier_warnings
from core.images.write import write_png
from core.metrics.evaluation import is_worse_than_empty
from tests.core.flared import HEIGHT, WIDTH, flared_capture
from tests.core.recording_progress import RecordingProgress, StopAfter
from tests.core.test_fit import quick


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return Capture.open(flared_capture(tmp_path_factory.mktemp("warnings") / "capture"))


def warnings_on(capture: Capture, mode: str = "split", count: int = 12) -> list[str]:
    frames = Frames(capture, display_white=4.0)
    warnings = footage_warnings(capture, preset("draft", mode=mode), capture.views[:count], frames)
    return [text.split(":")[0] for text in warnings]


def test_good_footage_gives_no_warning(capture: Capture) -> None:
    assert warnings_on(capture) == warnings_on(capture, "default") == []


def test_a_rotating_camera_gives_a_warning_in_parallax_modes(capture: Capture) -> None:
    views = []
    for view in capture.views:
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] = 0
        views.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    frames = {view.name: capture.frame_path(view) for view in capture.views}
    tripod = Capture(capture.folder, views, capture.points, capture.lights, frames=frames)
    assert warnings_on(tripod) == ["The camera only turns"]
    assert warnings_on(tripod, "default") == []


@pytest.mark.parametrize(("away", "warned"), [(5.4e6, True), (1e3, False)])
def test_a_capture_far_from_the_origin_gives_a_warning(capture: Capture, away: float, warned: bool) -> None:
    views = []
    for view in capture.views:
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] -= pose[:3, :3] @ (away, away, 0.0)
        views.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    frames = {view.name: capture.frame_path(view) for view in capture.views}
    points = replace(capture.points, xyz=capture.points.xyz + np.float32((away, away, 0)))
    moved = Capture(capture.folder, views, points, capture.lights, frames=frames)
    assert warnings_on(moved, "3dgs") == ["The world's origin is far away"] * warned


def test_few_frames_give_a_warning(capture: Capture) -> None:
    texts = warnings_on(capture, count=11)
    assert [text.split(",")[0] for text in texts] == ["11 frames are few to learn a flare from"]
    assert warnings_on(capture, "3dgs", count=11) == []


@pytest.mark.parametrize(("gain", "warned"), [(0.01, True), (1.0, False), (3.0, False), (40.0, True)])
def test_float_frames_far_from_middle_grey_give_a_warning(gain: float, warned: bool, tmp_path: Path) -> None:
    capture = Capture.open(flared_capture(tmp_path / "capture", dots=400, float_gain=gain))
    frames = Frames(capture, display_white=20.0)
    found = footage_warnings(capture, preset("draft", mode="split"), capture.views, frames)
    assert [text.startswith("The frames' median light is ") for text in found] == [True] * warned


def test_mode_split_uses_the_frames_only(capture: Capture, tmp_path: Path) -> None:
    """Whatever flare-free frames and exact layers lie beside them."""
    bare = tmp_path / "bare"
    shutil.copytree(capture.folder, bare, ignore=shutil.ignore_patterns("removed", "truth"))
    with_them, without = (fit(one, quick(40, mode="split"), tmp_path / name)
                          for name, one in (("with", capture), ("without", Capture.open(bare))))
    assert with_them.fingerprint == without.fingerprint


def test_mode_estimated_uses_removed_frames_and_not_exact_layers(capture: Capture, tmp_path: Path) -> None:
    """Which would make a fit of a known scene look better than one of footage."""
    folder = tmp_path / "known"
    shutil.copytree(capture.folder, folder, ignore=shutil.ignore_patterns("removed"))
    known = Capture.open(folder)
    assert known.has_truth
    with pytest.raises(CaptureError, match="run remove on it first"):
        fit(known, quick(40, mode="estimated"), tmp_path / "run")


def test_a_frame_of_another_scene_is_named(tmp_path: Path) -> None:
    folder = flared_capture(tmp_path / "capture")
    heard = RecordingProgress()
    fit(Capture.open(folder), quick(120, mode="split"), tmp_path / "sound", heard)
    assert not any("does not reproduce the shot" in text for text in heard.texts)
    tiles = np.random.default_rng(5).random((4, 8, 3)).repeat(HEIGHT // 4, 0).repeat(WIDTH // 8, 1)
    write_png(folder / "images" / "0005.png", tiles)
    with pytest.raises(Cancelled):
        fit(Capture.open(folder), quick(120, mode="split"), tmp_path / "odd", StopAfter(118, "fit"))
    fit(Capture.open(folder), quick(120, mode="split"), tmp_path / "odd", heard, resume=True)
    assert [text.split(":")[0] for text in heard.texts if "does not reproduce the shot" in text] == ["0005.png"]


def test_many_bad_frames_are_no_outliers() -> None:
    losses = {f"{number}.png": 0.1 for number in range(40)}
    assert outlier_warnings(losses) == outlier_warnings({}) == ()
    assert outlier_warnings({**losses, "a": 0.39, "b": 0.41})[0].startswith("b: ")
    few = {f"odd {number}": 1.0 for number in range(4)}
    assert "camera" not in outlier_warnings({**losses, "b": 0.41}, uses_plates=True)[0], "plates need no cameras"
    assert "odd 0, odd 1, odd 2, odd 3: " in outlier_warnings({**losses, **few})[0]
    assert outlier_warnings({**losses, **few, "odd 4": 1.0}) == ()
    assert outlier_warnings({"a": 0.0, "b": 0.0, "c": 1e-4}) == (), "nothing that can be seen"


@pytest.mark.parametrize(("found", "empty", "worse"), [(20.0, 24.0, True), (25.0, 24.0, False), (None, 24.0, False)])
def test_a_flare_that_scores_below_an_empty_one_is_recognised(found: float | None, empty: float, worse: bool) -> None:
    assert is_worse_than_empty({"flare": {"psnr": found, "empty_psnr": empty}}) == worse
    assert not is_worse_than_empty({"composite": {"psnr": 20.0}})
