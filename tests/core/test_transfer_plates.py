# SPDX-License-Identifier: GPL-3.0-or-later
"""Plates of a transfer as viewers show them: alpha, orientation, sequences with names of any form."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from core.bake.exr import read_layers
from core.colour.srgb import linear_from_srgb
from core.images.exr import read_exr
from core.images.formats.exif import apply_orientation, read_exif, undo_orientation
from core.images.write import write_exr
from core.look import Look, read_look
from core.transfer.plates import upright_picture
from core.transfer.target import Target, picture_target
from core.transfer.transfer import Transfer
from tests.core.test_transfer import flare, look  # noqa: F401 - fixtures

LIGHT = (70.0, 25.0)


def target(paths: list[Path], light: Look) -> Target:
    return picture_target(paths, light, {"sun": LIGHT}, {}, {light.names[0]: 4.0})


def with_alpha(hidden: int, dtype: Any = np.uint8) -> np.ndarray[Any, Any]:
    """B G R A: opaque at the left, half in the middle, transparent at the right with the code `hidden`."""
    top = np.iinfo(dtype).max
    picture = np.full((60, 100, 4), top // 4, dtype)
    picture[:, :40, 3], picture[:, 40:60, 3], picture[:, 60:, 3] = top, top // 2, 0
    picture[:, 60:, :3] = hidden * (top // 255)
    return picture


def over_black(path: Path) -> np.ndarray[Any, Any]:
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    values = (stored / np.iinfo(stored.dtype).max).astype(np.float32)
    return linear_from_srgb(values[..., 2::-1]) * values[..., 3:]


@pytest.mark.parametrize(("suffix", "dtype"), [(".png", np.uint8), (".png", np.uint16), (".tif", np.uint16)])
def test_a_flare_shows_over_transparent_parts(flare: Path, look: Look, tmp_path: Path,  # noqa: F811
                                              suffix: str, dtype: Any) -> None:
    paths = [tmp_path / "in" / f"card_{number}{suffix}" for number in (1, 2)]
    paths[0].parent.mkdir()
    for path, hidden in zip(paths, (0, 250), strict=True):
        assert cv2.imwrite(str(path), with_alpha(hidden, dtype))
    Transfer(flare, target(paths, look)).bake(tmp_path / "out")
    for number, path in enumerate(paths, 1):
        layers = read_layers(tmp_path / "out" / f"layers.{number:04d}.exr")
        np.testing.assert_allclose(layers.scene, over_black(path), atol=2e-4)  # halfs
        written = tmp_path / "out" / "frames" / path.name
        before, after = (cv2.imread(str(each), cv2.IMREAD_UNCHANGED) for each in (path, written))
        lit = (layers.flare > 0).any(-1)
        assert lit[:, 60:].any()
        np.testing.assert_array_equal(after[~lit], before[~lit])
        difference = over_black(written) - over_black(path) - layers.flare
        assert np.abs(difference).max() < (0.01 if dtype == np.uint8 else 1e-3)
        assert abs(difference[lit].mean()) < 1e-4
        assert (after[..., 3] >= before[..., 3]).all()
        root = read_exr(tmp_path / "out" / f"layers.{number:04d}.exr")
        assert (root["A"] >= np.clip(np.max([root[name] for name in "RGB"], 0), 0, 1) - 1e-3)[lit].all()
        np.testing.assert_allclose(root["A"][~lit], before[..., 3][~lit] / np.iinfo(dtype).max, atol=1e-3)


def test_an_exr_keeps_its_alpha_and_gains_the_light(flare: Path, look: Look, tmp_path: Path) -> None:  # noqa: F811
    path = tmp_path / "in" / "card.0001.exr"
    alpha = np.zeros((60, 100), np.float32)
    alpha[:, :50] = 1
    write_exr(path, {**dict.fromkeys("RGB", alpha * np.float32(0.25)), "A": alpha}, half=False)
    Transfer(flare, target([path], look)).bake(tmp_path / "out")
    layers, written = read_layers(tmp_path / "out" / "layers.0001.exr"), read_exr(tmp_path / "out/frames/card.0001.exr")
    np.testing.assert_array_equal(written["A"], alpha)
    np.testing.assert_allclose(written["R"], alpha * 0.25 + layers.flare[..., 0], atol=1e-5)


def test_hidden_colours_are_no_light(tmp_path: Path) -> None:
    """Colours under full transparency do not affect the picture that is read."""
    for hidden in (0, 255):
        assert cv2.imwrite(str(tmp_path / f"{hidden}.png"), with_alpha(hidden))
    first, second = (upright_picture(tmp_path / f"{hidden}.png").pixels for hidden in (0, 255))
    np.testing.assert_array_equal(first, second)


def oriented(path: Path, shown: np.ndarray[Any, Any], orientation: int) -> Path:
    """Write a picture that viewers show as `shown` (B G R), with this orientation in its Exif block."""
    block = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0" + bytes([orientation]) + b"\0\0\0\0\0\0\0"
    data = cv2.imencode(path.suffix, undo_orientation(shown, orientation))[1].tobytes()
    if path.suffix == ".jpg":
        body = b"Exif\0\0" + block
        path.write_bytes(data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:])
    else:
        import zlib

        chunk = len(block).to_bytes(4, "big") + b"eXIf" + block + zlib.crc32(b"eXIf" + block).to_bytes(4, "big")
        path.write_bytes(data[:33] + chunk + data[33:])
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_flare_lies_where_a_viewer_shows_its_light(flare: Path, look: Look, tmp_path: Path,  # noqa: F811
                                                     orientation: int, suffix: str) -> None:
    rows, columns = np.mgrid[:100, :60].astype(np.uint8)
    shown = np.stack([rows, columns, np.full_like(rows, 60)], -1)
    (tmp_path / "in").mkdir()
    upright = oriented(tmp_path / "in" / f"upright_1{suffix}", shown, 1)
    phone = oriented(tmp_path / "in" / f"phone_2{suffix}", shown, orientation)
    light = (20.0, 70.0)
    Transfer(flare, picture_target([upright, phone], look, {"sun": light}, {}, {look.names[0]: 4.0})).bake(
        tmp_path / "out")
    first, second = (read_layers(tmp_path / "out" / f"layers.{number:04d}.exr") for number in (1, 2))
    assert first.flare.max() > 0.01
    np.testing.assert_allclose(second.flare, first.flare, atol=1e-6)
    np.testing.assert_allclose(second.scene, first.scene, atol=0.03 if suffix == ".jpg" else 1e-6)
    written = tmp_path / "out" / "frames" / phone.name
    assert read_exif(written)[0] == orientation
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    stored = cv2.imread(str(written), flags)
    assert stored.shape == cv2.imread(str(phone), flags).shape
    expected = cv2.imread(str(tmp_path / "out" / "frames" / upright.name), flags)
    difference = np.abs(apply_orientation(stored, orientation).astype(int) - expected)
    assert difference.mean() < 1
    assert suffix == ".jpg" or not difference.any()  # a JPEG is compressed anew, by other blocks


def test_a_sequence_with_the_number_inside_is_in_order(flare: Path, look: Look, tmp_path: Path) -> None:  # noqa: F811
    paths = [tmp_path / f"sh_{number}_comp.png" for number in (10, 11, 9)]
    for path in paths:
        assert cv2.imwrite(str(path), np.zeros((60, 100, 3), np.uint8))
    frames = target(paths, look).frames
    assert [(frame.plate.name, frame.frame.number) for frame in frames if frame.plate] == [
        ("sh_9_comp.png", 9), ("sh_10_comp.png", 10), ("sh_11_comp.png", 11)]
    assert read_look(flare).names == look.names
