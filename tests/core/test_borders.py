# SPDX-License-Identifier: GPL-3.0-or-later
"""Letterboxes and pillars are found, and neither fitted nor looked at by the network."""
from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.capture import Capture
from core.colour.srgb import linear_from_srgb
from core.fit import fit
from core.fit.frames import BORDER_MARGIN, Frames
from core.images.borders import MIN_BORDER_LINES, Borders, PictureArea, find_picture_area
from core.images.plates import Plate
from core.metrics.evaluation import evaluate
from core.removal.inference.remover import Remover
from tests.core.captures import picture
from tests.core.flared import HEIGHT, WIDTH, flared_capture
from tests.core.recording_progress import RecordingProgress
from tests.core.removal_cases import network_file
from tests.core.test_fit import flare_psnr, quick

SIZE = 96, 64


def bordered(inner: NDArray[Any], top: int, bottom: int, left: int, right: int, value: float = 0) -> NDArray[Any]:
    return np.pad(inner, ((top, bottom), (left, right), (0, 0)), constant_values=value)


@pytest.mark.parametrize("value", [0, 16])
@pytest.mark.parametrize("borders", [(8, 8, 0, 0), (0, 0, 12, 12), (9, 8, 5, 5), (2, 3, 0, 0), (0, 0, 0, 0)])
def test_borders_are_found(borders: tuple[int, int, int, int], value: int) -> None:
    inner = np.maximum(np.asarray(picture(0, SIZE), np.uint8), 40)
    whole = bordered(inner, *borders, value)
    top, _, left, _ = borders
    found = find_picture_area(whole, lambda line: line / 255)
    assert found == PictureArea(top, top + SIZE[1], left, left + SIZE[0])
    assert np.array_equal(whole[found.slices], inner)
    assert found.size == SIZE


def test_a_border_with_jpeg_noise_is_found() -> None:
    smooth = cv2.GaussianBlur(np.maximum(np.asarray(picture(0, SIZE), np.uint8), 60), (0, 0), 4)
    _, code = cv2.imencode(".jpg", bordered(smooth, 16, 16, 0, 0), [cv2.IMWRITE_JPEG_QUALITY, 70])
    found = find_picture_area(cv2.imdecode(code, cv2.IMREAD_COLOR), lambda line: line / 255)
    assert 15 <= found.top <= 16 and 80 <= found.bottom <= 81, "but for the line that rings"


@pytest.mark.parametrize("why", ["one side alone", "one line", "grey", "grain", "faint stars", "a ghost",
                                 "next to nothing left", "all of it"])
def test_other_dark_areas_are_no_borders(why: str) -> None:
    inner = np.maximum(np.asarray(picture(0, SIZE), np.uint8), 40)
    ghost = bordered(inner, 20, 20, 0, 0)
    ghost[0, 5] = ghost[-1, 9] = 120
    stars = bordered(inner, 20, 20, 0, 0)
    stars[:20, ::10] = stars[-20:, ::10] = 10
    whole = {"one side alone": bordered(inner, 20, 0, 0, 0), "a ghost": ghost, "faint stars": stars,
             "next to nothing left": bordered(inner[:8], 40, 40, 0, 0),
             "one line": bordered(inner, 1, 1, 1, 1), "grey": bordered(inner, 8, 8, 0, 0, 60),
             "grain": bordered(inner, 8, 8, 0, 0), "all of it": np.zeros_like(inner)}[why]
    if why == "grain":
        noise = np.random.default_rng(0).integers(0, 20, whole.shape).astype(np.uint8)
        whole = np.where(whole == 0, noise, whole)
    assert find_picture_area(whole, lambda line: line / 255) == PictureArea(0, whole.shape[0], 0, whole.shape[1])


def test_a_night_sky_does_not_widen_a_border() -> None:
    """Dark rows beside a border do not count to it; frames with different pictures share the border of both."""
    inner = np.maximum(np.asarray(picture(0, SIZE), np.uint8), 40)
    for sky in (0, 1, 10, 30):
        dark = inner.copy()
        dark[:sky] = 0
        found = find_picture_area(bordered(dark, 12, 12, 0, 0), lambda line: line / 255)
        assert found.bottom == 12 + SIZE[1] and 12 <= found.top <= 12 + MIN_BORDER_LINES
    assert Borders(40, 12, 0, 0).intersection(Borders(12, 12, 3, 0)) == Borders(12, 12, 0, 0)


@pytest.mark.parametrize("kind", ["8 bit", "float"])
def test_a_plate_with_borders_is_cleaned_as_the_picture_inside(tmp_path: Path, kind: str) -> None:
    remover = Remover(network_file(tmp_path / "net.safetensors", bias=0.1), working_size=64)
    codes = np.maximum(np.asarray(picture(1, SIZE), np.uint8), 90)
    if kind == "float":
        codes = linear_from_srgb(codes / np.float32(255)).astype(np.float32) * 2  # above white
    plate = Plate(Path("a"), codes, "srgb" if kind == "8 bit" else "linear")
    clean, flare = remover.remove(plate)
    assert (clean != codes).mean() > 0.2
    for borders in ((13, 13, 0, 0), (0, 0, 20, 20)):
        found, taken = remover.remove(replace(plate, codes=bordered(codes, *borders)))
        assert np.array_equal(found, bordered(clean, *borders))
        assert np.array_equal(taken, bordered(flare, *borders))
    matte = np.zeros((SIZE[1] + 26, SIZE[0]), np.float32)
    matte[:40] = 1
    marked = remover.remove(replace(plate, codes=bordered(codes, 13, 13, 0, 0)), matte)[0]
    assert np.array_equal(marked[13:-13], remover.remove(plate, matte[13:-13])[0])
    assert not np.array_equal(marked[13:-13], clean)


@pytest.fixture(scope="module")
def boxed(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """A capture with a flare whose frames are black in their first and last six rows."""
    folder = flared_capture(tmp_path_factory.mktemp("boxed") / "capture")
    for kind in ("images", "removed"):
        for path in (folder / kind).iterdir():
            codes = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            codes[:6] = codes[-6:] = 0
            cv2.imwrite(str(path), codes)
    return Capture.open(folder)


def test_a_fit_leaves_borders_out(tmp_path: Path, boxed: Capture) -> None:
    frames = Frames(boxed)
    camera, frame, removed = frames.targets(boxed.views[0])
    assert camera.size == (WIDTH, HEIGHT - 12 - 2 * BORDER_MARGIN) and frame.shape[:2] == camera.size[::-1]
    assert removed is not None and removed.shape == frame.shape
    whole = boxed.views[0].camera
    point = np.array([[0.1, 0.1, 0.3]])
    assert np.allclose(camera.project(point)[0] + [0, 6 + BORDER_MARGIN], whole.project(point)[0])
    heard = RecordingProgress()
    settings = quick(400, **{"flare.density.stop": 200, "flare.density.every": 50})
    run = fit(boxed, settings, tmp_path / "run", heard)
    assert any("black borders (7 and 7 rows, 0 and 0 columns of 64x40)" in text for text in heard.texts)
    fitted, empty = flare_psnr(run, boxed)
    assert fitted > empty + 5, "the truth goes on behind the borders"
    held_out = boxed.split(settings.holdout)[1]
    cameras = {view: frames.camera(view) for view in held_out}
    inside, everywhere = (evaluate(run, boxed, cameras, area=part) for part in (frames.picture_area, None))
    assert inside["composite"]["psnr"] > everywhere["composite"]["psnr"] + 3


def test_black_or_differing_frames_give_no_border(tmp_path: Path, boxed: Capture) -> None:
    shutil.copytree(boxed.folder, tmp_path / "capture")
    first, second = (tmp_path / "capture" / "images" / f"{number:04d}.png" for number in (0, 1))
    cv2.imwrite(str(first), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert Frames(Capture.open(tmp_path / "capture")).picture_area == Frames(boxed).picture_area
    cv2.imwrite(str(second), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    found = Frames(Capture.open(tmp_path / "capture"))
    assert found.picture_area is None and found.warnings == ()
