# SPDX-License-Identifier: GPL-3.0-or-later
"""The two things a photograph's Exif block says that a solve needs: which way is up, and the focal length."""
from __future__ import annotations

import struct
from pathlib import Path
from typing import Literal

import numpy as np

from ...pictures import Picture

ORIENTATION, EXIF, FOCAL_35MM = 0x0112, 0x8769, 0xA405
WIDTH_35MM = 36.0  # millimetres along the long side


def read_exif(path: Path) -> tuple[int, float | None]:
    """(orientation 1..8, focal length as a multiple of the long side or None) of a JPEG; (1, None) of others."""
    with open(path, "rb") as stream:
        head = stream.read(1 << 16)
    start = head.find(b"Exif\0\0") + 6
    if head[:2] != b"\xff\xd8" or start < 6:
        return 1, None
    block = head[start:]
    order: Literal["little", "big"] = "little" if block[:2] == b"II" else "big"
    try:
        first = _entries(block, int.from_bytes(block[4:8], order), order)
        second = _entries(block, first[EXIF], order) if EXIF in first else {}
    except struct.error:  # a damaged block says nothing
        return 1, None
    orientation, focal = first.get(ORIENTATION, 1), second.get(FOCAL_35MM, 0)
    return orientation if 1 <= orientation <= 8 else 1, focal / WIDTH_35MM if 5 <= focal <= 2000 else None


def _entries(block: bytes, at: int, order: Literal["little", "big"]) -> dict[int, int]:
    """The whole-number entries of one directory of the TIFF structure."""
    sign = "<" if order == "little" else ">"
    (number,) = struct.unpack_from(sign + "H", block, at)
    found = {}
    for i in range(number):
        tag, kind, count = struct.unpack_from(sign + "HHI", block, at + 2 + 12 * i)
        if count == 1 and kind in (3, 4):
            (found[tag],) = struct.unpack_from(sign + ("H" if kind == 3 else "I"), block, at + 10 + 12 * i)
    return found


def upright(picture: Picture, orientation: int) -> Picture:
    """The picture turned and mirrored as an Exif orientation asks."""
    pixels = picture.pixels
    if orientation in (5, 6, 7, 8):
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return Picture(np.ascontiguousarray(pixels), picture.encoding)
