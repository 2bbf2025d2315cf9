# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames that are not exposed alike are told of before they are fitted."""
from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from core.capture import Capture
from core.fit.exposure import says, spread
from core.fit.frames import Frames
from core.fit.trainer import Trainer
from core.pictures import linear_from_srgb, srgb_from_linear
from tests.core.flared import flared_capture
from tests.core.test_fit import quick


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return Capture.open(flared_capture(tmp_path_factory.mktemp("steady") / "capture", dots=400))


def exposed(capture: Capture, folder: Path, stops: float) -> Capture:
    """The capture with every other frame so much brighter and the others as much darker."""
    shutil.copytree(capture.folder, folder)
    for number, view in enumerate(capture.views):
        for kind in ("images", "removed"):
            path = folder / kind / view.name
            light = linear_from_srgb(cv2.imread(str(path)) / np.float32(255)) * 2 ** (stops * (-1) ** number)
            cv2.imwrite(str(path), (srgb_from_linear(light).clip(0, 1) * 255).astype(np.uint8))
    return Capture.open(folder)


def spread_of(capture: Capture) -> float:
    return spread(capture, capture.views, Frames(capture))


def test_frames_of_one_exposure_are_steady(capture: Capture, tmp_path: Path) -> None:
    assert spread_of(capture) < 0.2
    assert spread_of(exposed(capture, tmp_path / "a", 0.0)) < 0.2
    assert not says(capture, capture.views, Frames(capture))


@pytest.mark.parametrize("stops", [0.3, 0.7])
def test_a_drift_is_found_and_told(capture: Capture, tmp_path: Path, stops: float) -> None:
    drifting = exposed(capture, tmp_path / "a", stops)
    assert spread_of(drifting) == pytest.approx(2 * stops, abs=0.4 * stops)
    told = [text for text in Trainer(drifting, quick(5)).says if "exposure seems to change" in text]
    assert len(told) == 1


def test_points_without_colours_tell_nothing(capture: Capture, tmp_path: Path) -> None:
    drifting = exposed(capture, tmp_path / "a", 0.7)
    points = drifting.folder / "sparse" / "0" / "points3D.txt"
    rows = [line.split() for line in points.read_text(encoding="utf-8").splitlines()]
    points.write_text("".join(" ".join([*row[:4], "128", "128", "128", *row[7:]]) + "\n" for row in rows))
    assert spread_of(Capture.open(drifting.folder)) == 0


def test_without_points_that_tell_nothing_is_said(capture: Capture, tmp_path: Path) -> None:
    drifting = exposed(capture, tmp_path / "a", 0.7)
    for path in (drifting.folder / "images").iterdir():
        cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path))))
    shutil.rmtree(drifting.folder / "removed")
    shutil.rmtree(drifting.folder / "truth")
    dark = Capture.open(drifting.folder)
    assert spread_of(dark) == 0
    assert spread(dark, dark.views[:2], Frames(dark)) == 0
