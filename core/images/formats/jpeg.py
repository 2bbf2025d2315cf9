# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and makes the segments of a JPEG (ITU-T T.81, annex B) before its pixels: size and metadata."""
from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of frame headers (SOF): precision, height, width, number of components."""
SOS, APP0, APP1, APP2, APP13, COMMENT = 0xDA, 0xE0, 0xE1, 0xE2, 0xED, 0xFE
EXIF, XMP, EXTENDED_XMP = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
"""First bytes of the segments APP1 that hold these."""
PHOTOSHOP = b"Photoshop 3.0\0"
"""First bytes of the segments APP13 that hold Photoshop's image resources."""


def segments(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield (marker, content) of each segment, as far as the file is intact."""
    stream.seek(2)
    while (byte := stream.read(1)) == b"\xff":
        while byte == b"\xff":  # fill bytes may stand before a marker
            byte = stream.read(1)
        length = int.from_bytes(stream.read(2), "big")
        if not byte or byte[0] == SOS or length < 2:
            return
        content = stream.read(length - 2)
        if len(content) < length - 2:
            return
        yield byte[0], content


class Header(NamedTuple):
    """Size in pixels, number of components, and bits of each."""

    width: int
    height: int
    components: int
    bits: int


def frame_header(stream: BinaryIO) -> Header | None:
    """Read the frame header; None where it is missing."""
    for marker, content in segments(stream):
        if marker in SOF and len(content) >= 6:
            bits, height, width, components = struct.unpack(">BHHB", content[:6])
            return Header(width, height, components, bits)
    return None


def make_segment(marker: int, content: bytes) -> bytes:
    """Encode a segment."""
    return bytes((0xFF, marker)) + (len(content) + 2).to_bytes(2, "big") + content
