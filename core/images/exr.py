# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads OpenEXR files: headers, windows, parts, channels and colour space.

OpenEXR is imported where it is used, because Blender's own Python has none; what needs the header alone goes through
`formats/exr_header.py`.
"""
from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ..colour import Chromaticities, space_of_chromaticities
from ..colour.spaces import built_in_names as space_names
from ..colour.srgb import Pixels
from ..errors import FrameError, SettingsError
from ..system.reading import check_regular, open_regular
from .decoders import file_kind, open_oiio
from .formats import exr_header
from .size import checked_size, picture_size
from .window import DataWindow


def is_exr(path: Path) -> bool:
    """Return whether a file is an EXR by its contents, whatever its name. Raises OSError."""
    return file_kind(path) == "exr"


def channel_names(path: Path | str) -> list[str]:
    """Return the names of the channels of an EXR's first part, from the header alone. Raises FrameError where the file
    is no EXR or its header is damaged."""
    path = Path(path)
    try:
        with open_regular(path) as stream:
            names = list(exr_header.channel_kinds(stream)) if stream.read(4) == exr_header.MAGIC else []
    except OSError as problem:
        raise FrameError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    if not names:
        raise FrameError(f"{path} is not an EXR, or its header is damaged; make it again.")
    return names


def exr_colour_space(path: Path | str) -> str:
    """Return the name of the built-in linear space that has an EXR's chromaticities; "" if there is none.

    Without chromaticities it is "linear", Rec. 709, as the format defines. Raises OSError where the file is missing.
    """
    with open_regular(path) as stream:
        chromaticities = exr_header.chromaticities(stream)
    if chromaticities is None:
        return "linear"
    try:
        space = space_of_chromaticities(cast(Chromaticities, chromaticities)).name
    except SettingsError:
        return ""
    return space if space in space_names() else ""


def exr_pixel_aspect(path: Path | str) -> float:
    """Return the pixel aspect ratio (width / height) of an EXR. Raises OSError where the file is missing."""
    with open_regular(path) as stream:
        return exr_header.pixel_aspect(stream)


def is_exr_truncated(path: Path | str) -> bool:
    """Return whether an EXR ends before its last lines, by its table of line offsets. Raises OSError where the file is
    missing."""
    with open_regular(path) as stream:
        return stream.read(4) == exr_header.MAGIC and exr_header.is_truncated(stream)


def read_exr_header(path: Path | str) -> dict[str, Any]:
    """Read the header of an EXR's first part with OpenEXR: all attributes, with the library's types.

    Raises FrameError where the file is damaged.
    """
    return read_exr_headers(path)[0]


def non_utf8_strings(path: Path | str) -> dict[str, bytes]:
    """Return the text attributes of an EXR that are not UTF-8, by name; {} for another file. Raises OSError."""
    with open_regular(path) as stream:
        if stream.read(4) != exr_header.MAGIC:
            return {}
        texts = exr_header.locate_strings(stream)
    return {name: text for name, (_, text) in texts.items() if not is_utf8(text)}


def non_utf8_names(path: Path | str) -> dict[bytes, bytes]:
    """Return the names of attributes and channels of an EXR that are not UTF-8, by the ASCII names under which this
    program has them: each byte above 127 is replaced by DEL, the last character of ASCII.

    An EXR stores channels in the order of their names, so DEL must not change that order. Raises FrameError where it
    does, or where two names become one; raises OSError.
    """
    with open_regular(path) as stream:
        if stream.read(4) != exr_header.MAGIC:
            return {}
        locations = exr_header.locate_names(stream)
    names = {_in_ascii(name): name for _, _, name in locations if not is_utf8(name)}
    if names:
        for part in {part for part, _, _ in locations}:
            stored = [name for number, _, name in locations if number == part]
            readable = [name if is_utf8(name) else _in_ascii(name) for name in stored]
            # Two names have become one, or the sorted order has changed.
            if len(set(readable)) < len(set(stored)) or [sorted(stored).index(name) for name in stored] != [
                    sorted(readable).index(name) for name in readable]:
                example = min(names.values()).decode("latin-1")
                raise FrameError(f"{path} has attributes or channels, such as {example}, whose names are not UTF-8 and "
                                 "differ in nothing else; rename them.")
    return names


def _in_ascii(name: bytes) -> bytes:
    """Return a name with DEL in place of each byte above 127, of the same length."""
    return bytes(byte if byte < 128 else 0x7F for byte in name)


def is_utf8(text: bytes) -> bool:
    """Return whether bytes are valid UTF-8."""
    try:
        text.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


@contextlib.contextmanager
def _readable_path(path: Path | str) -> Iterator[str]:
    """Yield the path of an EXR that the library can read: the file itself, or a temporary copy if it has text or names
    that are not UTF-8, since the library would refuse the whole file.

    In the copy, other bytes stand for those above 127: "?" in texts, and in names those that `non_utf8_names` gives.
    """
    check_regular(path)
    names = non_utf8_names(path)
    if not names and not non_utf8_strings(path):
        yield str(path)
        return
    with open_regular(path) as stream:
        texts = exr_header.locate_strings(stream)
        name_locations = exr_header.locate_names(stream)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy.exr"
        shutil.copyfile(path, copy)
        with open(copy, "r+b") as stream:
            for offset, text in texts.values():
                if not is_utf8(text):
                    stream.seek(offset)
                    stream.write(bytes(byte if byte < 128 else ord("?") for byte in text))
            for _, offset, name in name_locations:
                if not is_utf8(name):
                    stream.seek(offset)
                    stream.write(_in_ascii(name))
        yield str(copy)


def read_exr_headers(path: Path | str) -> list[dict[str, Any]]:
    """Read the header of each part, at least one. Raises FrameError."""
    import OpenEXR

    try:
        with _readable_path(path) as readable, OpenEXR.File(readable, header_only=True) as file:
            headers = [_usable_header(part.header) for part in file.parts]
    except OSError as problem:
        raise FrameError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    except Exception as problem:  # the library raises bare RuntimeError and worse for damaged files
        raise FrameError(f"{path} is damaged or truncated ({problem}); export it again.") from problem
    if not headers:
        raise FrameError(f"{path} is damaged or truncated; export it again.")
    return headers


def _usable_header(header: Mapping[str, Any]) -> dict[str, Any]:
    """Return a header without the attributes of _IS_USABLE whose type is not the standard's."""
    return {name: value for name, value in header.items() if name not in _IS_USABLE or _IS_USABLE[name](value)}


def _is_chromaticities(value: Any) -> bool:
    return isinstance(value, tuple) and len(value) == 8 and all(isinstance(number, float) for number in value)


_IS_USABLE: dict[str, Callable[[Any], bool]] = {
    "chromaticities": _is_chromaticities,
    "pixelAspectRatio": lambda value: isinstance(value, float),
    "multiView": lambda value: isinstance(value, list) and all(isinstance(name, str) for name in value)}
"""Tests of the types of optional attributes, by name; the types are the standard's, as the library gives them."""


def read_exr_parts(path: Path) -> list[tuple[dict[str, Any], dict[str, NDArray[Any]]]]:
    """Read the header and the channels, (height, width) as stored, of each part of an EXR.

    Raises FrameError where the file is damaged; of a truncated one the library reads no part at all.
    """
    import OpenEXR

    try:
        with _readable_path(path) as readable, OpenEXR.File(readable, separate_channels=True) as file:
            parts = [(_usable_header(part.header), {name: channel.pixels for name, channel in part.channels.items()})
                     for part in file.parts]
    except OSError as problem:
        raise FrameError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    except Exception as problem:  # the library raises bare RuntimeError and worse for damaged files
        raise FrameError(f"{path} is damaged or truncated ({problem}); export it again.") from problem
    if not parts:
        raise FrameError(f"{path} is damaged or truncated; export it again.")
    if any(pixels.dtype == object for _, channels in parts for pixels in channels.values()):
        raise FrameError(f"{path} is a deep EXR, with several values to a pixel; flatten it.")
    return parts


_Part = TypeVar("_Part")


def main_part(parts: Sequence[tuple[_Part, Container[str]]]) -> _Part:
    """Return the first part of an EXR with R, G and B; else the first with Y; else the first of all.

    parts: for each part, a value that stands for it (such as its number or header), and the names of its channels. The
    other parts hold depth or a render pass, with windows of their own.
    """
    for channels in ("RGB", "Y"):
        for part, part_channels in parts:
            if all(name in part_channels for name in channels):
                return part
    return parts[0][0]


def window_from_header(path: Path, header: Mapping[str, Any]) -> DataWindow:
    """Read the data window from an EXR's header, with its origin relative to the frame's. Raises FrameError for a size
    that is empty or too large."""
    stored, frame = (checked_size(path, (int(last[0]) - int(first[0]) + 1, int(last[1]) - int(first[1]) + 1))
                     for first, last in (header["dataWindow"], header["displayWindow"]))
    (x, y), (left, top) = header["dataWindow"][0], header["displayWindow"][0]
    aspect = exr_header.sensible_aspect(float(header.get("pixelAspectRatio", 1.0)))
    return DataWindow(stored, (int(x) - int(left), int(y) - int(top)), frame, aspect)


def read_data_window(path: Path | str) -> DataWindow:
    """Read where a picture's stored pixels lie on its frame; only EXRs can differ from the frame. Raises FrameError."""
    path = Path(path)
    size = picture_size(path)
    if not is_exr(path):
        return DataWindow(size, (0, 0), size)
    headers = read_exr_headers(path)
    return window_from_header(path, main_part([(header, [channel.name for channel in header["channels"]])
                                               for header in headers]))


def read_exr(path: Path | str) -> dict[str, Pixels]:
    """Read every channel of every part of an EXR, by name, as (height, width) float32.

    If two parts have a channel of the same name (two eyes, render passes), the first part's is returned. Raises
    FrameError where the file is damaged or holds NaN or infinity.
    """
    path = Path(path)
    picture_size(path)
    channels: dict[str, NDArray[Any]] = {}
    for _, part_channels in read_exr_parts(path):
        for name, pixels in part_channels.items():
            channels.setdefault(name, pixels)
    return {name: _check_finite(path, name, pixels) for name, pixels in channels.items()}


def _check_finite(path: Path, name: str, channel: NDArray[Any]) -> Pixels:
    """Return a channel as float32. Raises FrameError for NaN and infinity."""
    values = np.asarray(channel, np.float32)
    if not np.isfinite(values).all():
        raise FrameError(f"{path} holds values in channel {name} that are not finite; clean it first.")
    return values


def rgb_channels(path: Path, channels: Mapping[str, NDArray[Any]]) -> Pixels:
    """Stack R, G and B, or Y three times, to (height, width, 3); luminance and chroma are converted to R, G, B.

    path: for messages, and to read chroma. Raises FrameError where neither exists, or for NaN and infinity.
    """
    if has_chroma(channels):
        return read_luminance_chroma(path)
    names = "RGB" if all(name in channels for name in "RGB") else "YYY" if "Y" in channels else ""
    if not names:
        raise missing_rgb_error(path, channels)
    return np.stack([_check_finite(path, name, channels[name]) for name in names], axis=-1)


def has_chroma(channels: Container[str]) -> bool:
    """Return whether a picture is stored as luminance and chroma of half resolution, as OpenEXR's RGBA interface can
    write."""
    return all(name in channels for name in ("Y", "RY", "BY"))


def read_luminance_chroma(path: Path) -> Pixels:
    """Read an EXR of luminance and chroma as R, G, B (height, width, 3) in its primaries, by OpenImageIO, which filters
    the chroma as the library of the format does. Raises FrameError."""
    image_input = open_oiio(path)
    try:
        spec = image_input.spec()
        pixels = image_input.read_image(0, 0, 0, 3, "float")
        problem = image_input.geterror()
    finally:
        image_input.close()
    if pixels is None or problem or spec.channelnames[:3] != ("R", "G", "B"):
        raise FrameError(f"{path} is damaged or truncated ({problem}); export it again.")
    return _check_finite(path, "Y, RY, BY", np.asarray(pixels))


def missing_rgb_error(path: Path, channels: Iterable[str]) -> FrameError:
    """Make the error for an EXR without R, G, B or Y."""
    return FrameError(f"{path} has no R, G, B channels at its root (it has {', '.join(sorted(channels))}); export the "
                      "picture under those names.")


def rec709_pixels(path: Path, pixels: Pixels, header: Mapping[str, Any]) -> Pixels:
    """Convert an EXR's pixels (height, width, 3) to linear Rec. 709 by its chromaticities; unchanged where it has none.
    Raises FrameError where they span no space."""
    chromaticities = header.get("chromaticities")
    if chromaticities is None:
        return pixels
    try:
        return space_of_chromaticities(tuple(chromaticities)).to_linear(pixels)
    except SettingsError as problem:
        raise FrameError(f"{path} has chromaticities that span no colour space; export it again.") from problem
