# SPDX-License-Identifier: GPL-3.0-or-later
"""Which way a photograph is up, and through what lens it was taken."""
from __future__ import annotations

import io
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, features

from core.images.formats import tiff
from core.images.formats.exif import apply_orientation, read_exif, undo_orientation, without_thumbnail
from core.images.plates import clean_name, read_plate, write_plate
from core.images.size import picture_size
from core.images.video import Video


def exif_segment(order: str, orientation: int, focal: int) -> bytes:
    """Return a JPEG's Exif segment with an orientation and a 35 mm focal length. order: of bytes, "II" or "MM"."""
    sign = "little" if order == "II" else "big"

    def number(value: int, size: int) -> bytes:
        return value.to_bytes(size, sign)

    def entry(tag: int, kind: int, value: int) -> bytes:
        return number(tag, 2) + number(kind, 2) + number(1, 4) + (number(value, 2) + b"\0\0" if kind == 3 else
                                                                  number(value, 4))

    block = order.encode() + number(42, 2) + number(8, 4)
    block += number(2, 2) + entry(0x0112, 3, orientation) + entry(0x8769, 4, 38) + number(0, 4)
    block += number(1, 2) + entry(0xA405, 3, focal) + number(0, 4)
    return b"\xff\xe1" + (len(block) + 8).to_bytes(2, "big") + b"Exif\0\0" + block


@pytest.mark.parametrize("order", ["II", "MM"])
def test_exif_gives_orientation_and_focal_length(tmp_path: Path, order: str) -> None:
    _, data = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))
    raw = data.tobytes()
    (tmp_path / "a.jpg").write_bytes(raw[:2] + exif_segment(order, 6, 27) + raw[2:])
    assert read_exif(tmp_path / "a.jpg") == (6, 0.75)
    (tmp_path / "b.jpg").write_bytes(raw)
    assert read_exif(tmp_path / "b.jpg") == (1, None)
    (tmp_path / "c.jpg").write_bytes(raw[:2] + exif_segment(order, 6, 27)[:40])
    assert read_exif(tmp_path / "c.jpg") == (1, None)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_orientation_of_pngs_and_tiffs(suffix: str, tmp_path: Path) -> None:
    """Orientation is read from the Exif chunk of a PNG and the tags of a TIFF, and a damaged file has none."""
    raw = cv2.imencode(suffix, np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    (tmp_path / f"plain{suffix}").write_bytes(raw)
    assert read_exif(tmp_path / f"plain{suffix}") == (1, None)
    block = b"eXIf" + exif_segment("MM", 6, 27)[10:]
    chunk = (len(block) - 4).to_bytes(4, "big") + block + zlib.crc32(block).to_bytes(4, "big")
    turned = (raw[:-12] + chunk + raw[-12:] if suffix == ".png" else
              tiff.with_tags(raw, {tiff.ORIENTATION: tiff.short(6)}))
    (tmp_path / f"turned{suffix}").write_bytes(turned)
    assert read_exif(tmp_path / f"turned{suffix}") == (6, 0.75 if suffix == ".png" else None)
    (tmp_path / f"cut{suffix}").write_bytes(turned[:60])
    assert read_exif(tmp_path / f"cut{suffix}")[1] is None


@pytest.mark.parametrize("orientation", [1, 6, 8, 3, 5])
@pytest.mark.parametrize("suffix", [".webp", ".avif", ".jpg", ".png", ".tif"])
def test_a_picture_of_each_format_is_turned_as_viewers_show_it(suffix: str, orientation: int, tmp_path: Path) -> None:
    """By the Exif block, or by the rotation that the format itself states, which Pillow writes into an AVIF."""
    if suffix == ".avif" and not features.check("avif"):
        pytest.skip("Pillow is built without AVIF")
    shown = np.full((40, 60, 3), 60, np.uint8)
    shown[:12, 36:] = (250, 120, 30)
    exif = Image.Exif()
    exif[tiff.ORIENTATION] = orientation
    path = tmp_path / f"phone{suffix}"
    Image.fromarray(undo_orientation(shown, orientation)).save(path, exif=exif, quality=95)
    codes = read_plate(path).codes
    assert picture_size(path) == codes.shape[1::-1]
    seen = apply_orientation(codes, read_exif(path)[0]).astype(int)
    assert seen.shape == shown.shape and np.abs(seen - shown).mean() < 4
    written = clean_name(tmp_path / f"clean{suffix}")
    write_plate(written, read_plate(path), codes // 2)
    again = apply_orientation(read_plate(written).codes, read_exif(written)[0]).astype(int)
    assert again.shape == shown.shape and np.abs(again - seen // 2).mean() < 3


@pytest.mark.parametrize("suffix", [".heic", ".avif"])
def test_a_phones_pictures_give_their_focal_length_and_keep_what_describes_them(suffix: str, tmp_path: Path) -> None:
    if suffix == ".heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    elif not features.check("avif"):
        pytest.skip("Pillow is built without AVIF")
    exif = Image.Exif()
    exif[tiff.ORIENTATION], exif[0x13B] = 6, "Ada"
    exif.get_ifd(0x8769)[0xA405] = 27
    xmp = (b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
           b'<rdf:Description xmlns:dc="http://purl.org/dc/elements/1.1/" dc:format="image/heic" '
           b'xmlns:HDRGainMap="http://ns.apple.com/HDRGainMap/1.0/" HDRGainMap:HDRGainMapVersion="65536"/>'
           b"</rdf:RDF></x:xmpmeta>")
    path = tmp_path / f"IMG_0001{suffix}"
    Image.fromarray(np.full((40, 60, 3), 90, np.uint8)).save(path, exif=exif.tobytes(), xmp=xmp)
    assert read_exif(path) == (1, 0.75)
    plate = read_plate(path)
    write_plate(tmp_path / "clean.png", plate, plate.codes // 2)
    assert read_exif(tmp_path / "clean.png") == (1, 0.75)
    with Image.open(tmp_path / "clean.png") as clean:
        assert clean.getexif()[0x13B] == "Ada"
        assert "image/heic" in str(clean.info["xmp"]) and "HDRGainMap" not in str(clean.info["xmp"])


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("order", ["II", "MM"])
def test_a_clean_picture_has_no_thumbnail_with_the_flare(order: str, suffix: str, tmp_path: Path) -> None:
    thumbnail = cv2.imencode(".jpg", np.full((20, 30, 3), 250, np.uint8))[1].tobytes()
    block = exif_segment(order, 6, 27)[10:]
    first = 34
    sign: Any = "little" if order == "II" else "big"
    at, end = len(block), len(block) + 2 + 24 + 4
    entries = b"".join(tag.to_bytes(2, sign) + (4).to_bytes(2, sign) + (1).to_bytes(4, sign) + value.to_bytes(4, sign)
                       for tag, value in ((0x201, end), (0x202, len(thumbnail))))
    block = (block[:first] + at.to_bytes(4, sign) + block[first + 4:] + (2).to_bytes(2, sign) + entries + bytes(4)
             + thumbnail)
    path = tmp_path / f"a{suffix}"
    Image.fromarray(np.full((40, 60, 3), 90, np.uint8)).save(path, exif=b"Exif\0\0" + block, lossless=True)
    assert thumbnail in path.read_bytes()
    assert [tiff.page_count(io.BytesIO(each)) for each in (block, without_thumbnail(block))] == [2, 1]
    plate = read_plate(path)
    written = tmp_path / f"clean{suffix}"
    write_plate(written, plate, plate.codes // 2)
    assert thumbnail not in written.read_bytes() and read_exif(written) == (6, 0.75)
    np.testing.assert_allclose(read_plate(written).codes, plate.codes // 2, atol=2)


def test_damaged_thumbnails_change_nothing() -> None:
    block = exif_segment("II", 6, 27)[10:]
    assert without_thumbnail(block) == block and without_thumbnail(b"") == b"" and without_thumbnail(b"II*") == b"II*"
    far = block[:34] + (9999).to_bytes(4, "little") + block[38:]
    assert without_thumbnail(far) == block
    for cut in range(len(far)):
        without_thumbnail(far[:cut])


@pytest.mark.parametrize("endian", ["little", "big"])
def test_the_orientation_of_a_big_tiff(endian: str, tmp_path: Path) -> None:
    """The orientation of a BigTIFF is read in both byte orders; a cut-off file counts as upright."""
    sign: Any = endian
    raw = (b"II+\0" if endian == "little" else b"MM\0+") + (8).to_bytes(2, sign) + bytes(2) + (16).to_bytes(8, sign)
    raw += (1).to_bytes(8, sign) + (274).to_bytes(2, sign) + (3).to_bytes(2, sign) + (1).to_bytes(8, sign)
    raw += (8).to_bytes(2, sign) + bytes(6) + bytes(8)
    (tmp_path / "a.tif").write_bytes(raw)
    assert read_exif(tmp_path / "a.tif") == (8, None)
    for cut in range(len(raw) - 8):
        (tmp_path / "a.tif").write_bytes(raw[:cut])
        assert read_exif(tmp_path / "a.tif") == (1, None)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_frame_is_turned_where_it_has_side_data_that_pyav_does_not_know(orientation: int, tmp_path: Path) -> None:
    """An AVIF with an Exif block. Without the list of side data its rotation is known, and no mirroring."""
    if not features.check("avif"):
        pytest.skip("Pillow is built without AVIF")
    exif, found = Image.Exif(), []
    for artist in ("", "Ada"):
        exif[tiff.ORIENTATION] = orientation
        if artist:
            exif[0x13B] = artist
        Image.fromarray(np.full((40, 60, 3), 90, np.uint8)).save(tmp_path / "a.avif", exif=exif)
        with Video(tmp_path / "a.avif") as video:
            found.append(video.orientation)
    assert found[0] == found[1] or orientation in (2, 4, 5, 7)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_an_orientation_is_applied_and_undone(orientation: int) -> None:
    """As OpenCV turns a JPEG of that orientation."""
    picture = np.zeros((16, 24, 3), np.uint8)
    picture[:8, :8], picture[8:, 16:] = (255, 0, 0), (0, 255, 0)
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 100])
    raw = data.tobytes()
    tagged = raw[:2] + exif_segment("MM", orientation, 27) + raw[2:]
    turned = cv2.imdecode(np.frombuffer(tagged, np.uint8), cv2.IMREAD_COLOR)
    plain = cv2.imdecode(data, cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(apply_orientation(plain, orientation), turned)
    np.testing.assert_array_equal(undo_orientation(turned, orientation), plain)
