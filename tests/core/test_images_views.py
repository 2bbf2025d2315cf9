# SPDX-License-Identifier: GPL-3.0-or-later
"""Stereo EXRs: both eyes are cleaned, or the file is refused by name."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from core.errors import FrameError
from core.images.exr_views import stereo_views
from core.images.plates import read_plate
from core.images.views import split_views, write_view_results
from core.removal.inference.remover import Remover
from core.removal.jobs.batch import clean_plates
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
    clean_plates([path], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress(),
                 flare_folder=tmp_path / "flare")
    before, after, flare = read(path), read(tmp_path / "out" / "a.exr"), read(tmp_path / "flare" / "a.exr")
    assert before.keys() == after.keys()
    np.testing.assert_array_equal(before["A"], after["A"])
    for name in ("R", "right.R"):  # the test's network sees red flares
        assert (after[name] < before[name]).mean() > 0.3
        np.testing.assert_allclose(before[name].astype(float) - after[name], flare[name], atol=2e-3)


@pytest.mark.parametrize(("count", "corrected"), [(1, 2), (3, 0)])
def test_streaks_are_corrected_in_both_eyes_or_in_none(flare_everywhere: Path, tmp_path: Path, count: int,
                                                       corrected: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame by itself has them corrected in each eye; in a shot, neighbours have corrected the first eye."""
    calls = []
    monkeypatch.setattr("core.removal.inference.remover.correct_streaks",
                        lambda *arguments: calls.append(1) or arguments[1])
    paths = [write(tmp_path / f"{number:04d}.exr", RGB + RIGHT, multiView=["left", "right"])
             for number in range(count)]
    clean_plates(paths, tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress())
    assert len(calls) == corrected


@pytest.mark.parametrize("colours", ["RGB", "Y"])
def test_both_eyes_are_cleaned_where_none_is_at_the_root(colours: str, flare_everywhere: Path, tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", [f"{eye}.{colour}" for eye in ("left", "right") for colour in f"{colours}A"])
    clean_plates([path], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress(),
                 flare_folder=tmp_path / "flare")
    before, after, flare = read(path), read(tmp_path / "out" / "a.exr"), read(tmp_path / "flare" / "a.exr")
    assert before.keys() == after.keys()
    for name in before:
        if name.endswith("A"):
            np.testing.assert_array_equal(after[name], before[name])
        elif name.endswith(("R", "Y")):
            removed = before[name].astype(float) - after[name]
            assert (removed > 0).mean() > 0.3
            stored = "R" if name.startswith("left") else "right.R"
            np.testing.assert_allclose(removed, flare[stored], atol=2e-3)


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


def write_parts(path: Path, parts: list[tuple[dict[str, Any], list[str]]], size: tuple[int, int] = (64, 48)) -> Path:
    """Write a multi-part EXR of random pixels; each part is a header and the names of its channels."""
    random = np.random.default_rng(0)
    whole = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File([OpenEXR.Part({**whole, **header}, {
            name: random.random(size[::-1]).astype(np.float32 if name == "Z" else np.float16) for name in names})
            for header, names in parts]) as file:
        file.write(str(path))
    return path


def read_parts(path: Path) -> list[tuple[dict[str, Any], dict[str, np.ndarray[Any, Any]]]]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return [(dict(part.header), {name: channel.pixels.copy() for name, channel in part.channels.items()})
                for part in file.parts]


NUKE = [({"name": "rgba.left", "view": "left", "compression": OpenEXR.DWAA_COMPRESSION}, [*RGB, "A"]),
        ({"name": "depth.left", "view": "left"}, ["Z"]), ({"name": "rgba.right", "view": "right"}, [*RGB, "A"]),
        ({"name": "depth.right", "view": "right", "owner": "Ada"}, ["Z"])]


@pytest.mark.parametrize("layout", ["Nuke", "right first", "without attribute"])
def test_both_eyes_in_parts_of_their_own_are_cleaned(layout: str, flare_everywhere: Path, tmp_path: Path) -> None:
    parts = {"Nuke": NUKE, "right first": [*NUKE[2:], *NUKE[:2]], "without attribute": [
        ({name: value for name, value in header.items() if name != "view"}, names) for header, names in NUKE]}[layout]
    path = write_parts(tmp_path / "a.exr", parts)
    clean_plates([path], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress(),
                 flare_folder=tmp_path / "flare")
    before, after, flare = read_parts(path), read_parts(tmp_path / "out" / "a.exr"), read(tmp_path / "flare" / "a.exr")
    assert len(before) == len(after) == 4
    first = before[0][0]["name"].rpartition(".")[2]
    for (header, channels), (new_header, new_channels) in zip(before, after, strict=True):
        assert [new_header.get(name) for name in ("name", "view", "owner")] == [
            header.get(name) for name in ("name", "view", "owner")]
        for name in ("A", "Z"):
            if name in channels:
                np.testing.assert_array_equal(new_channels[name], channels[name])
        if "R" in channels:
            eye = header["name"].rpartition(".")[2]
            removed = channels["R"].astype(float) - new_channels["R"]
            assert (removed > 0).mean() > 0.3
            np.testing.assert_allclose(removed, flare["R" if eye == first else f"{eye}.R"], atol=2e-3)
    with pytest.raises(FrameError, match=r"a\.exr holds the views"):
        plate_window(path)


def test_a_plate_with_other_parts_is_cleaned_and_keeps_them(tmp_path: Path) -> None:
    path = write_parts(tmp_path / "a.exr", [({"name": "depth"}, ["Z"]), ({"name": "rgba"}, RGB),
                                            ({"name": "diffuse"}, ["diffuse.R", "diffuse.G", "diffuse.B"])])
    plate = read_plate(path)
    assert len(split_views(plate)) == 1
    write_view_results([tmp_path / "b.exr"], plate, [(plate.codes * np.float16(0.5), plate.codes)])
    before, after = read_parts(path), read_parts(tmp_path / "b.exr")
    for number, factor in ((0, 1), (1, 0.5), (2, 1)):
        for name, pixels in before[number][1].items():
            np.testing.assert_array_equal(after[number][1][name], pixels * pixels.dtype.type(factor))


@pytest.mark.parametrize(("parts", "problem"), [
    ([({"name": "a"}, RGB), ({"name": "b"}, RGB)], "2 of them with a picture, and does not say that these are views"),
    ([({"name": "a", "view": "left"}, RGB), ({"name": "b", "view": "left"}, RGB)], "2 of them with a picture"),
    ([({"name": "a", "view": "left"}, RGB), ({"name": "b", "view": "right", "dataWindow": (
        np.array([2, 2], np.int32), np.array([65, 49], np.int32))}, RGB)], "views of different data windows"),
])
def test_parts_that_cannot_be_cleaned_together_are_refused_by_name(parts: list[Any], problem: str,
                                                                 tmp_path: Path) -> None:
    with pytest.raises(FrameError, match=rf"a\.exr has .*{problem}"):
        read_plate(write_parts(tmp_path / "a.exr", parts))
