# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the chunks of a WebP (RFC 9649, 2.7): metadata beside the pixels."""
from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

_READ_CHUNKS = (b"EXIF", b"ANIM")
_MAX_CHUNK_BYTES = 1 << 20
"""Bound of a chunk that is read."""


def chunks(stream: BinaryIO) -> Iterator[tuple[bytes, bytes]]:
    """Yield (name, content) of a WebP's Exif block and of its animation parameters; nothing for other files."""
    stream.seek(0)
    head = stream.read(12)
    if head[:4] != b"RIFF" or head[8:] != b"WEBP":
        return
    while len(head := stream.read(8)) == 8:
        length = int.from_bytes(head[4:], "little")
        next_offset = stream.tell() + length + length % 2
        if head[:4] in _READ_CHUNKS and length <= _MAX_CHUNK_BYTES:
            yield head[:4], stream.read(length)
        stream.seek(next_offset)


def is_animated(stream: BinaryIO) -> bool:
    """Return whether a WebP has several frames."""
    return any(name == b"ANIM" for name, _ in chunks(stream))
