# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes plates: picture files as delivered, without loss of depth, channels or colour tags.

A plate keeps its file's code values (8 or 16 bit, half or full floats), its alpha, an EXR's other channels and header,
and the colour profile and tags of other files. Pixels that removal or transfer does not touch are written back to the
last bit; an unchanged plate is copied.
"""
from __future__ import annotations

import io
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colour import ColourSpace, colour_space, space_of_chromaticities
from ..colour.srgb import LUMINANCE, srgb_from_linear
from ..errors import FrameError, is_out_of_memory
from ..system.files import atomic_path
from ..system.reading import open_regular, read_bytes
from .borders import PictureArea, find_picture_area
from .exr import missing_rgb, read_exr_parts
from .formats import jpeg, png, tiff
from .listing import SUFFIXES
from .picture import Encoding
from .read import read_stored_pixels
from .size import picture_size
from .unsupported import unsupported_file
from .write import save_exr, write_exr

_KEPT_CHUNKS = (b"iCCP", b"gAMA", b"cHRM", b"sRGB", b"pHYs", png.EXIF, b"cICP", b"tEXt", b"zTXt", b"iTXt")
_KEPT_SEGMENTS = ((jpeg.APP1, b"Exif"), (jpeg.APP1, b"http"), (jpeg.APP2, b"ICC_"))
"""JPEG segments that are kept; XMP is found by the address of its name space."""
_KEPT_TAGS = (tiff.ORIENTATION, tiff.EXTRA_SAMPLES, tiff.X_RESOLUTION, tiff.Y_RESOLUTION, tiff.RESOLUTION_UNIT,
              tiff.XMP, tiff.COLOUR_PROFILE)
_PLACEMENT = ("chromaticities", "dataWindow", "displayWindow", "pixelAspectRatio")
_JPEG_QUALITY = 97
_JPEGS, _TIFFS = (".jpg", ".jpeg"), (".tif", ".tiff")
_DEPTHS: dict[str, tuple[type, ...]] = {".png": (np.uint8, np.uint16), **dict.fromkeys(_JPEGS, (np.uint8,))}
"""Pixel types by suffix, for formats that cannot hold every plate; OpenCV would convert others to 8 bit silently."""


@dataclass
class Plate:
    """A picture file with its code values.

    codes: (height, width, 3), the file's type, R G B; a grey file has three equal channels. encoding: "srgb" for
    integer codes, "linear" for floats. extras: an EXR's header and other channels, written back unchanged.
    """

    path: Path
    codes: NDArray[Any]
    encoding: Encoding
    grey: bool = False
    alpha: NDArray[Any] | None = None
    extras: dict[str, Any] = field(default_factory=dict)

    @property
    def max_code(self) -> float:
        """The code value of white, 1."""
        return float(np.iinfo(self.codes.dtype).max) if self.codes.dtype.kind == "u" else 1.0

    @property
    def values(self) -> NDArray[np.float32]:
        """(height, width, 3) codes as 0..1, in the plate's colour space."""
        return self.codes.astype(np.float32) / np.float32(self.max_code)

    def to_plate_channels(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return linear light (height, width, 3) as the plate can show it: its luminance where the plate is grey."""
        return np.repeat(light @ LUMINANCE.astype(np.float32)[:, None], 3, -1) if self.grey else light

    @cached_property
    def picture_area(self) -> PictureArea:
        """The area inside its black borders."""
        if self.encoding == "srgb":
            return find_picture_area(self.codes, lambda line: line / self.max_code)
        return find_picture_area(self.codes, lambda line: srgb_from_linear(
            np.clip(np.nan_to_num(line.astype(np.float32), nan=1.0), 0, 1)))

    @property
    def straight_alpha(self) -> NDArray[np.float32] | None:
        """(height, width), 0..1: alpha that the codes are not multiplied with; None where there is none such."""
        if self.alpha is None or tiff.is_premultiplied(self.path):
            return None
        return self.alpha.astype(np.float32) / np.float32(self.max_code)

    @property
    def space(self) -> ColourSpace:
        """The colour space of the codes: sRGB for integers; linear for floats, in an EXR's chromaticities where it has
        some.

        Raises SettingsError where those span no space.
        """
        if self.encoding == "srgb":
            return colour_space("srgb")
        chromaticities = self.placement.get("chromaticities")
        return space_of_chromaticities(tuple(chromaticities)) if chromaticities is not None else colour_space("linear")

    @property
    def placement(self) -> dict[str, Any]:
        """Header attributes that give another EXR this one's windows and colours."""
        header = self.extras.get("header", {})
        return {name: header[name] for name in _PLACEMENT if name in header}


def is_plate_error(problem: Exception) -> bool:
    """True if the plate causes the error, so that others may work: it is damaged, unreadable, or too large for the
    memory.

    Any other exception is a defect.
    """
    return isinstance(problem, FrameError | OSError) or is_out_of_memory(problem)


def finite_light(codes: NDArray[Any]) -> NDArray[np.float32]:
    """Return float codes as finite linear light: NaN is black, infinity the greatest half."""
    return np.nan_to_num(codes.astype(np.float32), nan=0.0, posinf=65504.0, neginf=0.0)


def read_plate(path: Path | str) -> Plate:
    """Read PNG, JPEG, TIFF or EXR as stored. NaN and infinity are kept.

    Raises FrameError where the file is missing, damaged, of another kind, or has no colour.
    """
    path = Path(path)
    if not path.exists():
        raise FrameError(f"{path} is missing{': it is a link that leads nowhere' if path.is_symlink() else ''}.")
    if path.suffix.lower() not in SUFFIXES:
        raise unsupported_file(path)
    picture_size(path)
    return _read_exr(path) if path.suffix.lower() == ".exr" else _read_codes(path)


def _read_codes(path: Path) -> Plate:
    with open_regular(path) as stream:
        pages = tiff.page_count(stream)
    if pages > 1:
        raise FrameError(f"{path} has {pages} pages; export the plate as a file of its own.")
    stored = read_stored_pixels(path)
    if stored.dtype not in (np.uint8, np.uint16, np.float32):
        raise FrameError(f"{path} holds {stored.dtype} pixels; save it as 8 or 16 bit or as 32 bit float.")
    if _is_animated(path):
        raise FrameError(f"{path} is an animated PNG; export its frames as files of their own.")
    grey, alpha = stored.ndim == 2 or _is_grey_with_alpha(path), None
    if stored.ndim == 2:
        codes, alpha = np.repeat(stored[..., None], 3, axis=2), _transparency(path, stored)
    else:
        alpha = stored[..., 3].copy() if stored.shape[2] == 4 else None
        codes = np.ascontiguousarray(stored[..., 2::-1])
    return Plate(path, codes, "linear" if stored.dtype == np.float32 else "srgb", grey, alpha)


def _is_grey_with_alpha(path: Path) -> bool:
    """True for a PNG of colour type 4 (PNG specification, 11.2.1), which OpenCV reads as colour."""
    with open_regular(path) as stream:
        header = stream.read(26)
    return header[:4] == b"\x89PNG" and header[25:] == b"\x04"


def _is_animated(path: Path) -> bool:
    """True for a PNG of several frames (PNG specification, third edition, 11.3.6.1), of which OpenCV reads the first.
    """
    with open_regular(path) as stream:
        return any(int.from_bytes(content[:4], "big") > 1 for _, content in png.chunks(stream, (b"acTL",)))


def _transparency(path: Path, stored: NDArray[Any]) -> NDArray[Any] | None:
    """Return alpha (height, width) of a grey PNG with one transparent code (PNG specification, 11.3.2.1), or None.

    OpenCV reads such files without it.
    """
    with open_regular(path) as stream:
        depth = stream.read(25)[24:]
        key = next((content for _, content in png.chunks(stream, (b"tRNS",)) if len(content) == 2), None)
    if key is None:
        return None
    top = np.iinfo(stored.dtype).max
    code = int.from_bytes(key, "big") * top // (2 ** depth[0] - 1)  # depths below 8 bits are spread over all codes
    return np.where(stored == code, 0, top).astype(stored.dtype)


def _read_exr(path: Path) -> Plate:
    parts = read_exr_parts(path)
    header, channels = parts[0]
    if len(parts) > 1:
        raise FrameError(f"{path} has {len(parts)} parts; export the plate as a file of its own.")
    names = ["R", "G", "B"] if all(name in channels for name in "RGB") else ["Y"] if "Y" in channels else []
    if not names:
        raise missing_rgb(path, channels)
    if any(channels[name].dtype not in (np.float16, np.float32) for name in names):
        raise FrameError(f"{path} has colour channels that are no floats; export it as half or float.")
    if len({channel.shape for channel in channels.values()}) > 1:
        raise FrameError(f"{path} has channels of several sizes (luminance and chroma, say); export it as R, G, B.")
    codes = np.stack([np.asarray(channels[name]) for name in (names if len(names) == 3 else names * 3)], -1)
    return Plate(path, codes, "linear", len(names) == 1, None, {"header": header, "channels": channels})


def write_plate(path: Path | str, plate: Plate, codes: NDArray[Any], alpha: NDArray[Any] | None = None) -> None:
    """Write `codes` in the format and depth of `plate`, with its alpha, channels and tags, to a path of its suffix.

    alpha: as stored, in place of the plate's.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    is_same_alpha = alpha is None or plate.alpha is None or np.array_equal(alpha, plate.alpha)
    if is_same_alpha and suffix == plate.path.suffix.lower() and np.array_equal(codes, plate.codes, equal_nan=True):
        with atomic_path(path) as temporary:
            shutil.copyfile(plate.path, temporary)
        return
    if "channels" in plate.extras:
        _write_exr(path, plate, codes)
        return
    if alpha is not None:
        plate = replace(plate, alpha=alpha)
    if codes.dtype not in _DEPTHS.get(suffix, (codes.dtype,)) or (suffix in _JPEGS and plate.alpha is not None):
        raise FrameError(f"{plate.path} holds what no {suffix[1:].upper()} can hold ({codes.dtype} pixels"
                         f"{', alpha' if plate.alpha is not None else ''}): it has the suffix of another kind of file; "
                         "rename it to what it is.")
    import cv2

    stored: NDArray[Any] = codes[..., 0] if plate.grey and plate.alpha is None else codes[..., ::-1]
    if plate.alpha is not None:
        stored = np.concatenate([stored, plate.alpha[..., None]], -1)
    done, data = cv2.imencode(suffix, np.ascontiguousarray(stored), _encoder_options(suffix, codes.dtype))
    if not done:
        raise FrameError(f"{path} could not be encoded as {suffix[1:].upper()}.")
    with atomic_path(path) as temporary:
        temporary.write_bytes(_copy_tags(data.tobytes(), suffix, plate))


def _encoder_options(suffix: str, kind: np.dtype[Any]) -> list[int]:
    """Return OpenCV's options for pixels of this type."""
    import cv2

    if suffix in _JPEGS:
        return [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
                cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    if suffix in _TIFFS and kind.kind == "f":  # else LogLuv, 16 bits for three floats
        return [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_NONE]
    return []


def write_flare(path: Path | str, plate: Plate, flare: NDArray[Any]) -> None:
    """Write the flare removed from a plate, light (height, width, 3) in its colours, as an EXR with its windows."""
    write_exr(path, {name: flare[..., k] for k, name in enumerate("RGB")}, header=plate.placement)


def write_results(results: Sequence[Path], plate: Plate, codes: NDArray[Any], flare: NDArray[Any]) -> None:
    """Write the clean plate, and the flare if `results` has a second path."""
    write_plate(results[0], plate, codes)
    for result in results[1:]:
        write_flare(result, plate, flare)


def _copy_tags(encoded: bytes, suffix: str, plate: Plate) -> bytes:
    """Return the encoded file with the tags of the plate's file, where both are of one format."""
    source = plate.path.suffix.lower()
    if suffix in _JPEGS and source in _JPEGS:
        return encoded[:2] + b"".join(_jpeg_tags(plate.path)) + encoded[2:]
    if suffix == source == ".png":
        data = read_bytes(plate.path)
        was_grey, is_grey = (not header[25] & 2 for header in (data, encoded))
        left_out = (b"iCCP",) if was_grey != is_grey else ()
        chunks = b"".join(png.make_chunk(name, content) for name, content in png.chunks(io.BytesIO(data), _KEPT_CHUNKS)
                        if name not in left_out)
        return encoded[:33] + chunks + encoded[33:]  # behind the header chunk
    if suffix in _TIFFS and source in _TIFFS:
        tags = tiff.read_tags(io.BytesIO(read_bytes(plate.path)), _KEPT_TAGS)
        if plate.alpha is None:
            tags.pop(tiff.EXTRA_SAMPLES, None)
        return tiff.with_tags(encoded, tags)
    return encoded


def _write_exr(path: Path, plate: Plate, codes: NDArray[Any]) -> None:
    import OpenEXR

    channels = dict(plate.extras["channels"])
    for index, name in enumerate(["Y"] if plate.grey else ["R", "G", "B"]):
        channels[name] = np.ascontiguousarray(codes[..., index], channels[name].dtype)  # channels may differ in depth
    header = {name: value for name, value in plate.extras["header"].items() if name not in ("channels", "chunkCount")}
    header["type"] = OpenEXR.scanlineimage
    header.pop("tiles", None)
    if header.get("lineOrder") == OpenEXR.RANDOM_Y:  # tiles in the order of rendering
        header["lineOrder"] = OpenEXR.INCREASING_Y
    if header.get("compression") in (OpenEXR.B44_COMPRESSION, OpenEXR.B44A_COMPRESSION, OpenEXR.DWAA_COMPRESSION,
                                     OpenEXR.DWAB_COMPRESSION):  # lossy
        header["compression"] = OpenEXR.ZIP_COMPRESSION
    save_exr(path, header, channels)


def _jpeg_tags(path: Path) -> Iterator[bytes]:
    """Yield the source's EXIF, XMP and colour profile segments."""
    with open_regular(path) as stream:
        for marker, content in jpeg.segments(stream):
            if (marker, content[:4]) in _KEPT_SEGMENTS:
                yield jpeg.make_segment(marker, content)
