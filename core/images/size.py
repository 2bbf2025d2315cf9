# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the size of a picture from its header alone; of PNG, JPEG, TIFF and EXR without a library, so that Blender's
own Python can."""
from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from ..errors import FrameError
from ..system.reading import open_regular
from .decoders import MAX_PIXELS as MAX_PIXELS
from .decoders import describe, file_kind
from .formats import exr_header, jpeg, png, tiff
from .formats.kinds import HEAD_BYTES, holds_video


def picture_size(path: Path | str) -> tuple[int, int]:
    """Read (width, height) from the header alone; for an EXR, those of its displayWindow.

    Raises FrameError where the file is missing or its header is not that of a picture.
    """
    path = Path(path)
    if not path.is_file():
        raise FrameError(f"{path} is missing.")
    try:
        kind = file_kind(path)
        with open_regular(path) as stream:
            head = stream.read(HEAD_BYTES)
            is_big = head[:4] in tiff.BIG_TIFF
            stream.seek(0)
            size = _size_from_header(stream)
        if not kind and holds_video(head):
            raise FrameError(f"{path} holds a video, not a picture; give it the suffix of its format, such as .mp4.")
        # `_size_from_header` cannot read BigTIFF and these formats; in a raw file it finds the size of a preview.
        if is_big or kind not in ("png", "jpeg", "tiff", "exr", ""):
            size = describe(path, kind)[:2]
    except OSError as problem:
        raise FrameError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    return checked_size(path, size)


def checked_size(path: Path, size: tuple[int, int] | None) -> tuple[int, int]:
    """Return a size; raises FrameError where it is missing, empty or larger than MAX_PIXELS."""
    if size is None or min(size) <= 0:
        raise FrameError(f"{path} is not a picture, or its header is damaged; export it again.")
    if size[0] * size[1] > MAX_PIXELS:
        raise FrameError(f"{path} claims {size[0]} x {size[1]} pixels, more than this program opens.")
    return size


def _size_from_header(stream: BinaryIO) -> tuple[int, int] | None:
    """Return (width, height) by the header at the start of a stream; None for other formats and damaged headers."""
    head = stream.read(24)
    if head[:8] == png.SIGNATURE and len(head) == 24:
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    if head[:2] == b"\xff\xd8":
        header = jpeg.frame_header(stream)
        return (header.width, header.height) if header else None
    if head[:4] in (b"II*\0", b"MM\0*"):
        sides = tiff.integer_values(tiff.read_tags(stream, (tiff.WIDTH, tiff.HEIGHT)))
        return (sides[tiff.WIDTH], sides[tiff.HEIGHT]) if len(sides) == 2 else None
    if head[:4] == exr_header.MAGIC:
        return _exr_size(stream)
    return None


def _exr_size(stream: BinaryIO) -> tuple[int, int] | None:
    """Return the size of the displayWindow, or of the dataWindow if there is no displayWindow. A dataWindow that is
    missing, empty or too large is returned too, so that `checked_size` refuses the file."""
    sizes = exr_header.windows(stream)
    stored = sizes.get("dataWindow")
    is_usable = stored is not None and min(stored) > 0 and stored[0] * stored[1] <= MAX_PIXELS
    return sizes.get("displayWindow", stored) if is_usable else stored
