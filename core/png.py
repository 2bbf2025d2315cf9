# SPDX-License-Identifier: GPL-3.0-or-later
"""The chunks of a PNG (PNG specification, chapter 5): what it says of itself beside its pixels."""
from __future__ import annotations

import os
import zlib
from collections.abc import Container, Iterator
from typing import BinaryIO

SIGNATURE = b"\x89PNG\r\n\x1a\n"
EXIF = b"eXIf"


def chunks(stream: BinaryIO, wanted: Container[bytes]) -> Iterator[tuple[bytes, bytes]]:
    """(name, content) of the chunks of these names, in the file's order; damaged ones are left out, and all where it is
    no PNG."""
    stream.seek(0)
    if stream.read(8) != SIGNATURE:
        return
    while len(head := stream.read(8)) == 8:
        length, name = int.from_bytes(head[:4], "big"), head[4:]
        if name not in wanted:
            stream.seek(length + 4, os.SEEK_CUR)
            continue
        content, sum_told = stream.read(length), stream.read(4)
        if zlib.crc32(name + content).to_bytes(4, "big") == sum_told:
            yield name, content


def is_cut_off(data: memoryview) -> bool:
    """Whether a chunk says that it goes on beyond the file's end. OpenCV makes room for as much as it says, gigabytes
    for a damaged length of a small file."""
    place = len(SIGNATURE)
    while place < len(data):
        length, name = int.from_bytes(data[place:place + 4], "big"), bytes(data[place + 4:place + 8])
        place += 12 + length
        if place > len(data):
            return True
        if name == b"IEND":
            break
    return False


def chunk(name: bytes, content: bytes) -> bytes:
    """As it stands in a file."""
    return len(content).to_bytes(4, "big") + name + content + zlib.crc32(name + content).to_bytes(4, "big")
