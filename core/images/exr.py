# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads OpenEXR files: headers, windows, parts, channels and colour space.

OpenEXR is imported where it is used, because Blender's own Python has none; what needs the header alone goes through
`formats/exr_header.py`.
"""
from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from ..colour import Chromaticities, space_of_chromaticities
from ..colour.spaces import names as space_names
from ..colour.srgb import Pixels
from ..errors import FrameError, SettingsError
from .formats import exr_header
from .size import checked_size, picture_size
from .window import DataWindow


def channel_names(path: Path | str) -> list[str]:
    """The channels of an EXR's first part by its header alone. Raises FrameError where the header is no EXR's."""
    path = Path(path)
    try:
        with open(path, "rb") as stream:
            names = list(exr_header.channel_kinds(stream)) if stream.read(4) == exr_header.MAGIC else []
    except OSError as problem:
        raise FrameError(f"{path} cannot be read: {problem.strerror or problem}.") from problem
    if not names:
        raise FrameError(f"{path} is not an EXR, or its header is damaged; make it again.")
    return names


def exr_space(path: Path | str) -> str:
    """The name of the linear space that an EXR's light is in, by its chromaticities: "linear", Rec. 709, as the format
    has it, where it tells none; "" for one that has no name here. Raises OSError where there is no such file."""
    with open(path, "rb") as stream:
        told = exr_header.chromaticities(stream)
    if told is None:
        return "linear"
    try:
        space = space_of_chromaticities(cast(Chromaticities, told)).name
    except SettingsError:
        return ""
    return space if space in space_names() else ""


def exr_pixel_aspect(path: Path | str) -> float:
    """Width of an EXR's pixels by their height. Raises OSError where there is no such file."""
    with open(path, "rb") as stream:
        return exr_header.pixel_aspect(stream)


def exr_is_cut_off(path: Path | str) -> bool:
    """Whether an EXR ends before its last lines, by its table of where they are. Raises OSError where there is no such
    file."""
    with open(path, "rb") as stream:
        return stream.read(4) == exr_header.MAGIC and exr_header.is_cut_off(stream)


def read_exr_header(path: Path | str) -> dict[str, Any]:
    """Read the header of an EXR's first part with OpenEXR: all attributes, with the library's types.

    Raises FrameError where the file is damaged.
    """
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

_Part = TypeVar("_Part")


def main_part(parts: Sequence[tuple[_Part, Container[str]]]) -> _Part:
    """Of the parts of an EXR, each with the names of its channels, the first that holds a picture: others have the
    depth, or a pass, with windows of their own. The first of all where none does."""
    for wanted in ("RGB", "Y"):
        for part, names in parts:
            if all(name in names for name in wanted):
                return part
    return parts[0][0]


def window_from_header(path: Path, header: Mapping[str, Any]) -> DataWindow:
    """Of an EXR, by its header."""
    stored, frame = (checked_size(path, (int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1))
                     for low, high in (header["dataWindow"], header["displayWindow"]))
    (x, y), (left, top) = header["dataWindow"][0], header["displayWindow"][0]
    aspect = exr_header.sensible_aspect(float(header.get("pixelAspectRatio", 1.0)))
    return DataWindow(stored, (int(x) - int(left), int(y) - int(top)), frame, aspect)


def window_of(path: Path | str) -> DataWindow:
    """Where a picture's pixels lie on its frame: only EXRs have others than those of the frame. Raises FrameError."""
    path = Path(path)
    size = picture_size(path)
    if path.suffix.lower() != ".exr":
        return DataWindow(size, (0, 0), size)
    headers = _exr_headers(path)
    return window_from_header(path, main_part([(header, [channel.name for channel in header["channels"]])
                                                for header in headers]))


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


def rgb_channels(path: Path, channels: Mapping[str, NDArray[Any]]) -> Pixels:
    names = "RGB" if all(name in channels for name in "RGB") else "YYY" if "Y" in channels else ""
    if not names:
        raise missing_rgb(path, channels)
    return np.stack([_finite(path, name, channels[name]) for name in names], axis=-1)


def missing_rgb(path: Path, channels: Iterable[str]) -> FrameError:
    """Of an EXR that has other channels alone."""
    return FrameError(f"{path} has no R, G, B channels at its root (it has {', '.join(sorted(channels))}); export the "
                      "picture under those names.")


def rec709_pixels(path: Path, pixels: Pixels, header: Mapping[str, Any]) -> Pixels:
    """Linear Rec. 709 of an EXR's pixels, by its chromaticities; as they are where it has none."""
    told = header.get("chromaticities")
    if told is None:
        return pixels
    try:
        return space_of_chromaticities(tuple(told)).to_linear(pixels)
    except SettingsError as problem:
        raise FrameError(f"{path} has chromaticities that span no colour space; export it again.") from problem
