# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads picture files: the one door through which commands decode PNG, JPEG, TIFF and EXR.

OpenCV is imported where it is used, because Blender's own Python has none.
"""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError
from .exr import exr_parts, main_part, rec709_pixels, rgb_channels, window_from_header
from .formats import exr_header, png, tiff
from .listing import SUFFIXES
from .picture import Picture
from .size import picture_size
from .unsupported import compression_reason, unsupported_file, unsupported_reason
from .window import crop_to_display_window


def read_picture(path: Path | str, *, own_primaries: bool = False) -> Picture:
    """Decode PNG, JPEG, TIFF (8 or 16 bit, grey or colour, alpha dropped) or EXR.

    An EXR whose `chromaticities` say another space than Rec. 709 (ACEScg, say) is converted, unless it is to keep its
    own primaries, and one that has more pixels than the frame (overscan), or fewer, is cut to the frame, and black
    where it has none.

    Raises FrameError where the file is missing, damaged or of another kind, or holds NaN or infinity.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise unsupported_file(path)
    if not path.is_file():
        raise FrameError(f"{path} is missing.")
    if path.suffix.lower() == ".exr":
        picture_size(path)
        header, channels = main_part([(part, part[1]) for part in exr_parts(path)])
        stored = rgb_channels(path, channels)
        pixels = stored if own_primaries else rec709_pixels(path, stored, header)
        return Picture(crop_to_display_window(pixels, window_from_header(path, header)), "linear")
    stored = stored_pixels(path)
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


def holds_floats(path: Path) -> bool:
    """Whether a picture is scene-linear, and may hold light above white. Raises FrameError for a TIFF that is damaged:
    only its pixels tell."""
    suffix = path.suffix.lower()
    return suffix == ".exr" or (suffix in {".tif", ".tiff"} and stored_pixels(path).dtype.kind == "f")


def holds_halves(path: Path) -> bool:
    """Whether a picture's light is stored in 16 bit floats, as only EXRs have it. Raises FrameError."""
    if path.suffix.lower() != ".exr":
        return False
    with open(path, "rb") as stream:
        kinds = exr_header.channel_kinds(stream)
    return all(kinds.get(name, exr_header.HALF) == exr_header.HALF for name in "RGBY")


def stored_pixels(path: Path) -> NDArray[Any]:
    """What a PNG, JPEG or TIFF holds, turned and multiplied with nothing: (height, width) or with the channels B G R
    and alpha behind. Raises FrameError where it is missing or damaged, or would be read as something else."""
    import cv2

    width, height = picture_size(path)
    if reason := unsupported_reason(path):
        raise FrameError(f"{path} {reason}.")
    stored = decoded(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if stored is None or stored.shape[:2] != (height, width):
        raise FrameError(f"{path} {compression_reason(path) or 'is damaged or truncated; export it again'}.")
    return stored


def decoded(path: Path, flags: int) -> NDArray[Any] | None:
    """What OpenCV makes of a file by its `flags`, of a TIFF as it is stored; None where that is nothing. From memory,
    since its own reader cannot open every path that Windows allows."""
    import cv2

    with open(path, "rb") as stream:
        if png.is_cut_off(stream):
            return None
    data = np.fromfile(path, np.uint8)
    if data[:4].tobytes() in (b"II*\0", b"MM\0*"):
        data = np.frombuffer(tiff.as_stored(data.tobytes()), np.uint8)
    try:
        return cv2.imdecode(data, flags) if data.size else None
    except cv2.error:
        return None
