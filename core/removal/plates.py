# SPDX-License-Identifier: GPL-3.0-or-later
"""Plates: pictures as a shop has them, read and written without loss of depth, channels or colour tags.

A plate keeps its file's own numbers (8 or 16 bit codes, half or full floats), its alpha, an EXR's other
channels and header, and a JPEG's or PNG's colour profile, so that what removal does not touch comes out as
it went in, to the last bit.
"""
from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError
from ..files import atomic_path
from ..pictures import SUFFIXES, Encoding, picture_size

_KEPT_CHUNKS = (b"iCCP", b"gAMA", b"cHRM", b"sRGB", b"pHYs", b"eXIf", b"cICP")


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


def plates_below(folder: Path) -> list[Path]:
    """The pictures in a folder and its folders, but for hidden ones, sorted by name."""
    return [path for path in sorted(folder.rglob("*"))
            if path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith(".")]


def read_plate(path: Path | str) -> Plate:
    """Read PNG, JPEG, TIFF or EXR as it is stored. Floats that are not finite are kept.

    Raises FrameError where the file is missing, damaged, of another kind, or has no colour.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise FrameError(f"{path} is not a picture this program reads; use PNG, JPEG, TIFF or EXR.")
    size = picture_size(path)
    return _read_exr(path) if path.suffix.lower() == ".exr" else _read_codes(path, size)


def _read_codes(path: Path, size: tuple[int, int]) -> Plate:
    import cv2

    try:
        stored = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        stored = None
    if stored is None or stored.shape[1::-1] != size:
        raise FrameError(f"{path} is damaged or truncated; export it again.")
    if stored.dtype not in (np.uint8, np.uint16, np.float32):
        raise FrameError(f"{path} holds {stored.dtype} pixels; save it as 8 or 16 bit or as 32 bit float.")
    grey, alpha = stored.ndim == 2, None
    if grey:
        codes = np.repeat(stored[..., None], 3, axis=2)
    else:
        alpha = stored[..., 3].copy() if stored.shape[2] == 4 else None
        codes = np.ascontiguousarray(stored[..., 2::-1])
    return Plate(path, codes, "linear" if stored.dtype == np.float32 else "srgb", grey, alpha)


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
    if any(channels[name].dtype not in (np.float16, np.float32) or channels[name].shape != channels[names[0]].shape
           for name in names):
        raise FrameError(f"{path} has colour channels that are no floats of one size; export it as half or float.")
    codes = np.stack([np.asarray(channels[name]) for name in (names if len(names) == 3 else names * 3)], -1)
    return Plate(path, codes, "linear", len(names) == 1, None, {"header": header, "channels": channels})


def write_plate(path: Path | str, plate: Plate, codes: NDArray[Any], quality: int = 97) -> None:
    """Write `codes` in the kind and depth of `plate`, with all that belongs to it, to a path of its suffix."""
    path = Path(path)
    if "channels" in plate.rest:
        _write_exr(path, plate, codes)
        return
    import cv2

    stored: NDArray[Any] = codes[..., 0] if plate.grey else codes[..., ::-1]
    if plate.alpha is not None:
        stored = np.concatenate([stored, plate.alpha[..., None]], -1)
    suffix = path.suffix.lower()
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
               cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444] if suffix in (".jpg", ".jpeg") else []
    done, data = cv2.imencode(suffix, np.ascontiguousarray(stored), options)
    if not done:
        raise FrameError(f"{path} could not be encoded as {suffix[1:].upper()}.")
    encoded = data.tobytes()
    if suffix in (".jpg", ".jpeg"):
        encoded = encoded[:2] + b"".join(_jpeg_tags(plate.path)) + encoded[2:]
    elif suffix == ".png":
        kept = b"".join(chunk for name, chunk in _png_chunks(plate.path.read_bytes()) if name in _KEPT_CHUNKS)
        encoded = encoded[:33] + kept + encoded[33:]  # behind the header chunk
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded)


def _write_exr(path: Path, plate: Plate, codes: NDArray[Any]) -> None:
    import OpenEXR

    channels = dict(plate.rest["channels"])
    for index, name in enumerate(["Y"] if plate.grey else ["R", "G", "B"]):
        channels[name] = np.ascontiguousarray(codes[..., index])
    header = {name: value for name, value in plate.rest["header"].items() if name not in ("channels", "chunkCount")}
    header["type"] = OpenEXR.scanlineimage
    header.pop("tiles", None)
    with atomic_path(path) as temporary, OpenEXR.File(header, channels) as file:
        file.write(str(temporary))


def _jpeg_tags(path: Path) -> Iterator[bytes]:
    """The source's EXIF and colour profile segments (APP1, APP2), which say how it is to be shown."""
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        return
    data = path.read_bytes()
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        length = struct.unpack(">H", data[at + 2:at + 4])[0]
        segment = data[at:at + 2 + length]
        if data[at + 1] == 0xDA:
            return
        if data[at + 1] in (0xE1, 0xE2) and segment[4:8] in (b"Exif", b"ICC_"):
            yield segment
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
