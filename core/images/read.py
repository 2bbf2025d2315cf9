# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads picture files: all commands decode pictures here, and convert them from the colours that they declare.

Libraries are imported where they are used, because Blender's own Python has few of them.
"""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colour import ColourSpace, colour_space
from ..colour.srgb import srgb_from_linear
from ..errors import FrameError
from ..system.reading import open_regular, read_bytes
from .declared import declared_space
from .decoders import decode_foreign, file_kind
from .exr import is_exr, main_part, read_exr_parts, rec709_pixels, rgb_channels, window_from_header
from .formats import exr_header, png, tiff
from .listing import SUFFIXES
from .picture import Picture
from .size import picture_size
from .unsupported import needs_openimageio, unsupported_file_error, unsupported_reason
from .window import crop_to_display_window


def read_picture(path: Path | str, *, space: ColourSpace | None = None, over_black: bool = False) -> Picture:
    """Decode a picture of any format (docs/file_formats.md) to display values, or to scene-linear light where its codes
    hold light above white; alpha is dropped.

    over_black: multiply the light by alpha, so that colours that alpha hides do not show.

    The colours are converted to Rec. 709 from `space` or, if that is None, from the space that the file declares
    (profile, curve, primaries). An EXR with more pixels than the frame (overscan), or fewer, is cropped to the frame,
    and black where it has none.

    Raises FrameError where the file is missing, damaged or of another kind, or holds NaN or infinity.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise unsupported_file_error(path)
    if not path.is_file():
        raise FrameError(f"{path} is missing.")
    if is_exr(path):
        return _read_exr_picture(path, space)  # an EXR is premultiplied, so it is over black already
    stored = read_stored_pixels(path)
    picture = _to_picture(path, stored, space)
    if not over_black or stored.ndim == 2 or stored.shape[2] < 4 or tiff.is_premultiplied(path):
        return picture
    alpha = stored[..., 3:].astype(np.float32)
    # Floats hold alpha at 0..1, integers at 0..their greatest value.
    alpha /= np.float32(1 if stored.dtype.kind == "f" else np.iinfo(stored.dtype).max)
    if alpha.min() >= 1:
        return picture
    light = picture.linear() * alpha
    return Picture(srgb_from_linear(light) if picture.encoding == "srgb" else light, picture.encoding)


def _to_picture(path: Path, stored: NDArray[Any], space: ColourSpace | None) -> Picture:
    """Convert the result of `read_stored_pixels` to a picture in Rec. 709, without alpha. space: the colour space of
    the codes; None for the one that the file declares. Raises FrameError."""
    colour = rgb_codes(stored)
    if stored.dtype.kind == "f":
        pixels = colour.astype(np.float32, copy=False)
        if not np.isfinite(pixels).all():
            raise FrameError(f"{path} holds pixels that are not finite numbers; clean it before it is used.")
        return Picture((space or declared_space(path) or colour_space("linear")).to_linear(pixels), "linear")
    if stored.dtype not in (np.uint8, np.uint16):
        raise FrameError(f"{path} holds {stored.dtype} pixels; save it as 8 or 16 bit or as 32 bit float.")
    values = colour.astype(np.float32)
    values /= np.float32(np.iinfo(stored.dtype).max)
    space = space or declared_space(path)
    if space is None or space.name == "srgb":
        return Picture(values, "srgb")
    light = space.to_linear(values)
    return Picture(light, "linear") if space.has_headroom else Picture(np.clip(srgb_from_linear(light), 0, 1), "srgb")


def _read_exr_picture(path: Path, space: ColourSpace | None) -> Picture:
    """Read an EXR as `read_picture` does. Raises FrameError."""
    picture_size(path)
    header, channels = main_part([(part, part[1]) for part in read_exr_parts(path)])
    stored = rgb_channels(path, channels)
    pixels = rec709_pixels(path, stored, header) if space is None else space.to_linear(stored)
    return Picture(crop_to_display_window(pixels, window_from_header(path, header)), "linear")


def rgb_codes(stored: NDArray[Any]) -> NDArray[Any]:
    """Return the colours of `read_stored_pixels` as R G B (height, width, 3), contiguous.

    Uses OpenCV, which takes a fifth of the time of numpy's reversed slices.
    """
    import cv2

    if stored.dtype not in (np.uint8, np.uint16, np.float32):  # OpenCV converts no others, such as half floats
        return np.ascontiguousarray(np.repeat(stored[..., None], 3, axis=2) if stored.ndim == 2 else stored[..., 2::-1])
    if stored.ndim == 2:
        return np.asarray(cv2.cvtColor(stored, cv2.COLOR_GRAY2RGB))
    return np.asarray(cv2.cvtColor(stored, cv2.COLOR_BGRA2RGB if stored.shape[2] == 4 else cv2.COLOR_BGR2RGB))


def has_float_pixels(path: Path, space: ColourSpace | None = None) -> bool:
    """Return whether a picture is scene-linear and may hold light above white, by its pixels or its space (`space`,
    else what it declares). Raises FrameError for a damaged file."""
    if (kind := file_kind(path)) in ("exr", "hdr", "raw"):
        return True
    if kind == "tiff":
        with open_regular(path) as stream:
            is_big = stream.read(4) in tiff.BIG_TIFF
            stream.seek(0)
            formats = tiff.read_tags(stream, (tiff.SAMPLE_FORMAT,)).get(tiff.SAMPLE_FORMAT)
        if formats is not None and formats.values[0] == tiff.FLOATS:
            return True
        # Only decoding shows whether these give floats: LogLuv, for instance, is stored as integers.
        signed = formats is not None and formats.values[0] != tiff.UNSIGNED
        if (is_big or signed) and read_stored_pixels(path).dtype.kind == "f":
            return True
    declared = space or declared_space(path)
    return declared is not None and declared.has_headroom


def has_half_pixels(path: Path) -> bool:
    """Return whether a file is an EXR whose colours are 16 bit floats. Raises FrameError."""
    if not is_exr(path):
        return False
    with open_regular(path) as stream:
        kinds = exr_header.channel_kinds(stream)
    return all(kinds.get(name, exr_header.HALF) == exr_header.HALF for name in "RGBY")


def read_stored_pixels(path: Path) -> NDArray[Any]:
    """Read the pixels of any format but EXR as (height, width), or B G R with alpha last, neither rotated by Exif nor
    multiplied by alpha.

    PNG and usual TIFFs are decoded by OpenCV, faster than OpenImageIO and with the same codes; JPEG by simplejpeg,
    which reports corrupt data; others in `decoders`. Raises FrameError where the file is missing or damaged, or would
    be decoded as something else.
    """
    import cv2

    width, height = picture_size(path)
    if reason := unsupported_reason(path):
        raise FrameError(f"{path} {reason}.")
    kind = file_kind(path)
    if kind == "jpeg":
        stored: NDArray[Any] | None = _decode_jpeg(path)
    elif kind == "tiff" and _is_corrupt_tiff(path):
        stored = None
    elif kind == "png" or (kind == "tiff" and not needs_openimageio(path)):
        stored = decode_by_opencv(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    else:
        stored = decode_foreign(path, kind)
    if stored is None or stored.shape[:2] != (height, width):
        raise FrameError(f"{path} is damaged or truncated; export it again.")
    return stored


def _is_corrupt_tiff(path: Path) -> bool:
    with open_regular(path) as stream:
        return tiff.has_corrupt_data(stream)


def _decode_jpeg(path: Path) -> NDArray[Any]:
    """Decode a JPEG to 8 bit codes: grey (height, width), or B G R (height, width, 3).

    Raises FrameError if the data end early or are corrupt; OpenCV and OpenImageIO would fill in grey areas.
    """
    import simplejpeg

    data = read_bytes(path)
    try:
        is_grey = simplejpeg.decode_jpeg_header(data)[2] == "Gray"
        pixels = simplejpeg.decode_jpeg(data, "GRAY" if is_grey else "BGR", strict=True)
    except ValueError as problem:
        raise FrameError(f"{path} is damaged or truncated ({problem}); export it again.") from problem
    return pixels[..., 0] if is_grey else pixels


def decode_by_opencv(path: Path, flags: int) -> NDArray[Any] | None:
    """Decode a file with OpenCV's `flags`, a TIFF as stored; None where OpenCV cannot decode it.

    The file is read first and decoded from memory, since OpenCV cannot open every path that Windows allows.
    """
    import cv2

    data = read_bytes(path)
    if png.is_truncated(data):
        return None
    if data[:4] in (b"II*\0", b"MM\0*"):
        data = tiff.without_reader_changes(data)
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        return None
