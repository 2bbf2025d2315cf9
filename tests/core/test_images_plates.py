# SPDX-License-Identifier: GPL-3.0-or-later
"""Plates: what they keep of their files when they are read and written."""
from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from core.errors import FrameError
from core.images.exr import read_exr
from core.images.formats import jpeg, png, tiff
from core.images.plates import read_plate, write_plate
from core.images.write import write_exr, write_png
from tests.core.removal_cases import picture, write_codes, write_tiff


def test_colour_tags_of_a_jpeg_are_copied(tmp_path: Path) -> None:
    codes = picture()
    write_codes(tmp_path / "a.jpg", codes)
    data = (tmp_path / "a.jpg").read_bytes()
    tags = ((0xE1, b"http://ns.adobe.com/xap/1.0/\0<x:xmpmeta/>"), (0xE2, b"ICC_PROFILE\0\x01\x01" + b"profile" * 3))
    segments = b"".join(jpeg.make_segment(*one) for one in tags)
    (tmp_path / "a.jpg").write_bytes(data[:2] + segments + data[2:])
    plate = read_plate(tmp_path / "a.jpg")
    write_plate(tmp_path / "b.jpg", plate, plate.codes // 2)
    assert segments in (tmp_path / "b.jpg").read_bytes()
    write_plate(tmp_path / "b.png", plate, plate.codes)
    assert np.array_equal(read_plate(tmp_path / "b.png").codes, plate.codes)


def test_the_tags_of_a_tiff_of_the_other_byte_order_are_read() -> None:
    entries = struct.pack(">HHII", tiff.COLOUR_PROFILE, 7, 6, 38) + struct.pack(">HHIHH", tiff.SAMPLES, 3, 1, 3, 0)
    data = b"MM\0*" + struct.pack(">IH", 8, 2) + entries + struct.pack(">I", 0) + b"colour"
    found = tiff.read_tags(io.BytesIO(data), (tiff.COLOUR_PROFILE, tiff.SAMPLES))
    assert found[tiff.COLOUR_PROFILE].values.tobytes() == b"colour" and found[tiff.SAMPLES].values[0] == 3
    more = tiff.with_tags(data, {tiff.EXTRA_SAMPLES: tiff.short(2), tiff.SAMPLES: tiff.short(4)})
    found = tiff.read_tags(io.BytesIO(more), range(1 << 16))
    assert {name: tag.values.tolist() for name, tag in found.items()} == {
        tiff.COLOUR_PROFILE: list(b"colour"), tiff.SAMPLES: [4], tiff.EXTRA_SAMPLES: [2]}
    for cut in range(len(more)):
        tiff.read_tags(io.BytesIO(more[:cut]), range(1 << 16))
        tiff.page_count(io.BytesIO(more[:cut]))


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_floats_of_a_tiff_stay_floats(channels: int, tmp_path: Path) -> None:
    light = np.random.default_rng(0).uniform(-1, 30, (24, 32, channels)).astype(np.float32)
    _, data = cv2.imencode(".tif", light, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    (tmp_path / "a.tif").write_bytes(data.tobytes())
    plate = read_plate(tmp_path / "a.tif")
    codes = plate.codes.copy()
    codes[4:9, 5:11] *= np.float32(0.5)
    write_plate(tmp_path / "b.tif", plate, codes)
    again = read_plate(tmp_path / "b.tif")
    np.testing.assert_array_equal(again.codes, codes)
    assert again.codes.dtype == np.float32
    if plate.alpha is not None:
        np.testing.assert_array_equal(again.alpha, plate.alpha)


@pytest.mark.parametrize(("depth", "key"), [(2, 1), (8, 90), (16, 90 * 257)])
def test_the_transparent_code_of_a_grey_png_is_its_alpha(depth: int, key: int, tmp_path: Path) -> None:
    top = 2**depth - 1
    grey = np.where(np.random.default_rng(0).random((8, 8)) < 0.5, key, top).astype(">u2" if depth == 16 else np.uint8)
    packed = grey if depth != 2 else sum(grey[:, part::4] << (6 - 2 * part) for part in range(4)).astype(np.uint8)
    parts = [(b"IHDR", struct.pack(">IIBBBBB", 8, 8, depth, 0, 0, 0, 0)), (b"tRNS", struct.pack(">H", key)),
             (b"IDAT", zlib.compress(b"".join(b"\0" + row.tobytes() for row in packed))), (b"IEND", b"")]
    (tmp_path / "a.png").write_bytes(png.SIGNATURE + b"".join(png.make_chunk(*part) for part in parts))
    plate = read_plate(tmp_path / "a.png")
    np.testing.assert_array_equal(plate.alpha == 0, grey == key)
    write_plate(tmp_path / "b.png", plate, plate.codes // 2)
    again = read_plate(tmp_path / "b.png")
    np.testing.assert_array_equal(again.alpha, plate.alpha)
    np.testing.assert_array_equal(again.codes, plate.codes // 2)


@pytest.mark.parametrize("compression", ["DWAA", "DWAB", "B44", "B44A", "ZIP"])
def test_unchanged_pixels_of_an_exr_stay_whatever_its_compression(compression: str, tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    noise = cv2.GaussianBlur(random.random((64, 96, 4)).astype(np.float32), (0, 0), 1.5).astype(np.float16)
    write_exr(tmp_path / "a.exr", {name: noise[..., k] for k, name in enumerate(("R", "G", "B", "mask.R"))},
              header={"compression": getattr(OpenEXR, f"{compression}_COMPRESSION")})
    plate = read_plate(tmp_path / "a.exr")
    codes = plate.codes.copy()
    codes[41:43, 59:66] *= np.float16(0.5)  # across the blocks of 4 x 4 that some compress by
    write_plate(tmp_path / "b.exr", plate, codes)
    again = read_plate(tmp_path / "b.exr")
    np.testing.assert_array_equal(again.codes, codes)
    np.testing.assert_array_equal(again.extras["channels"]["mask.R"], plate.extras["channels"]["mask.R"])


def test_a_tiled_exr_in_random_order_is_written_in_lines(tmp_path: Path) -> None:
    path = tmp_path / "tiles.exr"
    header = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription(), "lineOrder": OpenEXR.RANDOM_Y}
    pixels = {name: np.full((60, 90), 0.5, np.float16) for name in "RGB"}
    with OpenEXR.File(header, pixels) as file:
        file.write(str(path))
    plate = read_plate(path)
    write_plate(tmp_path / "clean.exr", plate, plate.codes / np.float16(2))
    assert np.array_equal(read_exr(tmp_path / "clean.exr")["R"], np.full((60, 90), 0.25))


def test_unsupported_pictures_are_refused_by_name(tmp_path: Path) -> None:
    codes = picture()
    _, data = cv2.imencode(".jpg", codes)
    jpeg = bytearray(data.tobytes())
    frame = jpeg.index(b"\xff\xc0")
    jpeg[frame + 9] = 4  # components; the sentence is about that, before a decoder looks at the rest
    (tmp_path / "print.jpg").write_bytes(jpeg)
    with pytest.raises(FrameError, match=r"print\.jpg is CMYK"):
        read_plate(tmp_path / "print.jpg")
    write_tiff(tmp_path / "inks.tif", np.zeros((8, 8, 4), np.uint8), {tiff.PHOTOMETRIC: tiff.short(tiff.SEPARATED)})
    with pytest.raises(FrameError, match=r"inks\.tif is CMYK"):
        read_plate(tmp_path / "inks.tif")
    write_tiff(tmp_path / "lab.tif", np.zeros((8, 8, 3), np.uint16), {tiff.PHOTOMETRIC: tiff.short(tiff.LAB[0])})
    with pytest.raises(FrameError, match=r"lab\.tif is in Lab colours"):
        read_plate(tmp_path / "lab.tif")
    write_tiff(tmp_path / "mask.tif", np.zeros((8, 8, 4), np.uint8), {tiff.SAMPLES: tiff.short(5)})
    with pytest.raises(FrameError, match=r"mask\.tif has 5 channels"):
        read_plate(tmp_path / "mask.tif")
    write_tiff(tmp_path / "long.tif", np.zeros((8, 8), np.float32), {tiff.SAMPLE_FORMAT: tiff.short(tiff.UNSIGNED)})
    with pytest.raises(FrameError, match="holds whole numbers of 32 bits"):
        read_plate(tmp_path / "long.tif")
    jpeg[frame + 9], jpeg[frame + 4] = 3, 12
    (tmp_path / "deep.jpg").write_bytes(jpeg)
    with pytest.raises(FrameError, match=r"deep\.jpg holds 12 bits a colour; save it with 8"):
        read_plate(tmp_path / "deep.jpg")
    _, still = cv2.imencode(".png", codes)
    for frames in (1, 2):
        chunk = png.make_chunk(b"acTL", frames.to_bytes(4, "big") + bytes(4))
        (tmp_path / f"{frames}.png").write_bytes(still.tobytes()[:33] + chunk + still.tobytes()[33:])
    assert read_plate(tmp_path / "1.png").codes.shape == codes.shape
    with pytest.raises(FrameError, match=r"2\.png is an animated PNG; export its frames"):
        read_plate(tmp_path / "2.png")
    Image.fromarray(codes).save(tmp_path / "moving.webp", save_all=True, append_images=[Image.fromarray(255 - codes)])
    with pytest.raises(FrameError, match=r"moving\.webp is an animation; export its frames"):
        read_plate(tmp_path / "moving.webp")
    Image.fromarray(codes).save(tmp_path / "packed.tif", compression="zstd")
    try:  # some builds of the library have it
        assert np.array_equal(read_plate(tmp_path / "packed.tif").codes, codes)
    except FrameError as problem:
        assert "is compressed with Zstandard, which the TIFF library here is built without" in str(problem)
    _, pages = cv2.imencodemulti(".tif", [codes, codes, codes])
    (tmp_path / "pages.tif").write_bytes(pages.tobytes())
    with pytest.raises(FrameError, match="3 pages"):
        read_plate(tmp_path / "pages.tif")


def test_a_written_png_is_read_as_a_plate(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.full((3, 4, 3), 0.5), bits=16)
    plate = read_plate(tmp_path / "a.png")
    assert plate.max_code == 65535
    assert plate.codes[0, 0, 0] == 32768


def test_a_jpeg_keeps_its_chroma_resolution(tmp_path: Path) -> None:
    codes = np.zeros((32, 32, 3), np.uint8)
    codes[:, ::2, 2] = codes[:, 1::2, 0] = 220  # columns of red and blue
    full = [cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    assert cv2.imwrite(str(tmp_path / "a.jpg"), codes, full)
    plate = read_plate(tmp_path / "a.jpg")
    changed = plate.codes.copy()
    changed[0, 0] = 7
    write_plate(tmp_path / "b.jpg", plate, changed)
    before, after = (cv2.imread(str(tmp_path / name))[16:].astype(int) for name in ("a.jpg", "b.jpg"))
    assert np.abs(after - before).max() < 30
