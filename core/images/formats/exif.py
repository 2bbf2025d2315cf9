# SPDX-License-Identifier: GPL-3.0-or-later
"""Orientation and focal length of a photograph, from its Exif block."""
from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from ...system.reading import open_regular
from . import jpeg, png, tiff, webp

EXIF, FOCAL_35MM = 0x8769, 0xA405
_THUMBNAIL, _THUMBNAIL_LENGTH = 0x201, 0x202
"""Tags of the second directory: where its JPEG begins, and its bytes."""
SWAPS_SIDES = (5, 6, 7, 8)
"""Orientations that swap width and height."""
_BLOCK = re.compile(rb"Exif\0\0((?:II\*\0|MM\0\*).{0,65536})", re.DOTALL)
"""An Exif block in a file whose structure of boxes is not parsed."""
_MAX_SEARCH_BYTES = 1 << 22
"""First bytes of such a file in which the block is looked for."""
WIDTH_35MM = 36.0
"""Long side of 35 mm film in millimetres."""


def read_exif(path: Path) -> tuple[int, float | None]:
    """Return (orientation 1..8, focal length as a multiple of the long side or None) of a JPEG, PNG, TIFF, WebP,
    HEIC or AVIF.

    (1, None) for other files, and where the tags are missing.
    """
    with open_regular(path) as stream:
        block = _exif_block(stream)
        main_tags = tiff.integer_values(tiff.read_tags(block, (tiff.ORIENTATION, EXIF)))
        exif_tags = (tiff.integer_values(tiff.read_tags(block, (FOCAL_35MM,), main_tags[EXIF])) if EXIF in main_tags
                     else {})
    orientation, focal = main_tags.get(tiff.ORIENTATION, 1), exif_tags.get(FOCAL_35MM, 0)
    # A focal length beyond 5 to 2000 mm is damaged; 0 stands for an unknown one.
    return orientation if 1 <= orientation <= 8 else 1, focal / WIDTH_35MM if 5 <= focal <= 2000 else None


def _exif_block(stream: BinaryIO) -> BinaryIO:
    """Return the metadata of a picture as a TIFF stream, the form of every Exif block; empty where it has none."""
    magic = stream.read(8)
    if magic[:4] in (b"II*\0", b"MM\0*", *tiff.BIG_TIFF):
        return stream
    if magic[:2] == b"\xff\xd8":
        blocks = (content[6:] for marker, content in jpeg.segments(stream)
                  if marker == jpeg.APP1 and content.startswith(b"Exif\0\0"))
    elif magic[4:8] == b"ftyp":  # HEIC and AVIF, whose pixels are read upright
        match = _BLOCK.search(magic + stream.read(_MAX_SEARCH_BYTES))
        return io.BytesIO(upright_block(match[1]) if match else b"")
    elif magic[:4] == b"RIFF":
        blocks = (content.removeprefix(b"Exif\0\0") for name, content in webp.chunks(stream) if name == b"EXIF")
    else:
        blocks = (content for _, content in png.chunks(stream, (png.EXIF,)))
    return io.BytesIO(next(blocks, b""))


def upright_block(block: bytes) -> bytes:
    """Return an Exif block whose orientation is 1, for pixels that stand upright; empty for a damaged one."""
    order: Literal["little", "big"] = "little" if block[:2] == b"II" else "big"
    directory_offset = int.from_bytes(block[4:8], order)
    if block[:4] not in (b"II*\0", b"MM\0*") or directory_offset + 2 > len(block):
        return b""
    changed = bytearray(block)
    for number in range(int.from_bytes(block[directory_offset:directory_offset + 2], order)):
        entry = directory_offset + 2 + 12 * number  # offset of 12 bytes: tag, type, count, value
        if entry + 12 <= len(block) and int.from_bytes(block[entry:entry + 2], order) == tiff.ORIENTATION:
            changed[entry + 8:entry + 10] = (1).to_bytes(2, order)
    return bytes(changed)


def without_thumbnail(block: bytes) -> bytes:
    """Return an Exif block without its second directory, which holds a small copy of the picture; damaged ones
    unchanged.

    If the copy is the end of the block, it is cut off; elsewhere it is overwritten with zeros, so that no offset
    changes.
    """
    order: Literal["little", "big"] = "little" if block[:2] == b"II" else "big"
    first_directory = int.from_bytes(block[4:8], order)
    entry_count = int.from_bytes(block[first_directory:first_directory + 2], order)
    link = first_directory + 2 + 12 * entry_count  # offset of the second directory's offset
    second_directory = int.from_bytes(block[link:link + 4], order)
    if block[:4] not in (b"II*\0", b"MM\0*") or not second_directory or link + 4 > len(block):
        return block
    changed = bytearray(block)
    changed[link:link + 4] = bytes(4)
    tags = tiff.integer_values(tiff.read_tags(io.BytesIO(block), (_THUMBNAIL, _THUMBNAIL_LENGTH), second_directory))
    start = tags.get(_THUMBNAIL, 0)
    end = start + tags.get(_THUMBNAIL_LENGTH, 0)
    if start >= link + 4 and end <= len(block):  # guards the first directory against a damaged tag
        changed[start:end] = b"" if end == len(block) else bytes(end - start)
    return bytes(changed)


def apply_orientation(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Rotate and mirror stored pixels (height, width, ...) by an Exif orientation, as viewers show them."""
    if orientation in SWAPS_SIDES:
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def undo_orientation(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Invert `apply_orientation`."""
    return apply_orientation(pixels, {6: 8, 8: 6}.get(orientation, orientation))
