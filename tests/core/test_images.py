# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures read back as they were written, and broken ones are refused by name."""
from __future__ import annotations

import contextlib
import errno
import os
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from core.capture import Capture
from core.colour import colour_space
from core.colour.srgb import linear_from_srgb, srgb_from_linear
from core.errors import CaptureError, FrameError
from core.images import exr, read, size, write
from core.images.exr import channel_names, is_exr_truncated, read_data_window, read_exr
from core.images.formats import tiff
from core.images.picture import Picture
from core.images.plates import read_plate
from core.images.read import read_picture
from core.images.size import picture_size
from core.images.write import save_exr, write_exr, write_png

RAMP = np.random.default_rng(0).uniform(0, 1, (7, 9, 3)).astype(np.float32)


def test_srgb_matches_the_standard_and_inverts() -> None:
    # IEC 61966-2-1: 18 % grey is 0.4614, and 0.0031308 the end of the linear part.
    assert srgb_from_linear(np.float32([0.18]))[0] == pytest.approx(0.46136, abs=1e-5)
    assert srgb_from_linear(np.float32([0.0031308]))[0] == pytest.approx(0.04045, abs=1e-5)
    values = np.linspace(-2, 50, 1001, dtype=np.float32)
    assert np.allclose(linear_from_srgb(srgb_from_linear(values)), values, rtol=2e-6, atol=1e-7)


@pytest.mark.parametrize(("bits", "step"), [(8, 1 / 255), (16, 1 / 65535)])
def test_a_png_is_read_as_it_was_written(tmp_path: Path, bits: int, step: float) -> None:
    write_png(tmp_path / "a.png", RAMP, bits)  # type: ignore[arg-type]
    picture = read_picture(tmp_path / "a.png")
    assert picture.encoding == "srgb"
    assert picture_size(tmp_path / "a.png") == picture.size == (9, 7)
    assert np.abs(picture.pixels - RAMP).max() <= step / 2 + 1e-6


@pytest.mark.parametrize("suffix", [".jpg", ".tif", ".png"])
def test_sizes_come_from_the_header(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), np.zeros((30, 50, 3), np.uint8))
    assert picture_size(path) == (50, 30) == read_picture(path).size


def test_grey_and_alpha_become_three_channels(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((4, 5), 51, np.uint8))
    cv2.imwrite(str(tmp_path / "alpha.png"), np.full((4, 5, 4), 51, np.uint8))
    for name in ("grey.png", "alpha.png"):
        assert np.allclose(read_picture(tmp_path / name).pixels, 0.2)
        assert read_picture(tmp_path / name).pixels.shape == (4, 5, 3)


def test_exr_keeps_values_above_one_and_names(tmp_path: Path) -> None:
    channels = {"R": RAMP[..., 0] * 40, "G": RAMP[..., 1], "B": RAMP[..., 2], "flare_lamp.R": RAMP[..., 0],
                "depth.Z": RAMP[..., 1] * 1e7}
    write_exr(tmp_path / "a.exr", channels, half=True)
    back = read_exr(tmp_path / "a.exr")
    assert back.keys() == channels.keys()
    assert np.allclose(back["R"], channels["R"], rtol=1e-3)
    assert np.array_equal(back["depth.Z"], channels["depth.Z"])  # depth is never halved
    picture = read_picture(tmp_path / "a.exr")
    assert picture.encoding == "linear"
    assert picture_size(tmp_path / "a.exr") == picture.size == (9, 7)


def test_area_average_keeps_the_mean() -> None:
    picture = Picture(np.tile(RAMP[:6, :8], (2, 2, 1)), "linear").resized(4, 3)
    assert picture.pixels.shape == (3, 4, 3)
    assert picture.pixels.mean() == pytest.approx(RAMP[:6, :8].mean(), rel=1e-5)


def _truncated(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def test_broken_files_are_refused_by_name(tmp_path: Path) -> None:
    for name in ("a.png", "a.jpg", "a.tif"):
        cv2.imwrite(str(tmp_path / name), np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8))
    write_exr(tmp_path / "a.exr", {name: np.full((64, 64), 0.3) for name in "RGB"})
    for name in ("a.png", "a.tif", "a.exr"):
        _truncated(tmp_path / name)
        with pytest.raises(FrameError, match=name):
            read_picture(tmp_path / name)
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.jpg").write_text("no picture")
    (tmp_path / "folder.png").mkdir()
    for name in ("empty.png", "text.jpg", "folder.png", "missing.png", "clip.mov"):
        with pytest.raises(FrameError, match=name):
            read_picture(tmp_path / name)


@pytest.mark.parametrize("read", [read_picture, read_plate])
def test_a_video_is_refused_with_a_way_to_extract_its_frames(read: Callable[[Path], object], tmp_path: Path) -> None:
    for name, message in (("a.MP4", r"a\.MP4 is a video; .*ffmpeg -i a\.MP4"), ("a.txt", r"a\.txt is not a picture")):
        (tmp_path / name).touch()
        with pytest.raises(FrameError, match=message):
            read(tmp_path / name)
    with pytest.raises(CaptureError, match=r"a\.MP4 is a video; .*solve a\.MP4"):
        Capture.open(tmp_path / "a.MP4")


def test_a_header_that_claims_too_much_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    huge = (2**31 - 1).to_bytes(4, "big")
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + huge + huge + b"\x08\x02\0\0\0")
    with pytest.raises(FrameError, match="claims"):
        read_picture(tmp_path / "bomb.png")


def test_a_chunk_that_claims_too_much_is_refused_before_memory_is_taken(tmp_path: Path,
                                                                        monkeypatch: pytest.MonkeyPatch) -> None:
    write_png(tmp_path / "bomb.png", RAMP)
    data = bytearray((tmp_path / "bomb.png").read_bytes())
    place = data.index(b"IDAT") - 4
    data[place:place + 4] = b"\x7f\xff\xff\xff"
    (tmp_path / "bomb.png").write_bytes(data)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("given to OpenCV, which makes room for 2 GB"))
    with pytest.raises(FrameError, match=r"bomb\.png is damaged or truncated"):
        read_picture(tmp_path / "bomb.png")


def test_bytes_after_the_end_of_a_png_are_ignored(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", RAMP)
    whole = read_picture(tmp_path / "a.png").display()
    with open(tmp_path / "a.png", "ab") as stream:
        stream.write(b"\xff" * 11)
    assert np.array_equal(read_picture(tmp_path / "a.png").display(), whole)


@pytest.mark.parametrize(("kind", "count", "width"), [
    (11, 1, struct.pack("<f", np.nan)), (11, 1, struct.pack("<f", np.inf)), (12, 0xFFFFFFFF, struct.pack("<I", 8)),
    (3, 2, struct.pack("<HH", 9, 9))], ids=["not a number", "infinite", "more than the file", "two numbers"])
def test_a_tiff_with_an_invalid_width_is_refused(kind: int, count: int, width: bytes, tmp_path: Path) -> None:
    entries = [(tiff.WIDTH, kind, count, width), (tiff.HEIGHT, 3, 1, struct.pack("<H", 7))]
    (tmp_path / "a.tif").write_bytes(struct.pack("<2sHIH", b"II", 42, 8, len(entries)) + b"".join(
        struct.pack("<HHI4s", *entry) for entry in entries) + bytes(4))
    with pytest.raises(FrameError, match=r"a\.tif is not a picture, or its header is damaged"):
        picture_size(tmp_path / "a.tif")


@pytest.mark.parametrize("name", [tiff.EXTRA_SAMPLES, tiff.SAMPLES])
def test_a_tiff_with_an_invalid_tag_is_read_or_refused(name: int, tmp_path: Path) -> None:
    done, data = cv2.imencode(".tif", np.full((4, 5, 4), 51, np.uint8))
    assert done
    (tmp_path / "a.tif").write_bytes(tiff.with_tags(data.tobytes(), {
        name: tiff.Tag(11, np.array([np.nan], np.float32))}))
    for reads in (read_picture, read_plate):
        with contextlib.suppress(FrameError):
            reads(tmp_path / "a.tif")


def test_nan_in_an_exr_is_refused(tmp_path: Path) -> None:
    pixels = np.zeros((4, 4), np.float32)
    pixels[1, 2] = np.nan
    write_exr(tmp_path / "nan.exr", {"R": pixels, "G": pixels, "B": pixels})
    with pytest.raises(FrameError, match=r"nan\.exr"):
        read_picture(tmp_path / "nan.exr")


def test_an_exr_in_another_space_is_read_as_rec_709(tmp_path: Path) -> None:
    """ACEScg by its chromaticities; no light is lost below 0 or above 1."""
    aces = colour_space("acescg")
    light = np.array([[[0.2, 0.5, 4.0], [0.0, 1.0, 0.0]]], np.float32)
    stored = aces.from_linear(light)
    write_exr(tmp_path / "a.exr", {name: stored[..., index] for index, name in enumerate("RGB")}, half=False,
              header={"chromaticities": aces.chromaticities})
    np.testing.assert_allclose(read_picture(tmp_path / "a.exr").pixels, light, atol=1e-5)
    write_exr(tmp_path / "bad.exr", dict.fromkeys("RGB", stored[..., 0]), header={"chromaticities": (0.3,) * 8})
    with pytest.raises(FrameError, match=r"bad\.exr has chromaticities"):
        read_picture(tmp_path / "bad.exr")


def test_a_picture_is_shrunk_in_linear_light() -> None:
    board = np.zeros((4, 4, 3), np.float32)
    board[::2, ::2] = board[1::2, 1::2] = 1
    small = Picture(board, "srgb").resized(2, 2)
    assert small.encoding == "srgb"
    np.testing.assert_allclose(small.linear(), 0.5, atol=1e-6)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere all names are Unicode")
def test_a_folder_that_is_not_utf8_is_refused_by_name(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    with pytest.raises(FrameError, match="is not UTF-8"):
        write_exr(folder / "a.exr", {"R": np.zeros((2, 2), np.float32)})
    assert not folder.exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the device that is always full, which Linux has")
def test_a_full_disk_is_reported_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextlib.contextmanager
    def full(_target: Path, _turn: object = None) -> Iterator[Path]:
        yield Path("/dev/full")

    monkeypatch.setattr(write, "atomic_path", full)
    for sides in ((200, 300), (2, 2)):  # the smaller is refused no sooner than at its closing
        with pytest.raises(OSError) as error:
            write_exr(tmp_path / "a.exr", {"R": np.random.default_rng(0).random(sides).astype(np.float32)})
        assert error.value.errno == errno.ENOSPC
        assert error.value.filename == str(tmp_path / "a.exr")
    with pytest.raises(OSError) as error:
        write_png(tmp_path / "a.png", RAMP)
    assert error.value.errno == errno.ENOSPC


def test_a_tiff_with_0_for_white_is_read_as_what_it_shows(tmp_path: Path) -> None:
    """OpenCV reads one of 16 bits as its negative."""
    codes = (RAMP[..., 0] * 65535).astype(np.uint16)
    data = cv2.imencode(".tif", 65535 - codes)[1].tobytes()
    (tmp_path / "a.tif").write_bytes(tiff.with_tags(data, {tiff.PHOTOMETRIC: tiff.short(tiff.WHITE_IS_0)}))
    for pixels in (read_plate(tmp_path / "a.tif").codes, read_picture(tmp_path / "a.tif").pixels * 65535):
        np.testing.assert_allclose(pixels, np.repeat(codes[..., None], 3, -1), atol=0.6)


def test_other_channels_of_an_exr_are_not_read_as_picture(tmp_path: Path) -> None:
    """The colours are read although a part before them holds depth, cropped to a region and infinite."""
    depth = np.full((3, 2), np.inf, np.float32)
    parts = [OpenEXR.Part({"name": "depth", "type": OpenEXR.scanlineimage,
                           "dataWindow": ((4, 2), (5, 4)), "displayWindow": ((0, 0), (8, 6))}, {"Z": depth}),
             OpenEXR.Part({"name": "rgba", "type": OpenEXR.scanlineimage, "dataWindow": ((0, 0), (8, 6)),
                           "displayWindow": ((0, 0), (8, 6))},
                          {name: np.ascontiguousarray(RAMP[..., index]) for index, name in enumerate("RGB")})]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_picture(tmp_path / "a.exr").pixels, RAMP)
    assert read_data_window(tmp_path / "a.exr").is_frame
    with pytest.raises(FrameError, match="channel Z that are not finite"):
        read_exr(tmp_path / "a.exr")


def test_a_deep_exr_is_refused(tmp_path: Path) -> None:
    samples = np.empty((2, 2), object)
    for place in np.ndindex(2, 2):
        samples[place] = np.arange(3, dtype=np.float32)
    with OpenEXR.File({"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION},
                      dict.fromkeys("RGB", samples)) as file:
        file.write(str(tmp_path / "deep.exr"))
    with pytest.raises(FrameError, match=r"deep\.exr is a deep EXR"):
        read_picture(tmp_path / "deep.exr")


def test_the_first_of_parts_with_equal_channel_names_is_read(tmp_path: Path) -> None:
    parts = [OpenEXR.Part({"name": name, "type": OpenEXR.scanlineimage},
                          dict.fromkeys("RGB", np.full((4, 5), value, np.float32)))
             for name, value in (("left", 0.25), ("right", 0.75))]
    with OpenEXR.File(parts) as file:
        file.write(str(tmp_path / "two.exr"))
    assert (read_picture(tmp_path / "two.exr").pixels == 0.25).all()


def test_a_long_header_before_the_size_is_no_damage(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", RAMP[..., 0]), header={"cryptomatte/manifest": "x" * 90_000})
    assert picture_size(tmp_path / "a.exr") == RAMP.shape[1::-1]


@pytest.mark.parametrize(("low", "high"), [((-4, -2), (23, 13)), ((3, 2), (9, 30)), ((40, 0), (50, 3))])
def test_an_exr_is_cropped_to_its_display_window(low: tuple[int, int], high: tuple[int, int], tmp_path: Path) -> None:
    """With overscan, with a part left out, with nothing on the frame at all."""
    width, height = high[0] - low[0] + 1, high[1] - low[1] + 1
    stored = np.random.default_rng(0).random((height, width)).astype(np.float32)
    windows = {name: (np.array(first, np.int32), np.array(last, np.int32))
               for name, first, last in (("dataWindow", low, high), ("displayWindow", (0, 0), (19, 11)))}
    write.write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", stored), half=False, header=windows)
    assert size.picture_size(tmp_path / "a.exr") == (20, 12)
    found = read.read_picture(tmp_path / "a.exr").pixels
    expected = np.zeros((12, 20), np.float32)
    for y in range(12):
        for x in range(20):
            if low[0] <= x <= high[0] and low[1] <= y <= high[1]:
                expected[y, x] = stored[y - low[1], x - low[0]]
    np.testing.assert_array_equal(found[..., 0], expected)
    window = exr.read_data_window(tmp_path / "a.exr")
    assert (window.size, window.origin, window.is_frame) == ((width, height), low, False)


def test_channel_names_are_read_from_the_header(tmp_path: Path) -> None:
    names = ["R", "flare_key light.R", "flare_ö.A", "depth.Z"]
    write_exr(tmp_path / "a.exr", dict.fromkeys(names, RAMP[..., 0]), header={"view": "x" * 90_000})
    assert sorted(channel_names(tmp_path / "a.exr")) == sorted(names)


@pytest.mark.parametrize("damage", [
    lambda whole: whole[:0], lambda whole: whole[:40], lambda whole: b"\x89PNG" + whole[4:],
    lambda whole: whole.replace(b"chlist\0" + whole.split(b"chlist\0")[1][:4], b"chlist\0\xff\xff\xff\x7f"),
    lambda whole: whole.replace(b"flare", b"\0lare")])
def test_a_damaged_header_is_reported(damage: Callable[[bytes], bytes], tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {"flare.R": RAMP[..., 0]})
    (tmp_path / "a.exr").write_bytes(damage((tmp_path / "a.exr").read_bytes()))
    with pytest.raises(FrameError, match=r"a\.exr is not an EXR, or its header is damaged"):
        channel_names(tmp_path / "a.exr")


@pytest.mark.parametrize("lines", [1, 16, 257])
@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"])
def test_a_truncated_exr_is_recognised_by_its_offset_table(compression: str, lines: int, tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    header = {"type": OpenEXR.scanlineimage, "compression": getattr(OpenEXR, f"{compression}_COMPRESSION")}
    save_exr(path, header, {"R": np.random.default_rng(0).random((lines, 9)).astype(np.float16)})
    whole = path.read_bytes()
    assert not is_exr_truncated(path)
    for length in (len(whole) - 1, len(whole) // 2, 100, 8):
        path.write_bytes(whole[:length])
        assert is_exr_truncated(path), length
        with pytest.raises(FrameError, match=r"a\.exr"):
            read_picture(path)


def test_a_tiled_exr_is_not_checked_for_truncation(tmp_path: Path) -> None:
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    save_exr(tmp_path / "a.exr", tiles, {"R": RAMP[..., 0]})
    assert not is_exr_truncated(tmp_path / "a.exr")
