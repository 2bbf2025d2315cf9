# SPDX-License-Identifier: GPL-3.0-or-later
"""Plates: pictures as a shop has them, read and written without loss of depth, channels or colour tags.

A plate keeps its file's own numbers (8 or 16 bit codes, half or full floats), its alpha, an EXR's other
channels and header, and the colour profile and tags of other files, so that what removal does not touch comes out as
it went in, to the last bit. A plate that it does not touch at all is copied.
"""
from __future__ import annotations

import io
import shutil
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import tiff
from ..colour import ColourSpace, colour_space, space_of_chromaticities
from ..errors import FrameError
from ..files import atomic_path
from ..pictures import SUFFIXES, Encoding, picture_size, save_exr, stored_pixels

_KEPT_CHUNKS = (b"iCCP", b"gAMA", b"cHRM", b"sRGB", b"pHYs", b"eXIf", b"cICP")
_KEPT_TAGS = (tiff.ORIENTATION, tiff.EXTRA_SAMPLES, tiff.X_RESOLUTION, tiff.Y_RESOLUTION, tiff.RESOLUTION_UNIT,
              tiff.XMP, tiff.COLOUR_PROFILE)
_PLACING = ("chromaticities", "dataWindow", "displayWindow", "pixelAspectRatio")
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEGS, _TIFFS = (".jpg", ".jpeg"), (".tif", ".tiff")


@dataclass
class Plate:
    """codes: (height, width, 3), the file's own type, R G B; a grey file has three equal channels.

    `encoding` says what they mean: "srgb" for integer codes, "linear" for floats. `rest` is what belongs to
    the file and is written again untouched.
    """

    path: Path
    codes: NDArray[Any]
    encoding: Encoding
    grey: bool = False
    alpha: NDArray[Any] | None = None
    rest: dict[str, Any] = field(default_factory=dict)

    @property
    def top(self) -> float:
        """The code that means 1."""
        return float(np.iinfo(self.codes.dtype).max) if self.codes.dtype.kind == "u" else 1.0

    @property
    def space(self) -> ColourSpace:
        """What the codes are: sRGB where they are integers; linear, in an EXR's own primaries where it names some.

        Raises SettingsError where those span no space."""
        if self.encoding == "srgb":
            return colour_space("srgb")
        told = self.placing.get("chromaticities")
        return space_of_chromaticities(tuple(told)) if told is not None else colour_space("linear")

    @property
    def placing(self) -> dict[str, Any]:
        """What the header of another EXR has to say to lie where this one does, in its colours."""
        header = self.rest.get("header", {})
        return {name: header[name] for name in _PLACING if name in header}


def plates_below(folder: Path) -> list[Path]:
    """The pictures in a folder and its folders, but for hidden ones, sorted by name."""
    return [path for path in sorted(folder.rglob("*")) if path.suffix.lower() in SUFFIXES and path.is_file()
            and not any(part.startswith(".") for part in path.relative_to(folder).parts)]


def read_plate(path: Path | str) -> Plate:
    """Read PNG, JPEG, TIFF or EXR as it is stored. Floats that are not finite are kept.

    Raises FrameError where the file is missing, damaged, of another kind, or has no colour.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise FrameError(f"{path} is not a picture this program reads; use PNG, JPEG, TIFF or EXR.")
    picture_size(path)
    return _read_exr(path) if path.suffix.lower() == ".exr" else _read_codes(path)


def _read_codes(path: Path) -> Plate:
    _check_is_one_colour_picture(path)
    stored = stored_pixels(path)
    if stored.dtype not in (np.uint8, np.uint16, np.float32):
        raise FrameError(f"{path} holds {stored.dtype} pixels; save it as 8 or 16 bit or as 32 bit float.")
    grey, alpha = stored.ndim == 2, None
    if grey:
        codes = np.repeat(stored[..., None], 3, axis=2)
    else:
        alpha = stored[..., 3].copy() if stored.shape[2] == 4 else None
        codes = np.ascontiguousarray(stored[..., 2::-1])
    return Plate(path, codes, "linear" if stored.dtype == np.float32 else "srgb", grey, alpha)


def _check_is_one_colour_picture(path: Path) -> None:
    """Raises FrameError for what OpenCV would read without a word as something else."""
    with open(path, "rb") as stream:
        samples = 0
        if path.suffix.lower() in _JPEGS:
            frames = (segment for marker, segment in _jpeg_segments(stream.read()) if marker in _JPEG_FRAMES)
            samples = next((segment[9] for segment in frames), 0)
        elif path.suffix.lower() in _TIFFS:
            pages = tiff.page_count(stream)
            if pages > 1:
                raise FrameError(f"{path} has {pages} pages; export the plate as a file of its own.")
            told = tiff.read_tags(stream, (tiff.SAMPLES, tiff.PHOTOMETRIC))
            if tiff.SAMPLES in told and int(told[tiff.SAMPLES].values[0]) == 2:
                raise FrameError(f"{path} is grey with alpha; save it as RGB with alpha, or as PNG.")
            if tiff.PHOTOMETRIC in told and int(told[tiff.PHOTOMETRIC].values[0]) == tiff.SEPARATED:
                samples = 4
    if samples == 4:
        raise FrameError(f"{path} is CMYK, for print; convert it to RGB.")


def _read_exr(path: Path) -> Plate:
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = [(dict(part.header), {name: channel.pixels for name, channel in part.channels.items()})
                     for part in file.parts]
    except Exception as problem:  # the library raises bare RuntimeError and worse for damaged files
        raise FrameError(f"{path} is damaged or truncated ({problem}); export it again.") from problem
    header, channels = parts[0]
    if len(parts) > 1:
        raise FrameError(f"{path} has {len(parts)} parts; export the plate as a file of its own.")
    names = ["R", "G", "B"] if all(name in channels for name in "RGB") else ["Y"] if "Y" in channels else []
    if not names:
        raise FrameError(f"{path} has no R, G, B channels at its root (it has {', '.join(sorted(channels))}).")
    if any(channels[name].dtype not in (np.float16, np.float32) for name in names):
        raise FrameError(f"{path} has colour channels that are no floats; export it as half or float.")
    if len({channel.shape for channel in channels.values()}) > 1:
        raise FrameError(f"{path} has channels of several sizes (luminance and chroma, say); export it as R, G, B.")
    codes = np.stack([np.asarray(channels[name]) for name in (names if len(names) == 3 else names * 3)], -1)
    return Plate(path, codes, "linear", len(names) == 1, None, {"header": header, "channels": channels})


def write_plate(path: Path | str, plate: Plate, codes: NDArray[Any], quality: int = 97) -> None:
    """Write `codes` in the kind and depth of `plate`, with all that belongs to it, to a path of its suffix."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == plate.path.suffix.lower() and np.array_equal(codes, plate.codes, equal_nan=True):
        with atomic_path(path) as temporary:
            shutil.copyfile(plate.path, temporary)
        return
    if "channels" in plate.rest:
        _write_exr(path, plate, codes)
        return
    import cv2

    stored: NDArray[Any] = codes[..., 0] if plate.grey else codes[..., ::-1]
    if plate.alpha is not None:
        stored = np.concatenate([stored, plate.alpha[..., None]], -1)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
               cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444] if suffix in _JPEGS else []
    done, data = cv2.imencode(suffix, np.ascontiguousarray(stored), options)
    if not done:
        raise FrameError(f"{path} could not be encoded as {suffix[1:].upper()}.")
    with atomic_path(path) as temporary:
        temporary.write_bytes(_tagged(data.tobytes(), suffix, plate))


def _tagged(encoded: bytes, suffix: str, plate: Plate) -> bytes:
    """With what the plate's file says about how it is to be shown, where both are of one kind."""
    source = plate.path.suffix.lower()
    if suffix in _JPEGS and source in _JPEGS:
        return encoded[:2] + b"".join(_jpeg_tags(plate.path)) + encoded[2:]
    if suffix == source == ".png":
        data = plate.path.read_bytes()
        was_grey, is_grey = (not header[25] & 2 for header in (data, encoded))
        left_out = (b"iCCP",) if was_grey != is_grey else ()
        kept = b"".join(chunk for name, chunk in _png_chunks(data) if name in _KEPT_CHUNKS and name not in left_out)
        return encoded[:33] + kept + encoded[33:]  # behind the header chunk
    if suffix in _TIFFS and source in _TIFFS:
        tags = tiff.read_tags(io.BytesIO(plate.path.read_bytes()), _KEPT_TAGS)
        if plate.alpha is None:
            tags.pop(tiff.EXTRA_SAMPLES, None)
        return tiff.with_tags(encoded, tags)
    return encoded


def _write_exr(path: Path, plate: Plate, codes: NDArray[Any]) -> None:
    import OpenEXR

    channels = dict(plate.rest["channels"])
    for index, name in enumerate(["Y"] if plate.grey else ["R", "G", "B"]):
        channels[name] = np.ascontiguousarray(codes[..., index])
    header = {name: value for name, value in plate.rest["header"].items() if name not in ("channels", "chunkCount")}
    header["type"] = OpenEXR.scanlineimage
    header.pop("tiles", None)
    save_exr(path, header, channels)


def _jpeg_tags(path: Path) -> Iterator[bytes]:
    """The source's EXIF and colour profile segments (APP1, APP2), which say how it is to be shown."""
    for marker, segment in _jpeg_segments(path.read_bytes()):
        if marker in (0xE1, 0xE2) and segment[4:8] in (b"Exif", b"ICC_"):
            yield segment


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(marker, whole segment) of a JPEG before its pixels."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        if data[at + 1] == 0xFF:  # a fill byte
            at += 1
            continue
        length = struct.unpack(">H", data[at + 2:at + 4])[0]
        yield data[at + 1], data[at:at + 2 + length]
        at += 2 + length


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """(name, whole chunk) of a PNG, damaged ones left out."""
    at = 8
    while data[:8] == b"\x89PNG\r\n\x1a\n" and at + 12 <= len(data):
        length = struct.unpack(">I", data[at:at + 4])[0]
        chunk = data[at:at + 12 + length]
        if len(chunk) == 12 + length and zlib.crc32(chunk[4:-4]) == struct.unpack(">I", chunk[-4:])[0]:
            yield chunk[4:8], chunk
        at += 12 + length
