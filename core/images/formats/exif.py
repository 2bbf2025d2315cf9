# SPDX-License-Identifier: GPL-3.0-or-later
"""Which way a photograph is up, and through how long a lens it was taken, as its Exif block says."""
from __future__ import annotations

import io
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from . import jpeg, png, tiff

EXIF, FOCAL_35MM = 0x8769, 0xA405
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
    begins = stream.read(8)
    if begins[:4] in (b"II*\0", b"MM\0*"):
        return stream
    if begins[:2] == b"\xff\xd8":
        found = (content[6:] for marker, content in jpeg.segments(stream)
                 if marker == jpeg.APP1 and content.startswith(b"Exif\0\0"))
    else:
        found = (content for _, content in png.chunks(stream, (png.EXIF,)))
    return io.BytesIO(next(found, b""))


def upright(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """(height, width, ...) as stored, turned and mirrored as an Exif orientation asks: as viewers show it."""
    if orientation in (5, 6, 7, 8):
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def as_stored(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """The inverse of `upright`."""
    return upright(pixels, {6: 8, 8: 6}.get(orientation, orientation))
