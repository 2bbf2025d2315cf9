# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes of video frames as arrays, and their orientation.

PyAV gives the planes as FFmpeg decoded them. Formats that interleave their components, or use a palette, are first
converted by swscale to planes of the same depth. `video.py` reads planes, `video_writer.py` also changes them.
"""
from __future__ import annotations

import re
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .video_colour import FULL_RANGE, LIMITED_RANGE

_PLANAR = re.compile(r"(?P<kind>yuvj|yuva|yuv|gbra|gbr|gray)(?P<sampling>4[0-4]{2})?p?(?P<bits>9|1[0246])?(le)?")
"""Names of the formats with one component per plane, in the byte order of the machine."""
_SAMPLING = {None: (1, 1), "444": (1, 1), "440": (1, 2), "422": (2, 1), "420": (2, 2), "411": (4, 1), "410": (4, 4)}
"""Luma columns and lines per chroma sample."""
_DEPTHS = (8, 9, 10, 12, 14, 16)


@dataclass(frozen=True)
class PlaneFormat:
    """A planar format: FFmpeg's name, bits of a code, subsampling (x, y), and which components it has."""

    name: str
    bits: int
    sampling: tuple[int, int]
    is_rgb: bool
    is_grey: bool
    has_alpha: bool
    is_full_range: bool

    @property
    def dtype(self) -> Any:
        """numpy's type of a code."""
        return np.uint8 if self.bits == 8 else np.uint16


def plane_format(name: str) -> PlaneFormat | None:
    """Return the planar format of FFmpeg's name; None for any other format."""
    match = _PLANAR.fullmatch(name)
    if match is None or match["sampling"] not in _SAMPLING:
        return None
    kind, bits = match["kind"], int(match["bits"] or 8)
    return PlaneFormat(name, bits, _SAMPLING[match["sampling"]], kind.startswith("gbr"), kind == "gray",
                       kind.endswith("a"), kind == "yuvj")


def nearest_planar_name(frame: Any) -> str:
    """Return the name of the planar format, without subsampling, that holds all components of a PyAV frame.

    The format is R G B for RGB frames, palettes, sensor (Bayer), XYZ and one bit pictures, else Y Cb Cr.
    """
    components = frame.format.components
    has_alpha = any(component.is_alpha for component in components) or frame.format.has_palette
    bits = max((component.bits for component in components), default=8)
    is_rgb = frame.format.is_rgb or frame.format.has_palette or frame.format.name.startswith(("bayer", "xyz", "mono"))
    depth = next((depth for depth in _DEPTHS if depth >= bits), 16)
    if has_alpha and depth in (9, 14):  # FFmpeg has no formats with alpha of these depths
        depth += 1 if depth == 9 else 2
    name = f"gbr{'a' if has_alpha else ''}p" if is_rgb else f"yuv{'a' if has_alpha else ''}444p"
    return name if depth == 8 else f"{name}{depth}le"


def to_planar(frame: Any, is_limited: bool) -> tuple[Any, PlaneFormat]:
    """Return (frame, its format): a PyAV frame converted to a planar format, or itself if it is planar. is_limited: its
    codes have limited range."""
    planar = plane_format(frame.format.name)
    if planar is None:
        name = nearest_planar_name(frame)
        planar = plane_format(name)
        assert planar is not None
        if planar.is_rgb:
            frame = frame.reformat(format=name)
        else:  # the same range on both sides, so that codes stay as they are
            colour_range = LIMITED_RANGE if is_limited else FULL_RANGE
            frame = frame.reformat(format=name, src_color_range=colour_range, dst_color_range=colour_range)
    return frame, planar


def plane_arrays(frame: Any, planar: PlaneFormat) -> list[NDArray[Any]]:
    """View the planes of a PyAV frame, as (lines, columns) each: Y U V, or R G B, with alpha last.

    The arrays are the frame's memory, and can be written to where the frame is writable.
    """
    arrays = []
    for index, plane in enumerate(frame.planes):
        codes = np.frombuffer(plane, planar.dtype).reshape(-1, abs(plane.line_size) // planar.dtype().itemsize)
        width, height = frame.width, frame.height
        if index in (1, 2):
            width, height = -(-width // planar.sampling[0]), -(-height // planar.sampling[1])
        arrays.append(codes[:height, :width])
    if planar.is_rgb:  # FFmpeg's order is G B R
        arrays[:3] = [arrays[2], arrays[0], arrays[1]]
    return arrays


def stack_planes(arrays: list[NDArray[Any]], planar: PlaneFormat) -> NDArray[Any]:
    """Stack the planes of a frame to (height, width, 1 or 3); a plane of alpha is left out.

    Three channels lie in memory that the next call of this thread overwrites; grey is a view of its plane. Chroma is
    interpolated linearly between the centres of its samples.
    """
    import cv2

    if planar.is_grey:
        return arrays[0][..., None]
    height, width = arrays[0].shape
    across, down = planar.sampling
    full_planes = [arrays[0]]
    for index, codes in enumerate(arrays[1:3]):
        if (across, down) != (1, 1):
            size = codes.shape[1] * across, codes.shape[0] * down
            scratch = _scratch_array(index, (size[1], size[0]), codes.dtype)
            codes = np.asarray(cv2.resize(codes, size, scratch, interpolation=cv2.INTER_LINEAR))[:height, :width]
        full_planes.append(codes)
    return np.asarray(cv2.merge(full_planes, _scratch_array(2, (height, width, 3), arrays[0].dtype)))


_BUFFERS = threading.local()


def _scratch_array(slot: int, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Return an array of this thread that the next frame overwrites: fresh memory costs more than the conversion.

    slot: number of the array; arrays of different slots are separate memory.
    """
    buffers: dict[str, NDArray[Any]] = _BUFFERS.__dict__
    buffer = buffers.get(str(slot))
    if buffer is None or buffer.shape != shape or buffer.dtype != dtype:
        buffer = buffers[str(slot)] = np.empty(shape, dtype)
    return buffer


def shrink_plane(plane: NDArray[np.float32], planar: PlaneFormat) -> NDArray[np.float32]:
    """Average a plane (height, width) of the full size to the size of the chroma planes, which is rounded up."""
    import cv2

    across, down = planar.sampling
    height, width = plane.shape
    padded = np.pad(plane, ((0, -height % down), (0, -width % across)), mode="edge")
    size = padded.shape[1] // across, padded.shape[0] // down
    return np.asarray(cv2.resize(padded, size, interpolation=cv2.INTER_AREA), np.float32)


@dataclass(frozen=True)
class Orientation:
    """How stored frames are turned to stand upright: columns become lines (`transposed`), then axes are mirrored."""

    transposed: bool = False
    mirror_x: bool = False
    mirror_y: bool = False

    def upright(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return stored pixels (height, width, ...) upright, contiguous."""
        if self.transposed:
            pixels = np.swapaxes(pixels, 0, 1)
        return np.ascontiguousarray(pixels[::-1 if self.mirror_y else 1, ::-1 if self.mirror_x else 1])

    def stored(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return upright pixels as they are stored: the inverse of `upright`."""
        pixels = pixels[::-1 if self.mirror_y else 1, ::-1 if self.mirror_x else 1]
        return np.ascontiguousarray(np.swapaxes(pixels, 0, 1) if self.transposed else pixels)


def side_data(frame: Any) -> dict[str, bytes]:
    """Return the side data of a PyAV frame by the name of its kind; a kind that PyAV does not know is named "KIND_28"
    or the like."""
    try:
        return {item.type.name: bytes(item) for item in frame.side_data}
    except ValueError:  # a kind of a later FFmpeg, such as an Exif block: PyAV then lists none at all
        from av.sidedata.sidedata import Type

        Type._missing_ = classmethod(_unnamed_kind)  # type: ignore[method-assign, assignment]
        return {item.type.name: bytes(item) for item in frame.side_data}


def _unnamed_kind(kinds: Any, value: object) -> Any:
    """Return a member of PyAV's enumeration for a kind of side data without a name."""
    member = object.__new__(kinds)
    member._name_, member._value_ = f"KIND_{value}", value
    return member


def display_matrix(frame: Any) -> list[int] | None:
    """Return the nine numbers of a PyAV frame's display matrix (ISO/IEC 14496-12, 8.3.2), or None."""
    data = side_data(frame).get("DISPLAYMATRIX", b"")
    return [int(number) for number in np.frombuffer(data[:36], "=i4")] if len(data) >= 36 else None


def orientation_from_matrix(matrix: list[int] | None) -> Orientation:
    """Return the orientation nearest to a display matrix (`display_matrix`): rotations are rounded to quarter turns."""
    if matrix is None:
        return Orientation()
    a, b, c, d = matrix[0], matrix[1], matrix[3], matrix[4]  # shown x = a x + c y, shown y = b x + d y
    if abs(a) + abs(d) >= abs(b) + abs(c):
        return Orientation(False, a < 0, d < 0)
    return Orientation(True, c < 0, b < 0)
