# SPDX-License-Identifier: GPL-3.0-or-later
"""Says why an intact file of a known format is not read, and what its owner can do.

OpenCV decodes some of these files as something else without an error, so `read.py` calls this module before it decodes.
"""
from __future__ import annotations

from pathlib import Path

from ..errors import FrameError
from ..system.reading import open_regular
from .formats import jpeg, tiff
from .video import is_video


def unsupported_file(path: Path) -> FrameError:
    """Make the error for a file of another kind, by its name."""
    if is_video(path):
        return FrameError(f"{path} is a video; take its frames out first, as by `ffmpeg -i {path.name} "
                          "frames/%06d.png`, and give their folder.")
    return FrameError(f"{path} is not a picture this program reads; use PNG, JPEG, TIFF or EXR.")


def compression_reason(path: Path) -> str:
    """Name a TIFF's compression that OpenCV cannot read, and what to do; "" for one that it can."""
    with open_regular(path) as stream:
        tags = tiff.integer_values(tiff.read_tags(stream, (tiff.COMPRESSION,)))
    name = tiff.UNSUPPORTED_COMPRESSIONS.get(tags.get(tiff.COMPRESSION, 0))
    return f"is compressed by {name}, which this program does not read; save it with LZW, ZIP or none" if name else ""


_CMYK = "is CMYK, for print; convert it to RGB"


def unsupported_reason(path: Path) -> str:
    """Say what OpenCV would decode wrongly, or not at all though the file is intact, and what to do; "" for a good
    file."""
    with open_regular(path) as stream:
        magic = stream.read(4)
        stream.seek(0)
        if magic[:2] == b"\xff\xd8":  # whatever it is named
            header = jpeg.frame_header(stream)
            if header is not None and header.bits > 8:
                return f"holds {header.bits} bits a colour; save it with 8, or as PNG or TIFF with 16"
            return _CMYK if header is not None and header.components == 4 else ""
        if magic not in (b"II*\0", b"MM\0*"):
            return ""
        numbers = (tiff.BITS, tiff.PHOTOMETRIC, tiff.SAMPLES, tiff.PLANES, tiff.SAMPLE_FORMAT)
        tags = {name: tag.values[0] for name, tag in tiff.read_tags(stream, numbers).items()}
    if tags.get(tiff.SAMPLES) == 2:
        return "is grey with alpha; save it as RGB with alpha, or as PNG"
    if tags.get(tiff.PHOTOMETRIC) == tiff.SEPARATED:
        return _CMYK
    if tags.get(tiff.PHOTOMETRIC) in tiff.LAB:
        return "is in Lab colours; convert it to RGB"
    if tags.get(tiff.SAMPLES, 1) > 4:
        return f"has {tags[tiff.SAMPLES]} channels; save it as RGB, or RGB with alpha"
    depth = tags.get(tiff.BITS, 1), tags.get(tiff.SAMPLE_FORMAT, tiff.UNSIGNED)
    if depth in ((16, tiff.FLOATS), (32, tiff.UNSIGNED)):
        kind = "floats" if depth[1] == tiff.FLOATS else "whole numbers"
        return f"holds {kind} of {depth[0]} bits; save it as 8 or 16 bit or as 32 bit float"
    if tags.get(tiff.BITS, 1) <= 8:
        return ""
    if tags.get(tiff.PLANES) == tiff.PLANAR and tags.get(tiff.SAMPLES, 1) > 1:
        return "has its colours apart (per channel, planar); save it interleaved"
    if tags.get(tiff.PHOTOMETRIC) == tiff.WHITE_IS_0:
        return "has 0 for white; save it with 0 for black"
    return ""
