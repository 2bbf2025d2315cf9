# SPDX-License-Identifier: GPL-3.0-or-later
"""Small valid pictures and videos of formats that `tests/core/picture_files.py` does not write, for `fuzz.py`."""
from __future__ import annotations

import importlib
import importlib.util
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.images.read import read_picture
from core.images.video import Video
from tests.core.picture_files import scene
from tests.core.videos import stripes, write_video

WIDTH, HEIGHT = 48, 32


class Medium(NamedTuple):
    """A format. file: its name. write: writes a valid file to a path. read: reads a path."""

    name: str
    file: str
    write: Callable[[Path], Any]
    read: Callable[[Path], Any]


def media() -> Iterator[Medium]:
    """Yield the formats for which no library here writes files, and videos of further codecs."""
    for file, write, library in (("a.psd", _write_psd, "OpenImageIO"), ("a.cin", _write_cineon, "OpenImageIO"),
                                 ("a.dng", _write_dng, "rawpy"), ("a.jxl", _write_jxl, "pillow_jxl")):
        if importlib.util.find_spec(library):  # the last two are optional
            yield Medium(f"picture {Path(file).suffix}", file, write, read_picture)
    frames = [stripes(32, 96) * gain for gain in (1.0, 0.8, 0.6)]
    for file, codec, pixels in (("a.avi", "mjpeg", "yuvj420p"), ("a.mov", "v210", "yuv422p10le")):
        def write_clip(path: Path, codec: str = codec, pixels: str = pixels) -> None:
            write_video(path, codec, pixels, frames)

        yield Medium(f"video {codec} {Path(file).suffix}", file, write_clip, _read_video)


def _read_video(path: Path) -> None:
    """Decode a video as `remove` and `solve` do."""
    with Video(path) as video:
        for frame in video:
            frame.pixels()


def _codes() -> NDArray[np.uint8]:
    return np.round(np.clip(scene(WIDTH, HEIGHT), 0, 1) * 255).astype(np.uint8)


def _write_jxl(path: Path) -> None:
    from PIL import Image

    importlib.import_module("pillow_jxl")  # adds the format
    Image.fromarray(_codes()).save(path)


def _write_psd(path: Path) -> None:
    """Write a flat Photoshop file of 8 bits without compression."""
    head = struct.pack(">4sH6xHIIHH", b"8BPS", 1, 3, HEIGHT, WIDTH, 8, 3)
    path.write_bytes(head + bytes(12) + struct.pack(">H", 0) + np.moveaxis(_codes(), 2, 0).tobytes())


def _write_cineon(path: Path) -> None:
    """Write a Cineon file of 10 bits, SMPTE-like layout of Kodak's version 4.5."""
    words = (_codes().astype(np.uint32) << 2).reshape(-1, 3)
    pixels = (words[:, 0] << 22 | words[:, 1] << 12 | words[:, 2] << 2).astype(">u4").tobytes()
    head = struct.pack(">IIIIII8s", 0x802A5FD7, 1024, 1024, 0, 0, 1024 + len(pixels), b"V4.5").ljust(192, b"\0")
    channels = b"".join(struct.pack(">BBBxIIffff", 0, code, 10, WIDTH, HEIGHT, 0, 0, 1023, 2.046) for code in (1, 2, 3))
    head += struct.pack(">BB2x", 0, 3) + channels.ljust(8 * 28, b"\0")
    head = head.ljust(680, b"\0") + struct.pack(">BBBBII", 0, 5, 0, 0, 0, 0)
    path.write_bytes(head.ljust(1024, b"\0") + pixels)


def _write_dng(path: Path) -> None:
    """Write a raw file of a Bayer sensor: a TIFF with the tags of DNG."""
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
