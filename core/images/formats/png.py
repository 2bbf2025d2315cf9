# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and makes the chunks of a PNG (PNG specification, chapter 5): metadata beside the pixels."""
from __future__ import annotations

import zlib
from collections.abc import Container, Iterator
from typing import BinaryIO

SIGNATURE = b"\x89PNG\r\n\x1a\n"
EXIF = b"eXIf"


def chunks(stream: BinaryIO, names: Container[bytes], *, before_pixels: bool = False) -> Iterator[tuple[bytes, bytes]]:
    """Yield (name, content) of a PNG's chunks of these names, in the file's order, without damaged ones; nothing for
    other files.

    before_pixels: stop at the pixels, of which a large picture has a thousand chunks. All chunks that say how pixels
    are decoded come before.
    """
    for name, length in _chunk_headers(stream):
        if before_pixels and name == b"IDAT":
            return
        if name not in names:
            continue
        content, checksum = stream.read(length), stream.read(4)
        if zlib.crc32(name + content).to_bytes(4, "big") == checksum:
            yield name, content


def is_truncated(data: bytes) -> bool:
    """Return whether a chunk of a PNG claims more than the file holds; False for other files.

    OpenCV allocates as much as a chunk claims, gigabytes for a damaged length in a small file.
    """
    offset, end = len(SIGNATURE), len(data) if data.startswith(SIGNATURE) else 0
    while offset + 8 <= end:
        next_offset = offset + 12 + int.from_bytes(data[offset:offset + 4], "big")
        if next_offset > end:
            return True
        if data[offset + 4:offset + 8] == b"IEND":  # what follows is not part of the PNG
            return False
        offset = next_offset
    return False


def _chunk_headers(stream: BinaryIO) -> Iterator[tuple[bytes, int]]:
    """Yield (name, length) of each chunk, with the stream at its content; nothing if the file is no PNG."""
    stream.seek(0)
    if stream.read(8) != SIGNATURE:
        return
    while len(head := stream.read(8)) == 8:
        length = int.from_bytes(head[:4], "big")
        next_offset = stream.tell() + length + 4
        yield head[4:], length
        stream.seek(next_offset)


def make_chunk(name: bytes, content: bytes) -> bytes:
    """Encode a chunk."""
    return len(content).to_bytes(4, "big") + name + content + zlib.crc32(name + content).to_bytes(4, "big")
