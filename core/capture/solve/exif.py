# SPDX-License-Identifier: GPL-3.0-or-later
"""The two things a photograph's Exif block says that a solve needs: which way is up, and the focal length."""
from __future__ import annotations

import io
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ... import tiff
from ...pictures import Picture

EXIF, FOCAL_35MM = 0x8769, 0xA405
MOST = 1 << 20
"""Bytes of a PNG's Exif that are read."""
WIDTH_35MM = 36.0  # millimetres along the long side


def read_exif(path: Path) -> tuple[int, float | None]:
    """(orientation 1..8, focal length as a multiple of the long side or None) of a JPEG, PNG or TIFF; (1, None) of
    others, and where it is not told."""
    with open(path, "rb") as stream:
        block = _exif_block(stream)
        first = tiff.whole_numbers(tiff.read_tags(block, (tiff.ORIENTATION, EXIF)))
        second = tiff.whole_numbers(tiff.read_tags(block, (FOCAL_35MM,), first[EXIF])) if EXIF in first else {}
    orientation, focal = first.get(tiff.ORIENTATION, 1), second.get(FOCAL_35MM, 0)
    return orientation if 1 <= orientation <= 8 else 1, focal / WIDTH_35MM if 5 <= focal <= 2000 else None


def _exif_block(stream: BinaryIO) -> BinaryIO:
    """What a picture says of itself, in the form of a TIFF, as which Exif is written everywhere; empty where it says
    nothing."""
    head = stream.read(1 << 16)
    if head[:4] in (b"II*\0", b"MM\0*"):
        return stream
    if head[:2] == b"\xff\xd8" and (start := head.find(b"Exif\0\0")) >= 0:
        return io.BytesIO(head[start + 6:])
    at = 8
    while head[:8] == b"\x89PNG\r\n\x1a\n":
        stream.seek(at)
        length, name = int.from_bytes(stream.read(4), "big"), stream.read(4)
        if name == b"eXIf" and length < MOST:
            return io.BytesIO(stream.read(length))
        if len(name) < 4 or name == b"IEND":
            break
        at += 12 + length
    return io.BytesIO()


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
