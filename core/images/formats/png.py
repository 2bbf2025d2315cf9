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
    for name, length in _heads(stream):
        if name not in wanted:
            continue
        content, sum_told = stream.read(length), stream.read(4)
        if zlib.crc32(name + content).to_bytes(4, "big") == sum_told:
            yield name, content


def is_cut_off(stream: BinaryIO) -> bool:
    """Whether a chunk of a PNG claims more than the file holds. OpenCV makes room for as much as it claims, gigabytes
    for a damaged length in a small file."""
    end = stream.seek(0, os.SEEK_END)
    for name, length in _heads(stream):
        if stream.tell() + length + 4 > end:
            return True
        if name == b"IEND":  # what follows is no part of it
            break
    return False


def _heads(stream: BinaryIO) -> Iterator[tuple[bytes, int]]:
    """(name, length) of each chunk, the stream where its content begins; none where it is no PNG."""
    stream.seek(0)
    if stream.read(8) != SIGNATURE:
        return
    while len(head := stream.read(8)) == 8:
        length = int.from_bytes(head[:4], "big")
        after = stream.tell() + length + 4
        yield head[4:], length
        stream.seek(after)


def chunk(name: bytes, content: bytes) -> bytes:
    """As it stands in a file."""
    return len(content).to_bytes(4, "big") + name + content + zlib.crc32(name + content).to_bytes(4, "big")
