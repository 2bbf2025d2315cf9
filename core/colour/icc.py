# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads ICC profiles of matrix and curves (ICC.1:2022), as cameras, screens and working spaces have.

Parsed here because the libraries that convert by profiles do so in 8 bits, or need a file of the profile, and Blender's
Python has none of them. Profiles that consist of tables are refused.
"""
from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .spaces import REC_709, ColourSpace, colour_space, matrix_to_xyz
from .srgb import Pixels, linear_from_srgb

Table = Callable[[NDArray[Any]], Pixels]
_D50 = (0.9642, 1.0, 0.8249)
_MAX_TAGS = 200
_SAMPLES = 4096
"""Steps by which a curve is inverted."""
SRGB_TOLERANCE = 4e-3
"""Difference of display values and matrix entries up to which a profile counts as sRGB: half a step of 8 bits, since
profiles round their numbers."""


class UnreadableProfile(ValueError):
    """A profile that cannot be honoured; the text says why, after the words "has a profile that"."""


class DamagedProfile(UnreadableProfile):
    """A profile that is incomplete or contradicts its format."""

    def __init__(self) -> None:
        super().__init__("is damaged")


def space_of_profile(profile: bytes) -> ColourSpace:
    """Return the space of an ICC profile; the built-in sRGB if the profile differs from it only by rounding.

    Raises UnreadableProfile for a profile that is damaged, not for R G B or grey, or made of tables.
    """
    tags = _read_tags(profile)
    if b"cicp" in tags and len(tags[b"cicp"]) >= 12:  # code points are exact, where the curves are rounded
        from .cicp import space_of_code_points

        space = space_of_code_points(*tags[b"cicp"][8:10])
        if space is not None:
            return space
    name = _read_description(tags)
    data_space = profile[16:20]  # field of the header: what the profile is for
    if data_space == b"GRAY" and b"kTRC" in tags:
        return _make_space(name, np.eye(3), [_parse_curve(tags[b"kTRC"])] * 3)
    if data_space != b"RGB ":
        raise UnreadableProfile(f"is for {data_space.decode('latin-1').strip()}, not for R G B")
    required = (b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC")
    if not all(tag in tags for tag in required):
        if "srgb" in name.lower():  # some sRGB profiles consist of tables
            return colour_space("srgb")
        raise UnreadableProfile("consists of tables")
    columns = [_parse_xyz(tags[tag]) for tag in required[:3]]  # X, Y, Z of each primary, under white D50
    matrix = np.linalg.inv(_to_d50(matrix_to_xyz(REC_709))) @ np.array(columns).T
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-6:
        raise UnreadableProfile("has primaries that span no space")
    return _make_space(name, matrix, [_parse_curve(tags[tag]) for tag in required[3:]])


def _make_space(name: str, matrix: NDArray[np.float64], curves: list[Table]) -> ColourSpace:
    """Make the space of a profile's curves, one per channel, and its matrix (3, 3) to linear Rec. 709."""
    ramp = np.linspace(0, 1, _SAMPLES, dtype=np.float32)
    decoded = np.stack([curve(ramp) for curve in curves])
    is_709 = np.abs(matrix - np.eye(3)).max() < SRGB_TOLERANCE
    if is_709 and np.abs(decoded - linear_from_srgb(ramp)).max() < SRGB_TOLERANCE:
        return colour_space("srgb")
    forward, inverse = matrix.T.astype(np.float32), np.linalg.inv(matrix).T.astype(np.float32)
    increasing = [np.maximum.accumulate(channel) for channel in decoded]  # never decreasing, for the inverse

    def to_linear(pixels: NDArray[Any]) -> Pixels:
        clipped = np.clip(np.asarray(pixels, np.float32), 0, 1)
        light = np.stack([curve(clipped[..., k]) for k, curve in enumerate(curves)], -1)
        return light if is_709 else light @ forward

    def from_linear(light: NDArray[Any]) -> Pixels:
        profile_light = np.asarray(light, np.float32) if is_709 else np.asarray(light, np.float32) @ inverse
        values = np.stack([_invert_curve(curves[k], increasing[k], ramp, profile_light[..., k]) for k in range(3)], -1)
        return np.asarray(values, np.float32)

    return ColourSpace(f"profile {name}", to_linear, from_linear)


def _invert_curve(curve: Table, decoded: Pixels, ramp: Pixels, light: Pixels) -> Pixels:
    """Return the values 0..1 at which `curve` gives `light`: interpolated in the curve's samples, then refined by one
    secant step, since the samples are coarse where the curve is flat or steep.

    ramp: (k,) rising values 0..1. decoded: (k,) the curve's samples there, never decreasing. light: 0..1, any shape.
    """
    value = np.interp(light, decoded, ramp)
    step = np.float32(0.5 / _SAMPLES)
    above, below = (curve(np.clip(value + sign * step, 0, 1).astype(np.float32)) for sign in (1, -1))
    slope = above - below
    error = light - curve(value.astype(np.float32))
    refined = value + np.clip(np.where(slope > 0, error / np.maximum(slope, 1e-9) * 2 * step, 0), -2 * step, 2 * step)
    return np.clip(np.where((light > 0) & (light < 1), refined, value), 0, 1).astype(np.float32)


def _read_tags(profile: bytes) -> dict[bytes, bytes]:
    """Return the tags of a profile by name. Raises UnreadableProfile where it is damaged."""
    if len(profile) < 132 or profile[36:40] != b"acsp":  # the header of 128 bytes has this signature
        raise DamagedProfile
    count = int.from_bytes(profile[128:132], "big")
    tags = {}
    for index in range(min(count, _MAX_TAGS)):
        entry = profile[132 + 12 * index:144 + 12 * index]
        if len(entry) < 12:
            raise DamagedProfile
        name, offset, length = struct.unpack(">4sII", entry)
        if offset + length > len(profile):
            raise DamagedProfile
        tags[name] = profile[offset:offset + length]
    return tags


def _read_description(tags: dict[bytes, bytes]) -> str:
    """Return the profile's name: in its first language for version 4 ("mluc"), in ASCII for version 2 ("desc")."""
    text = tags.get(b"desc", b"")
    if text[:4] == b"mluc" and len(text) >= 28:
        length, offset = struct.unpack(">II", text[20:28])
        return text[offset:offset + length].decode("utf-16-be", "replace").strip("\0 ") or "without a name"
    if text[:4] == b"desc" and len(text) >= 12:
        return text[12:12 + int.from_bytes(text[8:12], "big")].decode("latin-1").strip("\0 ") or "without a name"
    return "without a name"


def _parse_xyz(data: bytes) -> tuple[float, float, float]:
    """Return X, Y, Z of a tag of type `XYZ`, in fixed-point numbers of 16.16 bits. Raises UnreadableProfile."""
    if len(data) < 20:
        raise DamagedProfile
    x, y, z = struct.unpack(">3i", data[8:20])
    return x / 65536, y / 65536, z / 65536


def _parse_curve(data: bytes) -> Table:
    """Return a curve of type `curv` or `para` as a function of 0..1. Raises UnreadableProfile."""
    if data[:4] == b"curv" and len(data) >= 12:
        count = int.from_bytes(data[8:12], "big")
        if len(data) < 12 + 2 * count:
            raise DamagedProfile
        values = np.frombuffer(data[12:12 + 2 * count], ">u2")
        if count == 0:
            return lambda x: np.asarray(x, np.float32)  # linear
        if count == 1:
            return _power_function(float(values[0]) / 256)  # the exponent, a fixed-point number with 8 fractional bits
        table, positions = values.astype(np.float64) / 65535, np.linspace(0, 1, count)
        return lambda x: np.interp(x, positions, table).astype(np.float32)
    if data[:4] == b"para" and len(data) >= 12:
        function_type = int.from_bytes(data[8:10], "big")
        if function_type <= 4:
            parameter_count = (1, 3, 4, 5, 7)[function_type]  # fixed-point numbers of 16.16 bits
            if len(data) >= 12 + 4 * parameter_count:
                numbers = struct.unpack(f">{parameter_count}i", data[12:12 + 4 * parameter_count])
                return _parametric_function(function_type, [number / 65536 for number in numbers])
    raise DamagedProfile


def _power_function(gamma: float) -> Table:
    """Return the curve x**gamma, 0 below 0. Raises UnreadableProfile for an exponent that no picture has."""
    if not 0.1 <= gamma <= 10:
        raise UnreadableProfile("has a curve that no picture has")
    return lambda x: np.power(np.maximum(x, 0), np.float32(gamma)).astype(np.float32)


def _parametric_function(function_type: int, parameters: list[float]) -> Table:
    """Return a parametric curve (ICC.1:2022, table 68): (a x + b)**g + e from x = d on, c x + f below.

    function_type: the number of the function, 0..4. parameters: its parameters, in the order g, a, b, c, d, e, f.
    """
    g, a, b, c, d, e, f = (parameters + [0.0] * 7)[:7]
    power = _power_function(g)  # raises for an invalid exponent
    if function_type == 0:
        return power
    if a == 0:
        raise UnreadableProfile("has a curve that no picture has")
    if function_type in (1, 2):  # d = -b / a; below it, function 1 is 0 and function 2 is c, which it also adds above
        c, d, e, f = 0.0, -b / a, c if function_type == 2 else 0.0, c if function_type == 2 else 0.0

    def decode(x: NDArray[Any]) -> Pixels:
        upper = np.power(np.maximum(a * x + b, 0), g) + e
        return np.where(x >= d, upper, c * x + f).astype(np.float32)

    return decode


def _to_d50(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Adapt the white of a matrix (3, 3) from R, G, B to X, Y, Z to D50, the white of profiles (Bradford)."""
    from .spaces import _BRADFORD

    white = _BRADFORD @ matrix.sum(1)  # X, Y, Z of R = G = B = 1
    return np.asarray(np.linalg.inv(_BRADFORD) @ np.diag(_BRADFORD @ np.array(_D50) / white) @ _BRADFORD @ matrix)
