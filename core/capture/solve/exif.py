# SPDX-License-Identifier: GPL-3.0-or-later
"""The two things a photograph's Exif block says that a solve needs: which way is up, and the focal length."""
from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ... import tiff
from ...pictures import Picture

EXIF, FOCAL_35MM = 0x8769, 0xA405
WIDTH_35MM = 36.0  # millimetres along the long side


def read_exif(path: Path) -> tuple[int, float | None]:
    """(orientation 1..8, focal length as a multiple of the long side or None) of a JPEG; (1, None) of others."""
    with open(path, "rb") as stream:
        head = stream.read(1 << 16)
    start = head.find(b"Exif\0\0") + 6
    if head[:2] != b"\xff\xd8" or start < 6:
        return 1, None
    block = io.BytesIO(head[start:])
    first = tiff.whole_numbers(tiff.read_tags(block, (tiff.ORIENTATION, EXIF)))
    second = tiff.whole_numbers(tiff.read_tags(block, (FOCAL_35MM,), first[EXIF])) if EXIF in first else {}
    orientation, focal = first.get(tiff.ORIENTATION, 1), second.get(FOCAL_35MM, 0)
    return orientation if 1 <= orientation <= 8 else 1, focal / WIDTH_35MM if 5 <= focal <= 2000 else None


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
