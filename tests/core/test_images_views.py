# SPDX-License-Identifier: GPL-3.0-or-later
"""Stereo EXRs: both eyes are cleaned, or the file is refused by name."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from core.errors import FrameError
from core.images.plates import read_plate
from core.images.views import split_views, stereo_views, write_view_results
from core.removal.inference.remover import Remover
from core.removal.jobs.batch import remove_all
from core.system.progress import Progress
from core.transfer.target import plate_window


def write(path: Path, channels: list[str], **header: Any) -> Path:
    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    random = np.random.default_rng(0)
    pixels = {name: random.random((48, 64)).astype(np.float16) for name in channels}
    with OpenEXR.File(attributes, pixels) as file:
        file.write(str(path))
    return path


def read(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels.copy() for name, channel in file.parts[0].channels.items()}


RGB = ["R", "G", "B"]
RIGHT = ["right.R", "right.G", "right.B"]


@pytest.mark.parametrize(("channels", "header", "expected"), [
    (RGB + RIGHT, {"multiView": ["left", "right"]}, ["left", "right"]),
    ([*RGB, "left.R", "left.G", "left.B"], {"multiView": ["right", "left"]}, ["right", "left"]),
    (RGB + RIGHT + ["centre.R", "centre.G", "centre.B"], {"multiView": ["left", "right", "centre"]},
     ["left", "right", "centre"]),
    (["left.R", "left.G", "left.B", *RIGHT], {}, ["left", "right"]),
    (RGB + RIGHT, {}, ["left", "right"]),
    (["Y", "right.Y"], {"multiView": ["left", "right"]}, ["left", "right"]),
    (RGB, {"multiView": ["left"]}, []),
    (RGB, {"multiView": ["left", "right"]}, []),
    ([*RGB, "diffuse.R", "diffuse.G", "diffuse.B"], {}, []),
    ([*RGB, "scene.right.R", "scene.right.G", "scene.right.B"], {}, []),
])
def test_views_are_identified_by_header_and_channels(channels: list[str], header: dict[str, Any],
                                                expected: list[str]) -> None:
    assert [view.name for view in stereo_views(header, channels)] == expected


@pytest.mark.parametrize("header", [{"multiView": ["left", "right"]}, {}])
def test_both_eyes_are_cleaned(flare_everywhere: Path, tmp_path: Path, header: dict[str, Any]) -> None:
    (tmp_path / "in").mkdir()
    path = write(tmp_path / "in" / "a.exr", RGB + RIGHT + ["A"], **header)
    remove_all([path], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress(),
               flare_folder=tmp_path / "flare")
    before, after, flare = read(path), read(tmp_path / "out" / "a.exr"), read(tmp_path / "flare" / "a.exr")
    assert before.keys() == after.keys()
    np.testing.assert_array_equal(before["A"], after["A"])
    for name in ("R", "right.R"):  # the test's network sees red flares
        assert (after[name] < before[name]).mean() > 0.3
        np.testing.assert_allclose(before[name].astype(float) - after[name], flare[name], atol=2e-3)


def test_a_change_of_the_second_eye_alone_is_written(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", RGB + RIGHT, multiView=["left", "right"])
    plate = read_plate(path)
    (_, left), (_, right) = split_views(plate)
    none = np.zeros(left.codes.shape, np.float16)
    write_view_results([tmp_path / "b.exr"], plate, [(left.codes, none), (right.codes * np.float16(0.5), none)])
    before, after = read(path), read(tmp_path / "b.exr")
    np.testing.assert_array_equal(after["R"], before["R"])
    np.testing.assert_array_equal(after["right.R"], before["right.R"] * np.float16(0.5))
    write_view_results([tmp_path / "c.exr"], plate, [(left.codes, none), (right.codes, none)])
    assert (tmp_path / "c.exr").read_bytes() == path.read_bytes()


def test_a_transfer_to_a_stereo_picture_is_refused_by_name(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", RGB + RIGHT, multiView=["left", "right"])
    with pytest.raises(FrameError, match=r"a\.exr holds the views left and right"):
        plate_window(path)


def test_two_parts_are_refused_by_name(tmp_path: Path) -> None:
    parts = [OpenEXR.Part({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "view": view,
                           "name": view}, {name: np.zeros((8, 8), np.float16) for name in "RGB"}, view)
             for view in ("left", "right")]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(FrameError, match=r"a\.exr"):
        read_plate(tmp_path / "a.exr")
