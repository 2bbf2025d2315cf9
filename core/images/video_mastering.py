# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the mastering display and the light levels of a video (SMPTE ST 2086, CTA-861.3), and names them for x265.

`video_writer.py` keeps them on clean videos.
"""
from __future__ import annotations

import struct
from typing import Any

from .video_planes import side_data

_DISPLAY, _LEVELS = "MASTERING_DISPLAY_METADATA", "CONTENT_LIGHT_LEVEL"
"""Names of the side data of a decoded frame."""
_RATIONALS = struct.Struct("<20i2i")
"""FFmpeg's AVMasteringDisplayMetadata: x and y of red, green, blue and white, the least and the greatest luminance, as
numerators and denominators; then whether the chromaticities and the luminances are set."""
_CHROMATICITY_STEPS, _LUMINANCE_STEPS = 50_000, 10_000
"""x265's units: steps to 1, and to 1 cd/m²."""


def x265_options(frame: Any) -> str:
    """Return x265's parameters for the side data of PyAV's frame, each with a colon before it; "" where it has none."""
    data = side_data(frame)
    return _display_option(data.get(_DISPLAY, b"")) + _levels_option(data.get(_LEVELS, b""))


def _display_option(data: bytes) -> str:
    """Return the option for a mastering display, in x265's order G, B, R, white; "" where a part of it is not set."""
    if len(data) < _RATIONALS.size:
        return ""
    *numbers, has_primaries, has_luminance = _RATIONALS.unpack_from(data)
    if not (has_primaries and has_luminance) or 0 in numbers[1::2]:
        return ""
    values = [numerator / denominator for numerator, denominator in zip(numbers[0::2], numbers[1::2], strict=True)]
    points = [round(value * _CHROMATICITY_STEPS) for value in values[:8]]
    low, high = (round(value * _LUMINANCE_STEPS) for value in values[8:])
    red, green, blue, white = (f"({points[index]},{points[index + 1]})" for index in (0, 2, 4, 6))
    return f":master-display=G{green}B{blue}R{red}WP{white}L({high},{low})"


def _levels_option(data: bytes) -> str:
    """Return the option for the greatest level of a pixel and the greatest mean of a frame, cd/m²; "" for none."""
    if len(data) < 8:
        return ""
    content, average = struct.unpack_from("<2I", data)
    return f":max-cll={content},{average}" if content or average else ""
