# SPDX-License-Identifier: GPL-3.0-or-later
"""Small valid pictures and videos of formats that `tests/core/picture_files.py` does not write, for `fuzz.py`."""
from __future__ import annotations

import importlib
import importlib.util
import io
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin, TiffImagePlugin

from core.colour.spaces import P3_D65
from core.images.formats import jpeg
from core.images.plates import read_plate
from core.images.read import read_picture
from core.images.video import Video
from core.images.views import split_views, write_view_results
from core.images.write import write_exr
from tests.core.picture_files import profile, scene
from tests.core.videos import stripes, write_video

WIDTH, HEIGHT = 48, 32


class Medium(NamedTuple):
    """A format. file: its name. write: writes a valid file to a path. read: reads a path."""

    name: str
    file: str
    write: Callable[[Path], Any]
    read: Callable[[Path], Any]


def media() -> Iterator[Medium]:
    """Yield pictures of formats that no library here writes, videos of further codecs, and plates to clean.

    The plates carry tags, parts or channels that writing their clean plates has to keep.
    """
    for file, write, library in (("a.psd", _write_psd, "OpenImageIO"), ("a.cin", _write_cineon, "OpenImageIO"),
                                 ("a.dng", _write_dng, "rawpy"), ("a.jxl", _write_jxl, "pillow_jxl")):
        if importlib.util.find_spec(library):  # the last two are optional
            yield Medium(f"picture {Path(file).suffix}", file, write, read_picture)
    frames = [stripes(32, 96) * gain for gain in (1.0, 0.8, 0.6)]
    for file, codec, pixels in (("a.avi", "mjpeg", "yuvj420p"), ("a.mov", "v210", "yuv422p10le")):
        def write_clip(path: Path, codec: str = codec, pixels: str = pixels) -> None:
            write_video(path, codec, pixels, frames)

        yield Medium(f"video {codec} {Path(file).suffix}", file, write_clip, _read_video)


    for file, name, write in (("a.jpg", "JPEG with tags", _write_tagged_jpeg),
                              ("a.tif", "TIFF with tags", _write_zip_tiff),
                              ("a.png", "PNG with tags", _write_tagged_png),
                              ("a.exr", "EXR of two eyes", _write_eyes),
                              ("b.exr", "EXR with names that are not UTF-8", _write_non_utf8_names)):
        yield Medium(f"clean plate of {name}", file, write, _clean_plate)


def _clean_plate(path: Path) -> None:
    """Write a clean plate, with all that it keeps, and what the user is told of it."""
    plate = read_plate(path)
    plate.warning  # noqa: B018 - parses the file
    changed = [view.codes // 2 if view.codes.dtype.kind == "u" else view.codes * view.codes.dtype.type(0.5)
               for _, view in split_views(plate)]
    write_view_results([path.with_name(f"clean{path.suffix}")], plate, [(codes, codes) for codes in changed])


def _write_tagged_jpeg(path: Path) -> None:
    """Write a JPEG with Exif data, an ICC profile, Photoshop resources and XMP that claims a gain map."""
    encoded = io.BytesIO()
    exif = Image.Exif()
    exif[0x112], exif[0x13b] = 6, "Ada"
    Image.fromarray(_codes()).save(encoded, "JPEG", exif=exif, icc_profile=profile(P3_D65), comment=b"stage 4")
    data = encoded.getvalue()
    resource = b"8BIM" + struct.pack(">HHI", 1036, 0, 30) + bytes(30)
    xmp = (b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
           b'<rdf:Description xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/" hdrgm:Version="1.0"/></rdf:RDF>'
           b"</x:xmpmeta>")
    path.write_bytes(data[:2] + jpeg.make_segment(jpeg.APP1, jpeg.XMP + xmp)
                     + jpeg.make_segment(jpeg.APP13, jpeg.PHOTOSHOP + resource + resource) + data[2:])


def _write_zip_tiff(path: Path) -> None:
    """Write a TIFF of ZIP compression with text, a profile and image resources."""
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[315], tags[34377] = "Ada", b"8BIM" + struct.pack(">HHI", 1036, 0, 30) + bytes(30)
    Image.fromarray(_codes()).save(path, compression="tiff_adobe_deflate", tiffinfo=tags, icc_profile=profile(P3_D65))


def _write_tagged_png(path: Path) -> None:
    exif, text = Image.Exif(), PngImagePlugin.PngInfo()
    exif[0x13b] = "Ada"
    text.add_itxt("XML:com.adobe.xmp", '<x:xmpmeta xmlns:x="adobe:ns:meta/"/>', zip=True)
    Image.fromarray(_codes()).save(path, exif=exif, pnginfo=text, icc_profile=profile(P3_D65), dpi=(72, 72))


def _write_eyes(path: Path) -> None:
    """Write an EXR of three parts: the left eye, the right eye, and depth."""
    import OpenEXR

    light = scene(WIDTH, HEIGHT).astype(np.float16)
    colours = {name: np.ascontiguousarray(light[..., k]) for k, name in enumerate("RGB")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    contents = (("rgba.left", "left", colours), ("rgba.right", "right", colours),
                ("depth", "left", {"Z": colours["R"]}))
    parts = [OpenEXR.Part({**header, "name": name, "view": view, "owner": "Ada"}, channels)
             for name, view, channels in contents]
    with OpenEXR.File(parts) as file:
        file.write(str(path))


def _write_non_utf8_names(path: Path) -> None:
    """Write an EXR with names and a text that are not UTF-8."""
    light = scene(WIDTH, HEIGHT)
    write_exr(path, {"H\x7fhe": light[..., 0], **{name: light[..., k] for k, name in enumerate("RGB")}},
              header={"gr\x7fsse": "x", "owner": "Bross?"})
    path.write_bytes(path.read_bytes().replace(b"\x7fhe", b"\xf6he").replace(b"\x7fsse", b"\xf6sse")
                     .replace(b"Bross?", b"Bross\xe9"))


def _read_video(path: Path) -> None:
    """Decode a video as `remove` and `solve` do."""
    with Video(path) as video:
        for frame in video:
            frame.pixels()


def _codes() -> NDArray[np.uint8]:
    return np.round(np.clip(scene(WIDTH, HEIGHT), 0, 1) * 255).astype(np.uint8)


def _write_jxl(path: Path) -> None:
    importlib.import_module("pillow_jxl")  # adds the format
    Image.fromarray(_codes()).save(path)


def _write_psd(path: Path) -> None:
    """Write a flat Photoshop file of 8 bits without compression."""
    head = struct.pack(">4sH6xHIIHH", b"8BPS", 1, 3, HEIGHT, WIDTH, 8, 3)
    path.write_bytes(head + bytes(12) + struct.pack(">H", 0) + np.moveaxis(_codes(), 2, 0).tobytes())


def _write_cineon(path: Path) -> None:
    """Write a Cineon file of 10 bits, version 4.5: file, picture and layout headers, then packed words."""
    words = (_codes().astype(np.uint32) << 2).reshape(-1, 3)
    pixels = (words[:, 0] << 22 | words[:, 1] << 12 | words[:, 2] << 2).astype(">u4").tobytes()
    head = struct.pack(">IIIIII8s", 0x802A5FD7, 1024, 1024, 0, 0, 1024 + len(pixels), b"V4.5").ljust(192, b"\0")
    channels = b"".join(struct.pack(">BBBxIIffff", 0, code, 10, WIDTH, HEIGHT, 0, 0, 1023, 2.046) for code in (1, 2, 3))
    head += struct.pack(">BB2x", 0, 3) + channels.ljust(8 * 28, b"\0")
    head = head.ljust(680, b"\0") + struct.pack(">BBBBII", 0, 5, 0, 0, 0, 0)
    path.write_bytes(head.ljust(1024, b"\0") + pixels)


def _write_dng(path: Path) -> None:
    """Write a DNG, the raw file of a Bayer sensor: a TIFF with DNG's tags."""
    mosaic = np.round(np.clip(scene(WIDTH * 2, HEIGHT * 2)[..., 1], 0, 1) * 60000).astype("<u2").tobytes()
    long, short, byte, text, signed, ratio = 4, 3, 1, 2, 10, 5
    matrix = [number for value in np.diag([10000, 10000, 10000]).ravel().tolist() for number in (value, 10000)]
    tags: list[tuple[int, int, int, bytes]] = []

    def add(tag: int, kind: int, values: list[int] | bytes) -> None:
        size = {long: "I", short: "H", byte: "B", signed: "i", ratio: "I"}.get(kind, "B")
        data = values if isinstance(values, bytes) else struct.pack(f"<{len(values)}{size}", *values)
        count = len(values) // (2 if kind in (signed, ratio) else 1)
        tags.append((tag, kind, count, data))

    for tag, kind, values in ((254, long, [0]), (256, long, [WIDTH * 2]), (257, long, [HEIGHT * 2]), (258, short, [16]),
                              (259, short, [1]), (262, short, [32803]), (271, text, b"Maker\0"),
                              (272, text, b"Camera\0"), (273, long, [0]), (277, short, [1]), (278, long, [HEIGHT * 2]),
                              (279, long, [len(mosaic)]), (284, short, [1]), (33421, short, [2, 2]),
                              (33422, byte, [0, 1, 1, 2]), (50706, byte, [1, 4, 0, 0]), (50708, text, b"Camera\0"),
                              (50717, long, [65535]), (50721, signed, matrix), (50728, ratio, [1, 1, 1, 1, 1, 1])):
        add(tag, kind, values)
    at = 8 + 2 + 12 * len(tags) + 4
    table, extra = b"", b""
    start = at + sum(len(data) + len(data) % 2 for *_, data in tags if len(data) > 4)
    for tag, kind, count, data in tags:
        value = struct.pack("<I", start) if tag == 273 else data.ljust(4, b"\0")
        if len(data) > 4:
            value = struct.pack("<I", at + len(extra))
            extra += data + bytes(len(data) % 2)
        table += struct.pack("<HHI", tag, kind, count) + value
    path.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + table + bytes(4) + extra + mosaic)
