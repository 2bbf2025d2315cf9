# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures of every format are read as the light that they declare, and clean plates keep what describes them."""
from __future__ import annotations

import importlib.util
import io
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813 - as its own documents do
import pytest
from PIL import Image, TiffImagePlugin, features

from core.capture.plate_space import read_plate_space, record_plate_space
from core.colour import colour_space
from core.errors import FrameError, SettingsError
from core.images.exr import non_utf8_names, non_utf8_strings, read_exr_header
from core.images.formats import jpeg, png, tiff
from core.images.plates import Plate, clean_name, read_plate, write_plate
from core.images.read import has_float_pixels, read_picture
from core.images.size import picture_size
from core.images.write import write_exr
from core.removal.inference.plate_light import to_network_plate
from tests.core.picture_files import WRITERS, by_oiio, png_16, scene, tiff_16

MISSING = {name for name, package in (("HEIC", "pillow_heif"),) if importlib.util.find_spec(package) is None}
MISSING |= set() if features.check("avif") else {"PQ AVIF"}
TOLERANCE = {"Y/RY/BY EXR": 0.01, "P3 JPEG": 0.006, "HEIC": 0.01, "PQ AVIF": 0.02, "Radiance HDR": 0.008}


def write(name: str, folder: Path, light: Any) -> tuple[Path, Any]:
    if name in MISSING:
        pytest.skip(f"no encoder of {name} is installed")
    file, space, writer = WRITERS[name]
    writer(folder / file, light)
    return folder / file, colour_space(space) if space else None


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_shows_the_same_light(name: str, tmp_path: Path) -> None:
    light = scene()
    path, space = write(name, tmp_path, light)
    picture = read_picture(path, space=space)
    means = picture.linear().reshape(-1, 3).mean(0) / light.reshape(-1, 3).mean(0)
    np.testing.assert_allclose(means, 1, atol=TOLERANCE.get(name, 0.004))
    assert (picture.encoding == "linear") == has_float_pixels(path, space)


@pytest.mark.parametrize("name", WRITERS)
def test_a_clean_plate_stays_in_the_space_of_its_file(name: str, tmp_path: Path) -> None:
    """Less light in a corner: the rest keeps its codes, and the corner is that much darker when it is read again."""
    light = scene()
    path, space = write(name, tmp_path, light)
    plate = read_plate(path, space)
    taken = np.zeros_like(light)
    taken[8:24, 10:40] = 0.1
    target = clean_name(tmp_path / f"clean{path.suffix}")
    write_plate(target, plate, plate.without_light(taken))
    again = read_plate(target, space if target.suffix == path.suffix else None)
    if target.suffix == path.suffix and path.suffix != ".jpg":
        same = (taken == 0).all(-1)
        np.testing.assert_array_equal(again.codes[same], plate.codes[same])
    before, after = (read_picture(file, space=space if file.suffix == path.suffix else None).linear()
                     for file in (path, target))
    np.testing.assert_allclose((before - after)[10:22, 12:38].mean(), 0.1, atol=0.004)
    np.testing.assert_allclose((before - after)[30:].mean(), 0, atol=0.002)


def test_light_above_white_survives_in_pq(tmp_path: Path) -> None:
    light = scene(level=8.0)
    path, _ = write("PQ PNG", tmp_path, light)
    picture = read_picture(path)
    assert picture.encoding == "linear"
    np.testing.assert_allclose(picture.pixels.reshape(-1, 3).mean(0), light.reshape(-1, 3).mean(0), rtol=0.005)


def test_a_file_is_read_as_what_it_is_not_as_it_is_named(tmp_path: Path) -> None:
    path, _ = write("WebP", tmp_path, scene())
    named = path.rename(tmp_path / "a.jpg")
    np.testing.assert_allclose(read_picture(named).linear().mean(), scene().mean(), rtol=0.01)


def test_a_jpeg_of_a_browser_is_a_jpeg(tmp_path: Path) -> None:
    """Windows names them .jfif."""
    path, _ = write("P3 JPEG", tmp_path, scene())
    named = path.rename(tmp_path / "a.jfif")
    plate = read_plate(named)
    write_plate(tmp_path / "b.jfif", plate, plate.codes // 2)
    np.testing.assert_allclose(read_plate(tmp_path / "b.jfif").codes.mean(), plate.codes.mean() / 2, rtol=0.01)


def test_a_jpeg_whose_data_end_early_or_are_corrupt_is_refused(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (96, 128, 3)).astype(np.uint8)
    data = cv2.imencode(".jpg", noise)[1].tobytes()
    whole, half = tmp_path / "whole.jpg", len(data) // 2
    whole.write_bytes(data)
    assert read_picture(whole).size == (128, 96)
    for name, damaged in (("cut.jpg", data[:half]), ("ended.jpg", data[:half] + b"\xff\xd9"),
                          ("zeros.jpg", data[:half] + bytes(len(data) - half - 2) + b"\xff\xd9")):
        (tmp_path / name).write_bytes(damaged)
        for read in (read_picture, read_plate):
            with pytest.raises(FrameError, match=rf"{name} is damaged or truncated"):
                read(tmp_path / name)


def test_a_png_keeps_its_high_dynamic_range_chunks(tmp_path: Path) -> None:
    chunks = {b"cICP": bytes((9, 16, 0, 1)), b"mDCV": bytes(range(24)), b"cLLI": bytes(8), b"tEXt": b"Author\0Ada"}
    png_16(tmp_path / "a.png", colour_space("pq").from_linear(scene()), *chunks.items())
    plate = read_plate(tmp_path / "a.png")
    write_plate(tmp_path / "b.png", plate, plate.codes // 2)
    with open(tmp_path / "b.png", "rb") as stream:
        assert dict(png.chunks(stream, chunks)) == chunks


def test_a_jpeg_keeps_comment_density_and_iptc_but_no_gain_map_nor_its_claim(tmp_path: Path) -> None:
    data = cv2.imencode(".jpg", np.full((32, 32, 3), 128, np.uint8))[1].tobytes()
    xmp = (b'http://ns.adobe.com/xap/1.0/\0<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
           b'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
           b'xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/" xmlns:dc="http://purl.org/dc/elements/1.1/" '
           b'hdrgm:Version="1.0" dc:format="image/jpeg"/></rdf:RDF></x:xmpmeta>')
    segments = [(0xED, b"Photoshop 3.0\x008BIM\x04\x04"), (0xFE, b"stage 4"), (jpeg.APP1, xmp),
                (jpeg.APP2, b"MPF\0MM\0*\0\0\0\x08")]
    density = jpeg.make_segment(0xE0, b"JFIF\0\1\1\1\1,\1,\0\0")
    start = data.index(b"\xff\xdb")
    (tmp_path / "a.jpg").write_bytes(data[:2] + density + b"".join(jpeg.make_segment(*part) for part in segments)
                                     + data[start:] + data)
    plate = read_plate(tmp_path / "a.jpg")
    assert "gain map" in plate.warning
    write_plate(tmp_path / "b.jpg", plate, plate.codes // 2)
    written = (tmp_path / "b.jpg").read_bytes()
    for part in (density, jpeg.make_segment(*segments[0]), jpeg.make_segment(*segments[1]), b"image/jpeg"):
        assert part in written
    assert b"hdrgm" not in written and b"hdr-gain-map" not in written and b"MPF\0" not in written
    assert not read_plate(tmp_path / "b.jpg").warning


def test_a_clip_behind_a_jpeg_is_named(tmp_path: Path) -> None:
    data = cv2.imencode(".jpg", np.full((32, 32, 3), 128, np.uint8))[1].tobytes()
    for name, tail, is_named in (("a.jpg", b"", False), ("b.jpg", bytes(300), False),
                                 ("c.jpg", b"MotionPhoto_Data\0\0\0\x18ftypmp42" + bytes(9000) + b"SEFT", True)):
        (tmp_path / name).write_bytes(data + tail)
        plate = read_plate(tmp_path / name)
        assert ("data after its picture" in plate.warning) == is_named
        write_plate(tmp_path / "clean.jpg", plate, plate.codes // 2)
        assert b"ftypmp42" not in (tmp_path / "clean.jpg").read_bytes()


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rawpy", None)
    (tmp_path / "a.dng").write_bytes(b"II*\0" + bytes(60))
    with pytest.raises(FrameError, match=r"a\.dng needs the Python package rawpy.*--group raw"):
        read_picture(tmp_path / "a.dng")


def test_text_of_an_exr_that_is_not_utf8_stays_byte_for_byte(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", np.full((8, 8), 0.5, np.float32)),
              header={"owner": "Studio Brosse", "comments": "plain", "tags": ["one", "Nacht Stra?e"]})
    data = (tmp_path / "a.exr").read_bytes()
    data = data.replace(b"Studio Brosse", b"Studio Bross\xe9").replace(b"Stra?e", b"Stra\xdfe")
    (tmp_path / "a.exr").write_bytes(data)
    plate = read_plate(tmp_path / "a.exr")
    write_plate(tmp_path / "b.exr", plate, plate.codes / np.float16(2))
    assert non_utf8_strings(tmp_path / "b.exr") == {"owner": b"Studio Bross\xe9", "tags[1]": b"Nacht Stra\xdfe"}
    assert read_exr_header(tmp_path / "b.exr")["comments"] == "plain"
    np.testing.assert_array_equal(read_plate(tmp_path / "b.exr").codes, 0.25)


def test_names_in_an_exr_that_are_not_utf8_stay_byte_for_byte(tmp_path: Path) -> None:
    """Names of a channel and of an attribute survive cleaning, and other channels keep their places."""
    depth = np.arange(64, dtype=np.float32).reshape(8, 8)
    write_exr(tmp_path / "a.exr", {**dict.fromkeys("RGB", np.full((8, 8), 0.5)), "H\x7fhe": depth,
                                   "Hzzz": depth + 1, "H\x7fhf": depth + 2}, header={"gr?sse": "x"})
    data = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(data.replace(b"H\x7fh", b"H\xf6h").replace(b"gr?sse", b"gr\xf6sse"))
    plate = read_plate(tmp_path / "a.exr")
    np.testing.assert_array_equal(read_picture(tmp_path / "a.exr").pixels, 0.5)
    write_plate(tmp_path / "b.exr", plate, plate.codes / np.float16(2))
    assert non_utf8_names(tmp_path / "b.exr") == {b"H\x7fhe": b"H\xf6he", b"H\x7fhf": b"H\xf6hf",
                                                b"gr\x7fsse": b"gr\xf6sse"}
    again = read_plate(tmp_path / "b.exr")
    np.testing.assert_array_equal(again.codes, 0.25)
    for name, added in (("H\x7fhe", 0), ("Hzzz", 1), ("H\x7fhf", 2)):
        np.testing.assert_array_equal(again.extras["channels"][name], depth + added)
    (tmp_path / "c.exr").write_bytes((tmp_path / "a.exr").read_bytes().replace(b"H\xf6hf", b"H\xe4he"))
    with pytest.raises(FrameError, match="whose names are not UTF-8 and differ in nothing else; rename them"):
        read_plate(tmp_path / "c.exr")


def test_a_tiff_keeps_text_place_and_exif(tmp_path: Path) -> None:
    text = {315: b"Ada\0", 33432: b"Studio\0", 306: b"2026:01:02 03:04:05\0"}
    tags = {number: tiff.Tag(2, np.frombuffer(value, np.uint8)) for number, value in text.items()}
    tags[33550] = tiff.Tag(12, np.array([0.5, 0.5, 0.0]))
    tags[33723] = tiff.Tag(7, np.arange(12, dtype=np.uint8))
    tiff_16(tmp_path / "a.tif", scene(), tags)
    whole = tiff.with_directory((tmp_path / "a.tif").read_bytes(), 34665, {
        0x829A: tiff.Tag(5, np.array([1, 50], np.uint32)), 0x9003: tiff.Tag(2, np.frombuffer(text[306], np.uint8))})
    (tmp_path / "a.tif").write_bytes(whole)
    plate = read_plate(tmp_path / "a.tif")
    write_plate(tmp_path / "b.tif", plate, plate.codes // 2)
    data = io.BytesIO((tmp_path / "b.tif").read_bytes())
    kept = tiff.read_tags(data, [*tags, 34665])
    for number, tag in tags.items():
        np.testing.assert_array_equal(kept[number].values, tag.values)
    exif = tiff.read_tags(data, range(1 << 16), int(kept[34665].values[0]))
    assert exif[0x829A].values.tolist() == [1, 50] and exif[0x9003].values.tobytes() == text[306]
    np.testing.assert_array_equal(read_plate(tmp_path / "b.tif").codes, plate.codes // 2)


@pytest.mark.parametrize("kind", ["BigTIFF", "half", "planes"])
def test_a_tiff_that_opencv_does_not_write_keeps_its_tags(kind: str, tmp_path: Path) -> None:
    tags = {33550: tiff.Tag(12, np.array([0.5, 0.5, 0.0])), 315: tiff.Tag(2, np.frombuffer(b"Ada\0", np.uint8)),
            34735: tiff.Tag(3, np.array([1, 1, 0, 1, 1024, 0, 1, 1], np.uint16)),
            700: tiff.Tag(1, np.frombuffer(b"<x:xmpmeta/>", np.uint8))}
    path = tmp_path / "a.tif"
    if kind == "BigTIFF":
        made = TiffImagePlugin.ImageFileDirectory_v2()
        for number, tag in tags.items():
            made.tagtype[number] = tag.kind
            made[number] = "Ada" if number == 315 else tag.values.tobytes() if number == 700 else tuple(tag.values)
        Image.fromarray(np.full((20, 30, 3), 90, np.uint8)).save(path, tiffinfo=made, big_tiff=True)
        assert path.read_bytes()[:4] in tiff.BIG_TIFF
    else:
        by_oiio(path, scene(), oiio.HALF if kind == "half" else oiio.UINT16,
                {} if kind == "half" else {"planarconfig": "separate"})
        path.write_bytes(tiff.with_tags(path.read_bytes(), tags))
    plate = read_plate(path)
    codes = plate.codes // 2 if plate.codes.dtype.kind == "u" else plate.codes / 2
    write_plate(tmp_path / "b.tif", plate, codes)
    kept = tiff.read_tags(io.BytesIO((tmp_path / "b.tif").read_bytes()), tags)
    for number, tag in tags.items():
        np.testing.assert_array_equal(kept[number].values, tag.values)
    np.testing.assert_array_equal(read_plate(tmp_path / "b.tif").codes, codes)


@pytest.mark.parametrize("mode", ["P", "L"])
def test_a_gif_keeps_its_transparency(mode: str, tmp_path: Path) -> None:
    codes = np.full((20, 30, 3), 60, np.uint8)
    codes[:6, 20:] = 250
    picture = Image.fromarray(codes).quantize(4) if mode == "P" else Image.fromarray(codes[..., 0])
    picture.save(tmp_path / "a.gif", transparency=int(np.asarray(picture)[0, 0]))
    plate = read_plate(tmp_path / "a.gif")
    alpha = np.where(codes[..., 0] == 60, 0, 255)
    np.testing.assert_array_equal(plate.alpha, alpha)
    write_plate(tmp_path / "b.png", plate, plate.codes // 2)
    np.testing.assert_array_equal(read_plate(tmp_path / "b.png").alpha, alpha)
    picture.save(tmp_path / "a.gif")
    assert read_plate(tmp_path / "a.gif").alpha is None


def xmp_segment(attributes: str, inner: str = "") -> tuple[int, bytes]:
    return jpeg.APP1, (f'http://ns.adobe.com/xap/1.0/\0<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf='
                       f'"http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description xmlns:dc='
                       f'"http://purl.org/dc/elements/1.1/" dc:format="f" {attributes}>{inner}</rdf:Description>'
                       "</rdf:RDF></x:xmpmeta>").encode()


def cleaned_jpeg(folder: Path, *segments: tuple[int, bytes]) -> tuple[str, bytes]:
    """Return the warning for a JPEG with these segments, and the bytes of its clean plate."""
    raw = cv2.imencode(".jpg", np.full((24, 32, 3), 90, np.uint8))[1].tobytes()
    (folder / "a.jpg").write_bytes(raw[:2] + b"".join(jpeg.make_segment(*part) for part in segments) + raw[2:])
    plate = read_plate(folder / "a.jpg")
    write_plate(folder / "b.jpg", plate, plate.codes // 2)
    return plate.warning, (folder / "b.jpg").read_bytes()


CAMERA = 'xmlns:GCamera="http://ns.google.com/photos/1.0/camera/"'


@pytest.mark.parametrize("claim", ['GCamera:MotionPhoto="1"', 'GCamera:MicroVideoOffset="4000"'])
def test_names_of_googles_camera_claim_a_clip_only_where_there_is_one(claim: str, tmp_path: Path) -> None:
    notes = 'GCamera:hdrp_makernote="SERSUA" GCamera:PortraitVersion="1"'
    warning, written = cleaned_jpeg(tmp_path, xmp_segment(f"{CAMERA} {notes}"))
    assert not warning and b"hdrp_makernote" in written and b"PortraitVersion" in written
    warning, written = cleaned_jpeg(tmp_path, xmp_segment(f"{CAMERA} {notes} {claim}"))
    assert "more than one picture" in warning
    assert b"hdrp_makernote" in written and claim.partition("=")[0].encode() not in written


def image_resource(number: int, content: bytes, name: bytes = b"") -> bytes:
    label = bytes([len(name)]) + name
    return (b"8BIM" + number.to_bytes(2, "big") + label.ljust(len(label) + len(label) % 2, b"\0")
            + len(content).to_bytes(4, "big") + content.ljust(len(content) + len(content) % 2, b"\0"))


@pytest.mark.parametrize("number", [1033, 1036])
def test_thumbnails_that_show_the_flare_go(number: int, tmp_path: Path) -> None:
    thumbnail = image_resource(number, b"THUMB" * 20_001, b"odd")
    iptc, resolution = image_resource(1028, b"\x1c\2\x78\0\7Caption"), image_resource(1005, bytes(16))
    resources = iptc + thumbnail + resolution
    parts = [(jpeg.APP13, jpeg.PHOTOSHOP + resources[at:at + 60_000]) for at in range(0, len(resources), 60_000)]
    _, written = cleaned_jpeg(tmp_path, *parts)
    assert b"THUMB" not in written and jpeg.PHOTOSHOP + iptc + resolution in written
    thumbnails = '<xmp:Thumbnails xmlns:xmp="http://ns.adobe.com/xap/1.0/"><rdf:Alt><rdf:li xmlns:xmpGImg="http://ns.' \
                 'adobe.com/xap/1.0/g/img/" rdf:parseType="Resource"><xmpGImg:image>QUJD</xmpGImg:image></rdf:li>' \
                 "</rdf:Alt></xmp:Thumbnails>"
    warning, written = cleaned_jpeg(tmp_path, xmp_segment("", thumbnails))
    assert not warning and b"dc:format" in written and b"QUJD" not in written
    tiff_16(tmp_path / "a.tif", scene(32, 24), {34377: tiff.Tag(1, np.frombuffer(resources, np.uint8))})
    plate = read_plate(tmp_path / "a.tif")
    write_plate(tmp_path / "b.tif", plate, plate.codes // 2)
    written = (tmp_path / "b.tif").read_bytes()
    assert b"THUMB" not in written and iptc + resolution in written


@pytest.mark.parametrize("compression", ["tiff_adobe_deflate", "tiff_deflate"])
def test_a_tiff_whose_zip_data_are_corrupt_is_refused(compression: str, tmp_path: Path) -> None:
    """The TIFF library does not compare the checksum, and OpenCV shows what comes out."""
    noise = np.random.default_rng(0).integers(0, 255, (96, 128, 3)).astype(np.uint8)
    Image.fromarray(noise).save(tmp_path / "a.tif", compression=compression)
    np.testing.assert_array_equal(read_plate(tmp_path / "a.tif").codes, noise)
    data = bytearray((tmp_path / "a.tif").read_bytes())
    data[len(data) // 2:len(data) // 2 + 9] = bytes(9)
    (tmp_path / "a.tif").write_bytes(data)
    for read in (read_picture, read_plate):
        with pytest.raises(FrameError, match=r"a\.tif is damaged or truncated"):
            read(tmp_path / "a.tif")


def test_a_jpeg_xl_that_cannot_be_read_is_refused_in_a_sentence(tmp_path: Path) -> None:
    pytest.importorskip("pillow_jxl")
    (tmp_path / "a.jxl").write_bytes(b"\xff\x0a" + bytes(99))
    with pytest.raises(FrameError, match=r"a\.jxl is damaged or truncated; export it again\.$"):
        read_picture(tmp_path / "a.jxl")


def test_a_photograph_of_200_megapixels_is_opened(tmp_path: Path) -> None:
    """Pillow refuses pictures above 179 megapixels unless its limit is raised."""
    Image.new("P", (8, 8)).save(tmp_path / "a.gif")
    data = bytearray((tmp_path / "a.gif").read_bytes())
    data[6:10] = (16320).to_bytes(2, "little") + (12240).to_bytes(2, "little")
    (tmp_path / "a.gif").write_bytes(data)
    assert picture_size(tmp_path / "a.gif") == (16320, 12240)


def test_the_picture_before_refocusing_goes_with_its_claim(tmp_path: Path) -> None:
    """Google's camera stores it in the extended XMP, with the depth of the picture."""
    spaces = " ".join(f'xmlns:{name}="http://ns.google.com/photos/1.0/{place}/"'
                      for name, place in (("GDepth", "depthmap"), ("GImage", "image")))
    xmp = (f'http://ns.adobe.com/xap/1.0/\0<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
           f'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description {spaces} '
           'xmlns:xmpNote="http://ns.adobe.com/xmp/note/" xmlns:dc="http://purl.org/dc/elements/1.1/" dc:format="f" '
           'xmpNote:HasExtendedXMP="0123" GDepth:Format="RangeInverse" GImage:Mime="image/jpeg"/></rdf:RDF>'
           "</x:xmpmeta>").encode()
    segments = [(jpeg.APP1, xmp), (jpeg.APP1, b"http://ns.adobe.com/xmp/extension/\0" + b"0" * 40 + b"<x:xmpmeta/>")]
    raw = cv2.imencode(".jpg", np.full((24, 32, 3), 90, np.uint8))[1].tobytes()
    whole = raw[:2] + b"".join(jpeg.make_segment(*segment) for segment in segments) + raw[2:]
    (tmp_path / "a.jpg").write_bytes(whole)
    plate = read_plate(tmp_path / "a.jpg")
    assert "more than one picture" in plate.warning
    write_plate(tmp_path / "b.jpg", plate, plate.codes // 2)
    written = (tmp_path / "b.jpg").read_bytes()
    assert b"dc:format" in written
    assert not any(word in written for word in (b"extension", b"HasExtendedXMP", b"GImage", b"GDepth"))


@pytest.mark.parametrize(("name", "width", "height"), [
    ("log DPX", (772, 4, "big"), (776, 4, "big")), ("Targa", (12, 2, "little"), (14, 2, "little")),
    ("BMP", (18, 4, "little"), (22, 4, "little"))])
def test_a_header_that_claims_more_than_the_file_can_hold_costs_no_memory(
        name: str, width: tuple[int, int, Any], height: tuple[int, int, Any], tmp_path: Path) -> None:
    path, _ = write(name, tmp_path, scene())
    data = bytearray(path.read_bytes())
    for (at, length, order), value in ((width, 20_000), (height, 16_000)):
        data[at:at + length] = value.to_bytes(length, order)
    path.write_bytes(data)
    for read in (read_picture, read_plate):
        with pytest.raises(FrameError, match=rf"{path.name} is damaged or truncated"):
            read(path)


@pytest.mark.parametrize("factor", [0.5, 3.0, 8.0])
def test_the_network_input_is_invariant_to_exposure(factor: float) -> None:
    light = scene()
    plates = [to_network_plate(Plate(Path("a.exr"), (light * gain).astype(np.float32), "linear"))[0]
              for gain in (1.0, factor)]
    np.testing.assert_allclose(plates[1].codes, plates[0].codes, rtol=1e-5)
    assert 0.3 < np.percentile(plates[0].codes, 95) < 1


def test_a_capture_keeps_the_space_that_a_command_names(tmp_path: Path) -> None:
    assert read_plate_space(tmp_path) is None
    record_plate_space(tmp_path, "LogC4", None)
    space = read_plate_space(tmp_path)
    assert space is not None and space.has_headroom
    with pytest.raises(SettingsError, match="is not one of"):
        record_plate_space(tmp_path, "no such space", None)
    record_plate_space(tmp_path, "auto", None)
    assert read_plate_space(tmp_path) is None


@pytest.mark.parametrize("name", ["log DPX", "WebP", "BMP", "HEIC", "JPEG 2000", "half TIFF", "Radiance HDR"])
def test_a_file_that_is_cut_off_is_refused_by_name(name: str, tmp_path: Path) -> None:
    path, _ = write(name, tmp_path, scene())
    data = path.read_bytes()
    for share in (0.02, 0.5, 0.9):
        path.write_bytes(data[:int(share * len(data))])
        with pytest.raises(FrameError, match=re.escape(str(path))):
            read_plate(path)
