# SPDX-License-Identifier: GPL-3.0-or-later
"""What an EXR's first header says, read without a library: Blender's own Python has none that reads EXRs.

The layout is that of "OpenEXR File Layout" (Academy Software Foundation): after a magic number and a version, each
attribute is a name, a type, a length and that many bytes; an empty name ends the header.
"""
from __future__ import annotations

import os
from typing import BinaryIO

import numpy as np

MAGIC = b"\x76\x2f\x31\x01"
_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256, 256, 32)
"""Lines of a chunk, by the number of the compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB and two
of HTJ2K."""
_TILES, _DEEP, _PARTS = 0x200, 0x800, 0x1000  # flags of the version
_LONGEST = 1 << 20
"""Bytes of an attribute that is read: some ten thousand channels, where hostile files claim gigabytes."""


def windows(stream: BinaryIO) -> dict[str, tuple[int, int]]:
    """(width, height) of the "dataWindow" (what is stored) and the "displayWindow" (the frame), where they are told."""
    told = _attributes(stream, {b"dataWindow": b"box2i", b"displayWindow": b"box2i"})
    corners = {name: np.frombuffer(value, "<i4").tolist() for name, value in told.items() if len(value) == 16}
    return {name.decode(): (x1 - x0 + 1, y1 - y0 + 1) for name, (x0, y0, x1, y1) in corners.items()}


HALF = 1
"""Of the kinds of a channel's numbers, 16 bit floats."""


def channel_kinds(stream: BinaryIO) -> dict[str, int]:
    """Of the channels, such as "flare_sun.R", in the file's order, the kind of their numbers; none where the header is
    damaged."""
    value = _attributes(stream, {b"channels": b"chlist"}).get(b"channels", b"")
    kinds, at = {}, 0
    while (end := value.find(b"\0", at)) > at:
        kinds[value[at:end].decode(errors="replace")] = int.from_bytes(value[end + 1:end + 5], "little")
        at = end + 17  # past the zero, the kind, whether it is linear, and the sampling
    return kinds if value[at:] == b"\0" else {}


def chromaticities(stream: BinaryIO) -> tuple[float, ...] | None:
    """Red's, green's, blue's and white's x and y; None where they are not told."""
    value = _attributes(stream, {b"chromaticities": b"chromaticities"}).get(b"chromaticities", b"")
    return tuple(np.frombuffer(value, "<f4").tolist()) if len(value) == 32 else None


def pixel_aspect(stream: BinaryIO) -> float:
    """Width of a pixel by its height; 1 where that is not told, or makes no sense."""
    value = _attributes(stream, {b"pixelAspectRatio": b"float"}).get(b"pixelAspectRatio", b"")
    return sensible_aspect(float(np.frombuffer(value, "<f4")[0]) if len(value) == 4 else 1.0)


def sensible_aspect(told: float) -> float:
    """What a header tells of a pixel's width by its height; 1 where that makes no sense."""
    return told if 0.1 < told < 10 else 1.0


def is_cut_off(stream: BinaryIO) -> bool:
    """Whether the chunks of a picture of one part in lines are not all in the file. Of other kinds it is not known, and
    none of those is."""
    stream.seek(len(MAGIC))
    flags = int.from_bytes(stream.read(4), "little")
    if flags & (_TILES | _DEEP | _PARTS):
        return False
    told = _attributes(stream, {b"dataWindow": b"box2i", b"compression": b"compression"}, to_the_end=True)
    window, compression = told.get(b"dataWindow", b""), told.get(b"compression")
    if len(window) != 16 or not compression:
        return True
    if compression[0] >= len(_LINES):
        return False
    _, top, _, bottom = np.frombuffer(window, "<i4").tolist()
    begin, end = stream.tell(), stream.seek(0, os.SEEK_END)
    chunks = -(-(bottom + 1 - top) // _LINES[compression[0]])
    if chunks <= 0 or begin + 8 * chunks > end:
        return True
    stream.seek(begin)
    places = np.frombuffer(stream.read(8 * chunks), "<u8")
    if not places.all():  # one that is still being written has none yet
        return True
    last = int(places.max())
    stream.seek(min(last + 4, end))
    return last + 8 + int.from_bytes(stream.read(4), "little") > end


def _attributes(stream: BinaryIO, kinds: dict[bytes, bytes], *, to_the_end: bool = False) -> dict[bytes, bytes]:
    """Those of the given names and types, up to where the header ends or is damaged; the stream is past all of them,
    and `to_the_end` past the header."""
    stream.seek(len(MAGIC) + 4)
    found: dict[bytes, bytes] = {}
    while (to_the_end or len(found) < len(kinds)) and (name := _until_zero(stream)):
        kind, length = _until_zero(stream), int.from_bytes(stream.read(4), "little", signed=True)
        if length < 0:
            break
        if kinds.get(name) == kind and length <= _LONGEST:
            found[name] = stream.read(length)
        else:
            stream.seek(length, os.SEEK_CUR)
    return found


def _until_zero(stream: BinaryIO) -> bytes:
    """A name, 255 bytes at most."""
    name = b""
    while len(name) <= 255 and (byte := stream.read(1)) not in (b"", b"\0"):
        name += byte
    return name
