# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads picture files: all commands decode PNG, JPEG, TIFF and EXR here.

OpenCV is imported where it is used, because Blender's own Python has none.
"""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError
from ..system.reading import open_regular, read_bytes
from .exr import main_part, read_exr_parts, rec709_pixels, rgb_channels, window_from_header
from .formats import exr_header, png, tiff
from .listing import SUFFIXES
from .picture import Picture
from .size import picture_size
from .unsupported import compression_reason, unsupported_file, unsupported_reason
from .window import crop_to_display_window


def read_picture(path: Path | str, *, keep_primaries: bool = False) -> Picture:
    """Decode PNG, JPEG, TIFF (8 or 16 bit, grey or colour, alpha dropped) or EXR.

    An EXR with `chromaticities` other than Rec. 709 (ACEScg, say) is converted, unless `keep_primaries`. One with more
    pixels than the frame (overscan), or fewer, is cropped to the frame, and black where it has none.

    Raises FrameError where the file is missing, damaged or of another kind, or holds NaN or infinity.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise unsupported_file(path)
    if not path.is_file():
        raise FrameError(f"{path} is missing.")
    if path.suffix.lower() == ".exr":
        picture_size(path)
        header, channels = main_part([(part, part[1]) for part in read_exr_parts(path)])
        stored = rgb_channels(path, channels)
        pixels = stored if keep_primaries else rec709_pixels(path, stored, header)
        return Picture(crop_to_display_window(pixels, window_from_header(path, header)), "linear")
    stored = read_stored_pixels(path)
    if stored.ndim == 2:
        stored = np.repeat(stored[..., None], 3, axis=2)
    colour = stored[..., 2::-1]  # OpenCV keeps B G R (A)
    if stored.dtype == np.uint8:
        return Picture(colour.astype(np.float32) / np.float32(255), "srgb")
    if stored.dtype == np.uint16:
        return Picture(colour.astype(np.float32) / np.float32(65535), "srgb")
    if stored.dtype.kind != "f":
        raise FrameError(f"{path} holds {stored.dtype} pixels; save it as 8 or 16 bit or as 32 bit float.")
    pixels = np.ascontiguousarray(colour, np.float32)
    if not np.isfinite(pixels).all():
        raise FrameError(f"{path} holds pixels that are not finite numbers; clean it before it is used.")
    return Picture(pixels, "linear")  # a float TIFF


def has_float_pixels(path: Path) -> bool:
    """True if a picture is scene-linear and may hold light above white. Raises FrameError for a damaged TIFF."""
    suffix = path.suffix.lower()
    return suffix == ".exr" or (suffix in {".tif", ".tiff"} and read_stored_pixels(path).dtype.kind == "f")


def has_half_pixels(path: Path) -> bool:
    """True if a picture is stored in 16 bit floats, which only EXRs can be. Raises FrameError."""
    if path.suffix.lower() != ".exr":
        return False
    with open_regular(path) as stream:
        kinds = exr_header.channel_kinds(stream)
    return all(kinds.get(name, exr_header.HALF) == exr_header.HALF for name in "RGBY")


def read_stored_pixels(path: Path) -> NDArray[Any]:
    """Read the pixels of a PNG, JPEG or TIFF, without rotation or multiplication: (height, width) or B G R with alpha
    last.

    Raises FrameError where the file is missing or damaged, or would be decoded as something else.
    """
    import cv2

    width, height = picture_size(path)
    if reason := unsupported_reason(path):
        raise FrameError(f"{path} {reason}.")
    stored = decode(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if stored is None or stored.shape[:2] != (height, width):
        raise FrameError(f"{path} {compression_reason(path) or 'is damaged or truncated; export it again'}.")
    return stored


def decode(path: Path, flags: int) -> NDArray[Any] | None:
    """Decode a file with OpenCV's `flags`, a TIFF as stored; None where it cannot be.

    From memory, since OpenCV's reader cannot open every path that Windows allows.
    """
    import cv2

    with open_regular(path) as stream:
        if png.is_truncated(stream):
            return None
    data = np.frombuffer(read_bytes(path), np.uint8)
    if data[:4].tobytes() in (b"II*\0", b"MM\0*"):
        data = np.frombuffer(tiff.without_reader_changes(data.tobytes()), np.uint8)
    try:
        return cv2.imdecode(data, flags) if data.size else None
    except cv2.error:
        return None
