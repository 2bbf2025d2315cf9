# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the headers of an EXR without a library: Blender's own Python has none that reads EXRs.

The layout is that of "OpenEXR File Layout" (Academy Software Foundation): after a magic number and a version, each
attribute is a name, a type, a length and that many bytes; an empty name ends the header.
"""
from __future__ import annotations

import os
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import numpy as np

MAGIC = b"\x76\x2f\x31\x01"
_LINES_PER_CHUNK = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256, 256, 32)
"""Lines of a chunk by the number of the compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB, two of
HTJ2K."""
_TILES, _DEEP, _PARTS = 0x200, 0x800, 0x1000
"""Flags of the version."""
_MAX_ATTRIBUTE_BYTES = 1 << 20
"""Largest attribute that is read: some ten thousand channels, where hostile files claim gigabytes."""


def windows(stream: BinaryIO) -> dict[str, tuple[int, int]]:
    """Return (width, height) of the "dataWindow" (stored pixels) and the "displayWindow" (the frame), where present."""
    return {name: (x1 - x0 + 1, y1 - y0 + 1) for name, (x0, y0, x1, y1) in window_corners(stream).items()}


def window_corners(stream: BinaryIO) -> dict[str, tuple[int, int, int, int]]:
    """Return (left, top, right, bottom), the last two inclusive, of the "dataWindow" and "displayWindow" that exist."""
    attributes = _read_attributes(stream, {b"dataWindow": b"box2i", b"displayWindow": b"box2i"})
    return {name.decode(): tuple(np.frombuffer(value, "<i4").tolist()) for name, value in attributes.items()
            if len(value) == 16}


HALF = 1
"""Pixel type of a channel: 16 bit floats."""


def channel_kinds(stream: BinaryIO) -> dict[str, int]:
    """Return the pixel type of each channel, such as "flare_sun.R", in the file's order; empty for a damaged header."""
    value = _read_attributes(stream, {b"channels": b"chlist"}).get(b"channels", b"")
    kinds, offset = {}, 0
    while (end := value.find(b"\0", offset)) > offset:
        kinds[value[offset:end].decode(errors="replace")] = int.from_bytes(value[end + 1:end + 5], "little")
        offset = end + 17  # past the zero, the kind, whether it is linear, and the sampling
    return kinds if value[offset:] == b"\0" else {}


def chromaticities(stream: BinaryIO) -> tuple[float, ...] | None:
    """Return x and y of red, green, blue and white; None where they are missing."""
    value = _read_attributes(stream, {b"chromaticities": b"chromaticities"}).get(b"chromaticities", b"")
    return tuple(np.frombuffer(value, "<f4").tolist()) if len(value) == 32 else None


def pixel_aspect(stream: BinaryIO) -> float:
    """Return the pixel aspect ratio (width / height); 1 where it is missing or invalid."""
    value = _read_attributes(stream, {b"pixelAspectRatio": b"float"}).get(b"pixelAspectRatio", b"")
    return sensible_aspect(float(np.frombuffer(value, "<f4")[0]) if len(value) == 4 else 1.0)


def sensible_aspect(aspect: float) -> float:
    """Return a header's pixel aspect ratio; 1 where it is invalid."""
    return aspect if 0.1 < aspect < 10 else 1.0


def is_truncated(stream: BinaryIO) -> bool:
    """Return whether chunks of a single-part scanline picture are missing from the file. Other kinds are not checked:
    False.
    """
    stream.seek(len(MAGIC))
    flags = int.from_bytes(stream.read(4), "little")
    if flags & (_TILES | _DEEP | _PARTS):
        return False
    attributes = _read_attributes(stream, {b"dataWindow": b"box2i", b"compression": b"compression"}, to_the_end=True)
    window, compression = attributes.get(b"dataWindow", b""), attributes.get(b"compression")
    if len(window) != 16 or not compression:
        return True
    if compression[0] >= len(_LINES_PER_CHUNK):
        return False
    _, top, _, bottom = np.frombuffer(window, "<i4").tolist()
    # The header is followed by the offsets of the chunks, 8 bytes each. A chunk has the number of its first line and
    # the length of its data, 4 bytes each, then the data.
    start, end = stream.tell(), stream.seek(0, os.SEEK_END)
    chunks = -(-(bottom + 1 - top) // _LINES_PER_CHUNK[compression[0]])
    if chunks <= 0 or start + 8 * chunks > end:
        return True
    stream.seek(start)
    offsets = np.frombuffer(stream.read(8 * chunks), "<u8")
    if not offsets.all():  # 0: that chunk was never written
        return True
    last_offset = int(offsets.max())
    stream.seek(min(last_offset + 4, end))
    return last_offset + 8 + int.from_bytes(stream.read(4), "little") > end


def locate_strings(stream: BinaryIO) -> dict[str, tuple[int, bytes]]:
    """Return the offset and the bytes of each text of all headers, by the name of its attribute.

    A text of a list has its index in the name, such as "tags[1]"; a text of a part after the first has the part's
    number, such as "owner, part 1".
    """
    texts = {}
    for part, _, name, kind, length in _iterate_attributes(stream):
        value_offset = stream.tell()
        key, part_suffix = name.decode("latin-1"), f", part {part}" if part else ""
        if kind == b"string" and length <= _MAX_ATTRIBUTE_BYTES:
            texts[key + part_suffix] = value_offset, stream.read(length)
        elif kind == b"stringvector" and length <= _MAX_ATTRIBUTE_BYTES:
            value, start, number = stream.read(length), 0, 0
            while start + 4 <= len(value):
                end = start + 4 + int.from_bytes(value[start:start + 4], "little")
                texts[f"{key}[{number}]{part_suffix}"] = value_offset + start + 4, value[start + 4:end]
                start, number = end, number + 1
    return texts


def locate_names(stream: BinaryIO) -> list[tuple[int, int, bytes]]:
    """Return the part, the offset and the bytes of the name of each attribute and of each channel, in the file's order.
    """
    names = []
    for part, name_offset, name, kind, length in _iterate_attributes(stream):
        names.append((part, name_offset, name))
        if kind == b"chlist" and length <= _MAX_ATTRIBUTE_BYTES:
            value_offset, value = stream.tell(), stream.read(length)
            names += [(part, value_offset + offset, channel) for offset, channel in _iterate_channels(value)]
    return names


def _iterate_channels(value: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the offset and the name of each channel in the value of a "chlist"."""
    offset = 0
    while (end := value.find(b"\0", offset)) > offset:
        yield offset, value[offset:end]
        offset = end + 17  # past the zero, the kind, whether it is linear, and the sampling


class _Attribute(NamedTuple):
    """An attribute: number of its part, offset of its name, the name, its type, and the bytes of its value."""

    part: int
    name_offset: int
    name: bytes
    kind: bytes
    length: int


def _iterate_attributes(stream: BinaryIO) -> Iterator[_Attribute]:
    """Yield the attributes of all headers, up to the first damaged one, each with the stream at its value."""
    stream.seek(len(MAGIC))
    has_parts = int.from_bytes(stream.read(4), "little") & _PARTS
    part, is_empty, name_offset = 0, True, stream.tell()
    while True:
        if not (name := _read_name(stream)):
            if is_empty or not has_parts:  # after the last of several headers comes an empty one
                return
            part, is_empty, name_offset = part + 1, True, stream.tell()
            continue
        kind, length = _read_name(stream), int.from_bytes(stream.read(4), "little", signed=True)
        if length < 0:
            return
        value_offset = stream.tell()
        yield _Attribute(part, name_offset, name, kind, length)
        stream.seek(value_offset + length)
        is_empty, name_offset = False, stream.tell()


def _read_attributes(stream: BinaryIO, kinds: dict[bytes, bytes], *, to_the_end: bool = False) -> dict[bytes, bytes]:
    """Read the attributes of these names and types, up to the end of the header or the first damaged one.

    Leaves the stream behind the last of them; with `to_the_end` behind the header.
    """
    stream.seek(len(MAGIC) + 4)
    attributes: dict[bytes, bytes] = {}
    while (to_the_end or len(attributes) < len(kinds)) and (name := _read_name(stream)):
        kind, length = _read_name(stream), int.from_bytes(stream.read(4), "little", signed=True)
        if length < 0:
            break
        if kinds.get(name) == kind and length <= _MAX_ATTRIBUTE_BYTES:
            attributes[name] = stream.read(length)
        else:
            stream.seek(length, os.SEEK_CUR)
    return attributes


def _read_name(stream: BinaryIO) -> bytes:
    """Read a name that a zero byte ends, at most 255 bytes."""
    name = b""
    while len(name) <= 255 and (byte := stream.read(1)) not in (b"", b"\0"):
        name += byte
    return name
