# SPDX-License-Identifier: GPL-3.0-or-later
"""Says why an intact file of a known format is not read, and what its owner can do.

Libraries decode some of these files as something else without an error, so `read.py` calls this module first.
"""
from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..errors import FrameError
from ..system.reading import open_regular
from .formats import jpeg, tiff, webp
from .formats.kinds import HEAD_BYTES, SUFFIX_OF_KIND, holds_video, is_video, kind_of


def unsupported_file_error(path: Path) -> FrameError:
    """Make the error for a file of another kind, by its name."""
    if is_video(path):
        return FrameError(f"{path} is a video; take its frames out first, as by `ffmpeg -i {path.name} "
                          "frames/%06d.png`, and give their folder.")
    if path.is_file() and (reason := misnamed_reason(path)):
        return FrameError(f"{path} {reason}.")
    return FrameError(f"{path} is not a picture this program reads; use PNG, JPEG, TIFF, EXR or DPX.")


def misnamed_reason(path: Path) -> str:
    """Say what a file whose suffix is not a picture's really holds, a picture or a video; "" for unknown contents.

    Raises OSError.
    """
    with open_regular(path) as stream:
        head = stream.read(HEAD_BYTES)
    if kind := kind_of(head, ""):
        return f"holds {kind.upper()} data; give it the suffix {SUFFIX_OF_KIND[kind]}"
    return "holds a video; give it the suffix of its format, such as .mp4" if holds_video(head) else ""


_CMYK = "is CMYK, for print; convert it to RGB"


def unsupported_reason(path: Path) -> str:
    """Say why an intact file would be decoded wrongly or not at all, and what to do about it; "" for a good file."""
    with open_regular(path) as stream:
        magic = stream.read(4)
        stream.seek(0)
        if magic[:2] == b"\xff\xd8":  # whatever it is named
            header = jpeg.frame_header(stream)
            if header is not None and header.bits > 8:
                return f"holds {header.bits} bits a colour; save it with 8, or as PNG or TIFF with 16"
            return _CMYK if header is not None and header.components == 4 else ""
        if webp.is_animated(stream):
            return "is an animation; export its frames as files of their own"
        tags = _storage_tags(stream)
    if not tags:
        return ""
    if tags.get(tiff.PHOTOMETRIC) == tiff.SEPARATED:
        return _CMYK
    if tags.get(tiff.PHOTOMETRIC) in tiff.LAB:
        return "is in Lab colours; convert it to RGB"
    if tags.get(tiff.SAMPLES, 1) > 4:
        return f"has {tags[tiff.SAMPLES]} channels; save it as RGB, or RGB with alpha"
    if (tags.get(tiff.BITS, 1), tags.get(tiff.SAMPLE_FORMAT, tiff.UNSIGNED)) == (32, tiff.UNSIGNED):
        return "holds whole numbers of 32 bits; save it as 8 or 16 bit or as 32 bit float"
    return ""


def needs_openimageio(path: Path) -> bool:
    """Return whether OpenCV decodes a TIFF wrongly or not at all: BigTIFF; 16 bit floats; above 8 bits,
    separate planes or 0 for white; grey with alpha; depths other than 1, 8, 16, 32 and 64 bits; and compressions that
    OpenCV is built without."""
    with open_regular(path) as stream:
        if stream.read(4) in tiff.BIG_TIFF:
            return True
        tags = _storage_tags(stream)
    bits, samples = tags.get(tiff.BITS, 1), tags.get(tiff.SAMPLES, 1)
    return (bits not in (1, 8, 16, 32, 64) or samples == 2
            or tags.get(tiff.COMPRESSION) in tiff.UNSUPPORTED_COMPRESSIONS
            or (bits, tags.get(tiff.SAMPLE_FORMAT)) == (16, tiff.FLOATS)
            or (bits > 8 and (tags.get(tiff.PHOTOMETRIC) == tiff.WHITE_IS_0
                              or (tags.get(tiff.PLANES) == tiff.PLANAR and samples > 1))))


def _storage_tags(stream: BinaryIO) -> dict[int, int]:
    """Return the first value of the tags that say how a TIFF is stored; none of other files."""
    numbers = (tiff.BITS, tiff.PHOTOMETRIC, tiff.SAMPLES, tiff.PLANES, tiff.SAMPLE_FORMAT, tiff.COMPRESSION)
    return {name: int(tag.values[0]) for name, tag in tiff.read_tags(stream, numbers).items()
            if np.issubdtype(tag.values.dtype, np.integer)}
