# SPDX-License-Identifier: GPL-3.0-or-later
"""The segments of a JPEG (ITU-T T.81, annex B) before its pixels: its size, and how it is to be shown."""
from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of frame headers (SOF): precision, height, width, number of components."""
PIXELS, APP1, APP2 = 0xDA, 0xE1, 0xE2


def segments(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """(marker, what follows its length), as far as the file is whole."""
    stream.seek(2)
    while (byte := stream.read(1)) == b"\xff":
        while byte == b"\xff":  # fill bytes may stand before a marker
            byte = stream.read(1)
        length = int.from_bytes(stream.read(2), "big")
        if not byte or byte[0] == PIXELS or length < 2:
            return
        content = stream.read(length - 2)
        if len(content) < length - 2:
            return
        yield byte[0], content


class Header(NamedTuple):
    """Of a picture: pixels, how many components each has, of how many bits."""

    width: int
    height: int
    components: int
    bits: int


def frame_header(stream: BinaryIO) -> Header | None:
    """None where it is missing."""
    for marker, content in segments(stream):
        if marker in FRAMES and len(content) >= 6:
            bits, height, width, components = struct.unpack(">BHHB", content[:6])
            return Header(width, height, components, bits)
    return None


def segment(marker: int, content: bytes) -> bytes:
    """As it stands in a file."""
    return bytes((0xFF, marker)) + (len(content) + 2).to_bytes(2, "big") + content
