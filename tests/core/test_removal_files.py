# SPDX-License-Identifier: GPL-3.0-or-later
"""Clean plates keep format, depth, tags and other channels of their plates."""
from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from core.colour.spaces import AP1
from core.images.exr import read_exr
from core.images.formats import tiff
from core.images.plates import read_plate
from core.images.read import read_picture
from core.images.write import save_exr, write_exr
from core.removal.inference.remover import Remover
from core.removal.jobs.batch import clean_plates
from core.system.progress import Progress
from tests.core.removal_cases import picture, write_codes, write_tiff


@pytest.mark.parametrize(("suffix", "dtype"), [(".png", np.uint8), (".png", np.uint16), (".tif", np.uint8),
                                               (".tif", np.uint16), (".tiff", np.float32), (".jpg", np.uint8)])
def test_a_clean_plate_has_the_format_and_depth_of_its_plate(
        tmp_path: Path, flare_everywhere: Path, suffix: str, dtype: type) -> None:
    codes = picture(max_code=1 if dtype is np.float32 else np.iinfo(dtype).max, dtype=dtype)
    source = write_codes(tmp_path / f"plate{suffix}", codes)
    clean_plates([source], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress())
    result = cv2.imread(str(tmp_path / "out" / source.name), cv2.IMREAD_UNCHANGED)
    assert result.dtype == dtype
    assert result.shape == codes.shape
    assert result.mean() < codes.mean()


def test_grey_and_alpha_are_preserved(tmp_path: Path, flare_everywhere: Path) -> None:
    grey, alpha = picture()[..., 0], np.random.default_rng(0).integers(0, 256, (60, 90, 4), np.uint8)
    (tmp_path / "in").mkdir()
    write_codes(tmp_path / "in" / "grey.png", grey)
    write_codes(tmp_path / "in" / "alpha.png", alpha)
    clean_plates([tmp_path / "in"], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress())
    assert cv2.imread(str(tmp_path / "out" / "grey.png"), cv2.IMREAD_UNCHANGED).shape == (60, 90)
    result = cv2.imread(str(tmp_path / "out" / "alpha.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(result[..., 3], alpha[..., 3])
    assert not np.array_equal(result[..., :3], alpha[..., :3])


@pytest.mark.parametrize("half", [True, False])
def test_an_exr_keeps_values_above_one_other_channels_and_nans(
        tmp_path: Path, flare_everywhere: Path, half: bool) -> None:
    colour = np.random.default_rng(0).uniform(0, 0.6, (48, 64, 3)).astype(np.float32)
    colour[10:14, 10:14] = 40.0
    colour[30, 30] = np.nan
    colour[31, 31, 0] = np.inf
    channels = {name: colour[..., k].copy() for k, name in enumerate("RGB")}
    write_exr(tmp_path / "plate.exr", {**channels, "A": np.full((48, 64), 0.5), "depth.Z": np.full((48, 64), 7.25)},
              half=half, header={"comments": "shot 10"})
    stored = read_plate(tmp_path / "plate.exr")
    clean_plates([tmp_path / "plate.exr"], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress())
    clean = read_plate(tmp_path / "out" / "plate.exr")
    assert clean.codes.dtype == stored.codes.dtype == (np.float16 if half else np.float32)
    assert clean.codes[11, 11].min() > 38
    assert np.isnan(clean.codes[30, 30]).all()
    assert half or np.isinf(clean.codes[31, 31, 0])
    assert clean.extras["channels"]["depth.Z"].dtype == np.float32
    assert np.array_equal(clean.extras["channels"]["A"], stored.extras["channels"]["A"])
    assert clean.extras["header"]["comments"] == "shot 10"
    assert np.nanmean(clean.codes.astype(np.float32)[20:30]) < np.nanmean(stored.codes.astype(np.float32)[20:30])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("alpha", [tiff.UNASSOCIATED, tiff.ASSOCIATED])
def test_a_tiff_keeps_its_alpha_profile_and_orientation(tmp_path: Path, flare_everywhere: Path, dtype: type,
                                                        alpha: int) -> None:
    codes = (np.random.default_rng(0).random((60, 90, 4)) * np.iinfo(dtype).max).astype(dtype)
    tags = {tiff.EXTRA_SAMPLES: tiff.short(alpha), tiff.ORIENTATION: tiff.short(6),
            tiff.COLOUR_PROFILE: tiff.Tag(7, np.arange(200, dtype=np.uint8)),
            tiff.X_RESOLUTION: tiff.Tag(5, np.array([300, 1], np.uint32))}
    source = write_tiff(tmp_path / "plate.tif", codes, tags)
    plate = read_plate(source)
    assert np.array_equal(plate.codes, codes[..., 2::-1]) and np.array_equal(plate.alpha, codes[..., 3])
    assert np.array_equal(read_picture(source).pixels, codes[..., 2::-1] / np.float32(np.iinfo(dtype).max))
    clean_plates([source], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress())
    clean = read_plate(tmp_path / "out" / "plate.tif")
    assert np.array_equal(clean.alpha, codes[..., 3]) and clean.codes.mean() < plate.codes.mean()
    with open(tmp_path / "out" / "plate.tif", "rb") as stream:
        kept = tiff.read_tags(stream, tags)
    assert {name: (tag.kind, tag.values.tolist()) for name, tag in kept.items()} == {
        name: (tag.kind, tag.values.tolist()) for name, tag in tags.items()}


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".exr"])
def test_a_plate_without_a_flare_is_copied(tmp_path: Path, no_flare: Path, suffix: str) -> None:
    source = tmp_path / f"plate{suffix}"
    if suffix == ".exr":
        write_exr(source, dict.fromkeys("RGB", np.full((60, 90), np.nan)))
    else:
        _, data = cv2.imencode(suffix, picture(), [cv2.IMWRITE_JPEG_QUALITY, 60] if suffix == ".jpg" else [])
        source.write_bytes(data.tobytes())
    clean_plates([source], tmp_path / "out", Remover(no_flare, working_size=64), Progress())
    assert (tmp_path / "out" / source.name).read_bytes() == source.read_bytes()


def test_the_profile_of_a_grey_png_is_not_copied_to_colours(tmp_path: Path, flare_everywhere: Path) -> None:
    def chunk(name: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + name + data + zlib.crc32(name + data).to_bytes(4, "big")

    rows = b"".join(b"\0" + bytes([90, 200] * 64) for _ in range(64))
    header = struct.pack(">IIBBBBB", 64, 64, 8, 4, 0, 0, 0)
    profile = chunk(b"iCCP", b"grey\0\0" + zlib.compress(b"profile"))
    size = chunk(b"pHYs", bytes(9)) + chunk(b"tEXt", b"Author\0someone")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + profile + size
                                     + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))
    clean_plates([tmp_path / "a.png"], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress())
    clean = (tmp_path / "out" / "a.png").read_bytes()
    assert size in clean and b"iCCP" not in clean
    assert (read_plate(tmp_path / "out" / "a.png").alpha == 200).all()


def test_each_channel_of_an_exr_keeps_its_depth(tmp_path: Path, flare_everywhere: Path) -> None:
    light = np.random.default_rng(0).uniform(0.2, 0.6, (48, 64)).astype(np.float16)
    save_exr(tmp_path / "plate.exr", {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage},
             {"R": light, "G": light.astype(np.float32), "B": light})
    clean_plates([tmp_path / "plate.exr"], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress())
    channels = read_plate(tmp_path / "out" / "plate.exr").extras["channels"]
    assert [channels[name].dtype for name in "RGB"] == [np.float16, np.float32, np.float16]
    assert (channels["R"] < light).all()


def test_the_flare_of_an_exr_has_the_windows_and_colours_of_its_plate(tmp_path: Path, flare_everywhere: Path) -> None:
    light = np.random.default_rng(0).uniform(0.2, 0.6, (48, 64)).astype(np.float32)
    header = {"chromaticities": AP1, "dataWindow": (np.array([-5, -5], np.int32), np.array([58, 42], np.int32)),
              "displayWindow": (np.array([0, 0], np.int32), np.array([53, 37], np.int32)), "pixelAspectRatio": 2.0}
    write_exr(tmp_path / "plate.exr", dict.fromkeys("RGB", light), half=False, header=header)
    clean_plates([tmp_path / "plate.exr"], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress(),
                 flare_folder=tmp_path / "flare")
    placings = []
    for folder in ("", "out", "flare"):
        with OpenEXR.File(str(tmp_path / folder / "plate.exr"), header_only=True) as file:
            placings.append([np.ravel(file.parts[0].header[name]).tolist() for name in header])
    assert placings[0] == placings[1] == placings[2]
    parts = [read_picture(tmp_path / folder / "plate.exr").pixels for folder in ("", "out", "flare")]
    np.testing.assert_allclose(parts[1] + parts[2], parts[0], atol=1e-3)


def test_the_written_flare_is_the_difference_of_plate_and_clean_plate(tmp_path: Path, flare_everywhere: Path) -> None:
    write_codes(tmp_path / "plate.png", picture())
    clean_plates([tmp_path / "plate.png"], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress(),
                 flare_folder=tmp_path / "flare")
    flare = read_exr(tmp_path / "flare" / "plate.exr")
    before, after = (read_picture(path).linear() for path in (tmp_path / "plate.png", tmp_path / "out" / "plate.png"))
    np.testing.assert_allclose(np.stack([flare[name] for name in "RGB"], -1), before - after, atol=1e-3)


def test_a_grey_png_with_alpha_stays_grey(tmp_path: Path, flare_everywhere: Path) -> None:
    """OpenCV reads it as colour, and writes no such file: three equal channels and the alpha come of it."""
    grey = cv2.cvtColor(picture(), cv2.COLOR_BGR2GRAY)
    with_alpha = np.stack([grey, 255 - grey], -1)
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", grey.shape[1], grey.shape[0], 8, 4, 0, 0, 0)),
              (b"IDAT", zlib.compress(b"".join(b"\0" + row.tobytes() for row in with_alpha))), (b"IEND", b"")]
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks))
    clean_plates([tmp_path / "in"], tmp_path / "out", Remover(flare_everywhere, working_size=64), Progress())
    clean = cv2.imread(str(tmp_path / "out" / "a.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(clean[..., 3], with_alpha[..., 1])
    assert np.ptp(clean[..., :3], axis=-1).max() == 0
    assert not np.array_equal(clean[..., 0], grey)
