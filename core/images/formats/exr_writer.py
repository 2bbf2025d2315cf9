# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes scanline EXRs with numpy and zlib alone, since Blender's own Python has no library that writes them.

The layout is that of "OpenEXR File Layout" (Academy Software Foundation). `core.images.write` calls this where OpenEXR
is missing.
"""
from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .exr_header import MAGIC

_LINES = 16
"""Scan lines of a chunk with ZIP compression."""
_ZIP = 3
"""Number of the ZIP compression."""
_LONG_NAMES = 0x400
"""Flag of the version for names above 31 bytes."""
_LEVEL = 4
"""Effort of zlib, as OpenEXR's."""
_PIXEL_TYPES = {"float16": 1, "float32": 2}


def write_scanlines(path: Path | str, channels: Mapping[str, NDArray[Any]], header: Mapping[str, Any]) -> None:
    """Write one part of float16 and float32 channels (height, width), ZIP compressed.

    header: texts, numbers (as 32 bit floats), "chromaticities" (eight numbers), and the windows "dataWindow" and
    "displayWindow" as ((left, top), (right, bottom)), by default the extent of the pixels. Raises TypeError for other
    values.
    """
    names = sorted(channels, key=str.encode)
    pixels = [np.ascontiguousarray(channels[name]) for name in names]
    height, width = pixels[0].shape
    window = ((0, 0), (width - 1, height - 1))
    attributes = {"dataWindow": window, "displayWindow": window, "pixelAspectRatio": 1.0, **header}
    head = _encode_header(names, pixels, attributes)
    count = -(-height // _LINES)
    with open(path, "wb") as stream:
        stream.write(head)
        table, offsets = stream.tell(), []
        stream.write(b"\0" * 8 * count)
        top = int(attributes["dataWindow"][0][1])
        for start, data in _encode_chunks(pixels, height):
            offsets.append(stream.tell())
            stream.write(struct.pack("<ii", top + start, len(data)) + data)
        stream.seek(table)
        stream.write(struct.pack(f"<{count}Q", *offsets))


def _encode_header(names: list[str], pixels: list[NDArray[Any]], attributes: Mapping[str, Any]) -> bytes:
    """Return magic number, version and attributes. names, pixels: names and pixels (height, width) of the channels, in
    the file's order. attributes: the `header` of `write_scanlines`, with both windows. Raises TypeError for a value of
    another type."""
    # Of each channel: name, type, whether it is perceptually linear, and sampling of columns and lines.
    channel_list = b"".join(name.encode() + b"\0" + struct.pack("<iB3xii", _PIXEL_TYPES[channel.dtype.name], 0, 1, 1)
                            for name, channel in zip(names, pixels, strict=True)) + b"\0"
    flags = _LONG_NAMES if max(len(name.encode()) for name in (*names, *attributes)) > 31 else 0
    parts = [MAGIC, struct.pack("<i", 2 | flags),  # version 2 of the format
             _encode_attribute("channels", "chlist", channel_list),
             _encode_attribute("compression", "compression", bytes([_ZIP])),
             _encode_attribute("lineOrder", "lineOrder", b"\0"),
             _encode_attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
             _encode_attribute("screenWindowWidth", "float", struct.pack("<f", 1))]
    for name, value in attributes.items():
        if name.endswith("Window"):
            (left, top), (right, bottom) = value
            corners = struct.pack("<4i", int(left), int(top), int(right), int(bottom))
            parts.append(_encode_attribute(name, "box2i", corners))
        elif name == "chromaticities":
            coordinates = struct.pack("<8f", *(float(coordinate) for coordinate in value))
            parts.append(_encode_attribute(name, name, coordinates))
        elif isinstance(value, str):
            parts.append(_encode_attribute(name, "string", value.encode()))
        elif isinstance(value, int | float):
            parts.append(_encode_attribute(name, "float", struct.pack("<f", value)))
        else:
            raise TypeError(f"the attribute {name} cannot be written")
    return b"".join(parts) + b"\0"


def _encode_attribute(name: str, kind: str, value: bytes) -> bytes:
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value


def _encode_chunks(pixels: list[NDArray[Any]], height: int) -> Iterator[tuple[int, bytes]]:
    """Yield the first line and the stored bytes of each chunk; uncompressed where ZIP does not make it smaller."""
    for start in range(0, height, _LINES):
        lines = range(start, min(start + _LINES, height))
        raw = b"".join(channel[line].tobytes() for line in lines for channel in pixels)
        packed = _compress(raw)
        yield start, packed if len(packed) < len(raw) else raw


def _compress(raw: bytes) -> bytes:
    """Compress as OpenEXR's ZIP: bytes of even places before those of odd ones, then differences plus 128, then zlib.
    """
    data = np.frombuffer(raw, np.uint8)
    sorted_bytes = np.concatenate([data[::2], data[1::2]])
    differences = sorted_bytes.copy()
    differences[1:] = sorted_bytes[1:] - sorted_bytes[:-1] + np.uint8(128)
    return zlib.compress(differences.tobytes(), _LEVEL)
