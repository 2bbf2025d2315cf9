# SPDX-License-Identifier: GPL-3.0-or-later
"""Pictures: read, written, and moved between display and scene-linear light.

Core works on float32, height x width x 3, row 0 on top. A picture carries its encoding: "srgb" for 8
and 16 bit files (display values 0..1, IEC 61966-2-1) and "linear" for EXR (scene-linear Rec. 709, any
value). OpenCV and OpenEXR are imported where they are used, so that Blender's own Python, which has
neither, can import this module.
"""
from __future__ import annotations

import errno
import os
from collections.abc import Container, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from . import exr, jpeg, png, tiff
from .errors import FrameError
from .files import atomic_path
from .typed import is_utf8
from .video import is_video

if TYPE_CHECKING:
    from .colour import Chromaticities

Encoding = Literal["srgb", "linear"]
Pixels = NDArray[np.float32]

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr"})
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear Rec. 709 channels."""
LARGEST = 500_000_000  # pixels; a header that claims more is damaged or hostile


@dataclass(frozen=True)
class Picture:
    """Pixels (height, width, 3) float32 and how they are encoded."""

    pixels: Pixels
    encoding: Encoding

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def display(self, white: float = 1.0) -> Pixels:
        """sRGB display values, clipped to 0..white: as a screen clips, or farther up."""
        pixels = srgb_from_linear(self.pixels) if self.encoding == "linear" else self.pixels
        return np.clip(pixels, 0.0, white)

    def linear(self) -> Pixels:
        """Scene-linear Rec. 709 values."""
        return linear_from_srgb(self.pixels) if self.encoding == "srgb" else self.pixels

    def resized(self, width: int, height: int) -> Picture:
        """This picture at another size. It shrinks by the average over areas, of light, as a coarser sensor would have
        seen it; it grows bicubically."""
        if (width, height) == self.size:
            return self
        import cv2

        if width > self.size[0] or height > self.size[1]:
            grown = cv2.resize(self.pixels, (width, height), interpolation=cv2.INTER_CUBIC)
            return Picture(np.asarray(grown, np.float32), self.encoding)
        light = np.asarray(cv2.resize(self.linear(), (width, height), interpolation=cv2.INTER_AREA), np.float32)
        return Picture(srgb_from_linear(light) if self.encoding == "srgb" else light, self.encoding)


def srgb_from_linear(linear: NDArray[Any]) -> Pixels:
    """IEC 61966-2-1 encoding, continued unclipped above 1 and mirrored below 0."""
    size = np.abs(np.asarray(linear, np.float32))
    curve = 1.055 * np.power(np.maximum(size, 0.0031308), np.float32(1 / 2.4)) - 0.055
    return np.copysign(np.where(size <= 0.0031308, 12.92 * size, curve), linear).astype(np.float32)


def linear_from_srgb(display: NDArray[Any]) -> Pixels:
    """The inverse of `srgb_from_linear`."""
    size = np.abs(np.asarray(display, np.float32))
    curve = np.power((np.maximum(size, 0.04045) + 0.055) / 1.055, np.float32(2.4))
    return np.copysign(np.where(size <= 0.04045, size / 12.92, curve), display).astype(np.float32)


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder by name, but for hidden ones: macOS keeps "._0001.png" beside 0001.png on foreign
    disks."""
    return sorted(path for path in folder.iterdir()
                  if path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith("."))


def pictures_below(folder: Path) -> list[Path]:
    """The pictures in a folder and its folders, but for hidden ones, sorted by name. Links that lead nowhere are among
    them, to be told by whoever reads them: the disk that they lead to may be away."""
    return [path for path in sorted(folder.rglob("*"))
            if path.suffix.lower() in SUFFIXES and (path.is_file() or (path.is_symlink() and not path.exists()))
            and not any(part.startswith(".") for part in path.relative_to(folder).parts)]


def are_one_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether one size (width, height) is the other, scaled and rounded to whole pixels."""
    small, large = sorted((size, other))
    scale = max(large[0] / small[0], large[1] / small[1])
    return (abs(large[0] - small[0] * scale) <= max(scale, 1.0) + 1e-9
            and abs(large[1] - small[1] * scale) <= max(scale, 1.0) + 1e-9)


def no_rgb(path: Path, channels: Iterable[str]) -> FrameError:
    """Of an EXR that has other channels alone."""
    return FrameError(f"{path} has no R, G, B channels at its root (it has {', '.join(sorted(channels))}); export the "
                      "picture under those names.")


def no_picture(path: Path) -> FrameError:
    """Of a file of another kind, by its name."""
    if is_video(path):
        return FrameError(f"{path} is a video; take its frames out first, as by `ffmpeg -i {path.name} "
                          "frames/%06d.png`, and give their folder.")
    return FrameError(f"{path} is not a picture this program reads; use PNG, JPEG, TIFF or EXR.")


def read_picture(path: Path | str, *, own_primaries: bool = False) -> Picture:
    """Decode PNG, JPEG, TIFF (8 or 16 bit, grey or colour, alpha dropped) or EXR.

    An EXR whose `chromaticities` say another space than Rec. 709 (ACEScg, say) is converted, unless it is to keep its
    own primaries, and one that has more pixels than the frame (overscan), or fewer, is cut to the frame, and black
    where it has none.

    Raises FrameError where the file is missing, damaged or of another kind, or holds NaN or infinity.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise no_picture(path)
    if not path.is_file():
        raise FrameError(f"{path} is missing.")
    if path.suffix.lower() == ".exr":
        picture_size(path)
        header, channels = _of_the_picture([(part, part[1]) for part in exr_parts(path)])
        stored = _rgb_from_channels(path, channels)
        pixels = stored if own_primaries else _rec709(path, stored, header)
        return Picture(framed(pixels, _window(path, header)), "linear")
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
        kinds = exr.channel_kinds(stream)
    return all(kinds.get(name, exr.HALF) == exr.HALF for name in "RGBY")


def stored_pixels(path: Path) -> NDArray[Any]:
    """What a PNG, JPEG or TIFF holds, turned and multiplied with nothing: (height, width) or with the channels B G R
    and alpha behind. Raises FrameError where it is missing or damaged, or would be read as something else."""
    import cv2

    width, height = picture_size(path)
    if misread := _misread(path):
        raise FrameError(f"{path} {misread}.")
    stored = decoded(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if stored is None or stored.shape[:2] != (height, width):
        raise FrameError(f"{path} {_unread(path) or 'is damaged or truncated; export it again'}.")
    return stored


def _unread(path: Path) -> str:
    """How a TIFF that OpenCV cannot read is compressed, and what to do; "" where it reads such ones, if they are
    whole."""
    with open(path, "rb") as stream:
        told = tiff.whole_numbers(tiff.read_tags(stream, (tiff.COMPRESSION,)))
    found = tiff.SELDOM_READ.get(told.get(tiff.COMPRESSION, 0))
    return f"is compressed by {found}, which this program does not read; save it with LZW, ZIP or none" if found else ""


_CMYK = "is CMYK, for print; convert it to RGB"


def _misread(path: Path) -> str:
    """What OpenCV would read without a word as something else, or not though it is whole, and what to do; "" where
    there is no such thing."""
    with open(path, "rb") as stream:
        begins = stream.read(4)
        stream.seek(0)
        if begins[:2] == b"\xff\xd8":  # whatever it is named
            header = jpeg.frame_header(stream)
            if header is not None and header.bits > 8:
                return f"holds {header.bits} bits a colour; save it with 8, or as PNG or TIFF with 16"
            return _CMYK if header is not None and header.components == 4 else ""
        if begins not in (b"II*\0", b"MM\0*"):
            return ""
        wanted = (tiff.BITS, tiff.PHOTOMETRIC, tiff.SAMPLES, tiff.PLANES, tiff.SAMPLE_FORMAT)
        told = {name: tag.values[0] for name, tag in tiff.read_tags(stream, wanted).items()}
    if told.get(tiff.SAMPLES) == 2:
        return "is grey with alpha; save it as RGB with alpha, or as PNG"
    if told.get(tiff.PHOTOMETRIC) == tiff.SEPARATED:
        return _CMYK
    if told.get(tiff.PHOTOMETRIC) in tiff.LAB:
        return "is in Lab colours; convert it to RGB"
    if told.get(tiff.SAMPLES, 1) > 4:
        return f"has {told[tiff.SAMPLES]} channels; save it as RGB, or RGB with alpha"
    numbers = told.get(tiff.BITS, 1), told.get(tiff.SAMPLE_FORMAT, tiff.WHOLE)
    if numbers in ((16, tiff.FLOATS), (32, tiff.WHOLE)):
        kind = "floats" if numbers[1] == tiff.FLOATS else "whole numbers"
        return f"holds {kind} of {numbers[0]} bits; save it as 8 or 16 bit or as 32 bit float"
    if told.get(tiff.BITS, 1) <= 8:
        return ""
    if told.get(tiff.PLANES) == tiff.IN_PLANES and told.get(tiff.SAMPLES, 1) > 1:
        return "has its colours apart (per channel, planar); save it interleaved"
    if told.get(tiff.PHOTOMETRIC) == tiff.WHITE_IS_0:
        return "has 0 for white; save it with 0 for black"
    return ""


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


def picture_size(path: Path | str) -> tuple[int, int]:
    """(width, height) from the header alone; an EXR's are those of the frame, its displayWindow. Raises FrameError
    where the header is no picture's."""
    path = Path(path)
    if not path.is_file():
        raise FrameError(f"{path} is missing.")
    try:
        with open(path, "rb") as stream:
            if stream.read(4) in tiff.BIG:
                raise FrameError(f"{path} is a BigTIFF; save it as a plain TIFF, of less than 4 GB.")
            stream.seek(0)
            size = _size_from_header(stream)
    except OSError as problem:
        raise FrameError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    return _checked(path, size)


def channel_names(path: Path | str) -> list[str]:
    """The channels of an EXR's first part by its header alone. Raises FrameError where the header is no EXR's."""
    path = Path(path)
    try:
        with open(path, "rb") as stream:
            names = list(exr.channel_kinds(stream)) if stream.read(4) == exr.MAGIC else []
    except OSError as problem:
        raise FrameError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    if not names:
        raise FrameError(f"{path} is not an EXR, or its header is damaged; make it again.")
    return names


def exr_space(path: Path | str) -> str:
    """The name of the linear space that an EXR's light is in, by its chromaticities: "linear", Rec. 709, as the format
    has it, where it tells none; "" for one that has no name here. Raises OSError where there is no such file."""
    from .colour import space_of_chromaticities
    from .colour.spaces import names
    from .errors import SettingsError

    with open(path, "rb") as stream:
        told = exr.chromaticities(stream)
    if told is None:
        return "linear"
    try:
        found = space_of_chromaticities(cast("Chromaticities", told)).name
    except SettingsError:
        return ""
    return found if found in names() else ""


def exr_pixel_aspect(path: Path | str) -> float:
    """Width of an EXR's pixels by their height. Raises OSError where there is no such file."""
    with open(path, "rb") as stream:
        return exr.pixel_aspect(stream)


def exr_is_cut_off(path: Path | str) -> bool:
    """Whether an EXR ends before its last lines, by its table of where they are. Raises OSError where there is no such
    file."""
    with open(path, "rb") as stream:
        return stream.read(4) == exr.MAGIC and exr.is_cut_off(stream)


def _checked(path: Path, size: tuple[int, int] | None) -> tuple[int, int]:
    if size is None or min(size) <= 0:
        raise FrameError(f"{path} is not a picture, or its header is damaged; export it again.")
    if size[0] * size[1] > LARGEST:
        raise FrameError(f"{path} claims {size[0]} x {size[1]} pixels, more than this program opens.")
    return size


@dataclass(frozen=True)
class Window:
    """Where the pixels of a file lie on the frame. size: (width, height) of what is stored; origin: (x, y) of its first
    pixel on the frame, below 0 with overscan; frame: (width, height); aspect: a pixel's width by its height."""

    size: tuple[int, int]
    origin: tuple[int, int]
    frame: tuple[int, int]
    aspect: float = 1.0

    @property
    def is_frame(self) -> bool:
        """Whether what is stored is the frame and no more."""
        return self.size == self.frame and self.origin == (0, 0)

    def header(self) -> dict[str, Any]:
        """The attributes of an EXR that say so, of a frame that begins at 0."""
        (x, y), (width, height) = self.origin, self.size
        boxes = {"dataWindow": ((x, y), (x + width - 1, y + height - 1)),
                 "displayWindow": ((0, 0), (self.frame[0] - 1, self.frame[1] - 1))}
        return {name: tuple(np.array(corner, np.int32) for corner in box) for name, box in boxes.items()}


def window_of(path: Path | str) -> Window:
    """Where a picture's pixels lie on its frame: only EXRs have others than those of the frame. Raises FrameError."""
    path = Path(path)
    size = picture_size(path)
    if path.suffix.lower() != ".exr":
        return Window(size, (0, 0), size)
    headers = _exr_headers(path)
    return _window(path, _of_the_picture([(header, [one.name for one in header["channels"]]) for header in headers]))


def _window(path: Path, header: Mapping[str, Any]) -> Window:
    """Of an EXR, by its header."""
    stored, frame = (_checked(path, (int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1))
                     for low, high in (header["dataWindow"], header["displayWindow"]))
    (x, y), (left, top) = header["dataWindow"][0], header["displayWindow"][0]
    aspect = exr.sensible_aspect(float(header.get("pixelAspectRatio", 1.0)))
    return Window(stored, (int(x) - int(left), int(y) - int(top)), frame, aspect)


def framed(pixels: Pixels, window: Window) -> Pixels:
    """The frame of pixels (height, width, ...) that lie in a window of it, 0 where there are none."""
    if window.is_frame:
        return pixels
    (width, height), (x, y) = window.frame, window.origin
    whole = np.zeros((height, width, *pixels.shape[2:]), np.float32)
    left, top = max(x, 0), max(y, 0)
    right, bottom = min(x + window.size[0], width), min(y + window.size[1], height)
    if right > left and bottom > top:
        whole[top:bottom, left:right] = pixels[top - y:bottom - y, left - x:right - x]
    return whole


def _size_from_header(stream: BinaryIO) -> tuple[int, int] | None:
    head = stream.read(24)
    if head[:8] == png.SIGNATURE and len(head) == 24:
        return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
    if head[:2] == b"\xff\xd8":
        header = jpeg.frame_header(stream)
        return (header.width, header.height) if header else None
    if head[:4] in (b"II*\0", b"MM\0*"):
        sides = tiff.whole_numbers(tiff.read_tags(stream, (tiff.WIDTH, tiff.HEIGHT)))
        return (sides[tiff.WIDTH], sides[tiff.HEIGHT]) if len(sides) == 2 else None
    if head[:4] == exr.MAGIC:
        return _exr_size(stream)
    return None


def _exr_size(stream: BinaryIO) -> tuple[int, int] | None:
    """Of the frame; a dataWindow of more pixels than may be opened counts in its place."""
    sizes = exr.windows(stream)
    stored = sizes.get("dataWindow")
    whole = stored is not None and min(stored) > 0 and stored[0] * stored[1] <= LARGEST
    return sizes.get("displayWindow", stored) if whole else stored


def read_exr(path: Path | str) -> dict[str, Pixels]:
    """Every channel of every part of an EXR, by name, as (height, width) float32; of two parts with channels of one
    name (left and right eye, passes of a renderer) the first counts.

    Raises FrameError where the file is damaged or holds NaN or infinity.
    """
    path = Path(path)
    picture_size(path)
    channels: dict[str, NDArray[Any]] = {}
    for _, of_part in exr_parts(path):
        for name, pixels in of_part.items():
            channels.setdefault(name, pixels)
    return {name: _finite(path, name, pixels) for name, pixels in channels.items()}


def _finite(path: Path, name: str, channel: NDArray[Any]) -> Pixels:
    values = np.asarray(channel, np.float32)
    if not np.isfinite(values).all():
        raise FrameError(f"{path} holds values in channel {name} that are not finite; clean it first.")
    return values


_Part = TypeVar("_Part")


def _of_the_picture(parts: Sequence[tuple[_Part, Container[str]]]) -> _Part:
    """Of the parts of an EXR, each with the names of its channels, the first that holds a picture: others have the
    depth, or a pass, with windows of their own. The first of all where none does."""
    for wanted in ("RGB", "Y"):
        for part, names in parts:
            if all(name in names for name in wanted):
                return part
    return parts[0][0]


def exr_header(path: Path | str) -> dict[str, Any]:
    """The header of an EXR's first part, as the library has it, attributes that `core.exr` knows nothing of among them.
    Raises FrameError where the file is damaged."""
    return _exr_headers(path)[0]


def _exr_headers(path: Path | str) -> list[dict[str, Any]]:
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            headers = [dict(part.header) for part in file.parts]
    except Exception as problem:  # the library raises bare RuntimeError and worse for damaged files
        raise FrameError(f"{path} is damaged or truncated ({problem}); export it again.") from problem
    if not headers:
        raise FrameError(f"{path} is damaged or truncated; export it again.")
    return headers


def exr_parts(path: Path) -> list[tuple[dict[str, Any], dict[str, NDArray[Any]]]]:
    """The header and the channels, (height, width) as stored, of each part of an EXR. Raises FrameError where the file
    is damaged: of one that is cut off the library reads no part at all."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = [(dict(part.header), {name: channel.pixels for name, channel in part.channels.items()})
                     for part in file.parts]
    except Exception as problem:  # the library raises bare RuntimeError and worse for damaged files
        raise FrameError(f"{path} is damaged or truncated ({problem}); export it again.") from problem
    if not parts:
        raise FrameError(f"{path} is damaged or truncated; export it again.")
    if any(pixels.dtype == object for _, channels in parts for pixels in channels.values()):
        raise FrameError(f"{path} is a deep EXR, with several values to a pixel; flatten it.")
    return parts


def _rgb_from_channels(path: Path, channels: Mapping[str, NDArray[Any]]) -> Pixels:
    names = "RGB" if all(name in channels for name in "RGB") else "YYY" if "Y" in channels else ""
    if not names:
        raise no_rgb(path, channels)
    return np.stack([_finite(path, name, channels[name]) for name in names], axis=-1)


def _rec709(path: Path, pixels: Pixels, header: Mapping[str, Any]) -> Pixels:
    """Linear Rec. 709 of an EXR's pixels, by its chromaticities; as they are where it has none."""
    from .colour import space_of_chromaticities
    from .errors import SettingsError

    told = header.get("chromaticities")
    if told is None:
        return pixels
    try:
        return space_of_chromaticities(tuple(told)).to_linear(pixels)
    except SettingsError as problem:
        raise FrameError(f"{path} has chromaticities that span no colour space; export it again.") from problem


def write_exr(path: Path | str, channels: Mapping[str, NDArray[Any]], *, half: bool = True,
              header: Mapping[str, Any] | None = None, turn: AbstractContextManager[None] | None = None) -> None:
    """Write one part, scanlines, ZIP; each channel (height, width). Full names as given ("scene.R"). turn: see
    `atomic_path`.

    `half` stores 16 bit floats; channels that end in ".Z" stay 32 bit, since depth needs the range.
    """
    import OpenEXR

    def stored(name: str, pixels: NDArray[Any]) -> NDArray[Any]:
        if half and not name.endswith(".Z") and name != "Z":
            return np.ascontiguousarray(np.clip(pixels, -65504, 65504), np.float16)
        return np.ascontiguousarray(pixels, np.float32)

    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(header or {})}
    save_exr(path, attributes, {name: stored(name, pixels) for name, pixels in channels.items()}, turn)


def save_exr(path: Path | str, header: Mapping[str, Any], channels: Mapping[str, NDArray[Any]],
             turn: AbstractContextManager[None] | None = None) -> None:
    """Write one part as it is given. turn: see `atomic_path`. Raises OSError where the system refuses, a full disk
    among that; FrameError for a path that the library cannot be told."""
    import OpenEXR

    if not is_utf8(str(path)):
        raise FrameError(f"The path {str(path)!r} is not UTF-8, and no EXR can be written there; rename its folder.")
    with atomic_path(path, turn) as temporary, OpenEXR.File(dict(header), dict(channels)) as file:
        try:
            file.write(str(temporary))
        except RuntimeError as problem:  # how the library hands on what the system refused, by its words alone
            full = os.strerror(errno.ENOSPC) in str(problem)
            raise OSError(errno.ENOSPC if full else errno.EIO, str(problem), str(path)) from problem
        if not temporary.stat().st_size or exr_is_cut_off(temporary):  # what is refused at its closing, it keeps quiet
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def write_png(path: Path | str, display: NDArray[Any], bits: Literal[8, 16] = 8) -> None:
    """Write display values 0..1, (height, width, 3) or (height, width), as PNG."""
    import cv2

    top = (1 << bits) - 1
    pixels = np.clip(np.nan_to_num(display), 0.0, 1.0) * top + 0.5
    stored: NDArray[Any] = pixels.astype(np.uint8 if bits == 8 else np.uint16)
    done, data = cv2.imencode(".png", stored[..., ::-1] if stored.ndim == 3 else stored)
    if not done:
        raise FrameError(f"{path} could not be encoded as PNG.")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())
