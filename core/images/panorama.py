# SPDX-License-Identifier: GPL-3.0-or-later
"""Detects panoramas of the whole circle, whose right edge continues at the left one, by metadata or by the sides.

Photographs say so in XMP (Google's Photo Sphere metadata, GPano), EXRs in the attribute envmap. Many programs write
neither; a picture of 2:1 whose sides meet counts too. `removal` wraps such pictures.
"""
from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..colour.srgb import Pixels
from ..system.reading import open_regular
from .formats import png

_PROJECTIONS = ("equirectangular", "cylindrical")
_PROJECTION = re.compile(rb"ProjectionType\s*(?:=\s*[\"']|>)\s*(\w+)")
_XMP_KEYWORD = b"XML:com.adobe.xmp\0"
MIN_CORRELATION, MAX_STEP_RATIO, MIN_VARIETY = 0.9, 1.3, 10 / 255
"""Bounds for sides that meet: correlation of the two, their difference relative to that of neighbouring columns (with
half a code for noise), and the standard deviation along each. None of 375 photographs that were cropped to 2:1 is
within them."""
_MAX_XMP_BYTES = 1 << 22
"""Largest compressed XMP packet of a PNG that is decompressed."""


def wraps_around(path: Path, header: Mapping[str, Any] | None = None) -> bool:
    """Return whether a picture is a panorama of 360 degrees by what its file says. header: the header of an EXR; None
    for others.

    False for a part of a panorama, for a cube map, and for a file that cannot be read.
    """
    if header:
        return str(header.get("envmap", "")).upper().endswith("LATLONG") or str(
            header.get("wrapmodes", "")).startswith("periodic")
    try:
        with open_regular(path) as stream:
            data = stream.read()
            stream.seek(0)
            packets = [data, *(_decompress_xmp(content) for _, content in png.chunks(stream, (b"iTXt",)))]
    except OSError:
        return False
    return any(_is_full_panorama(packet) for packet in packets)


def do_sides_meet(columns: Pixels) -> bool:
    """Return whether the right side of a picture continues at its left one. columns: display values (height, 4, 3) of
    the first two and the last two columns."""
    left, right = columns[:, 0].ravel(), columns[:, 3].ravel()
    if min(left.std(), right.std()) < MIN_VARIETY or np.corrcoef(left, right)[0, 1] < MIN_CORRELATION:
        return False
    # Half a code of noise keeps very smooth sides from failing.
    beside = np.abs(columns[:, (0, 3)] - columns[:, (1, 2)]).mean()
    return float(np.abs(left - right).mean()) <= MAX_STEP_RATIO * (float(beside) + 0.5 / 255)


def _is_full_panorama(packet: bytes) -> bool:
    """Return whether XMP names a projection of the whole circle, and no crop of it."""
    match = _PROJECTION.search(packet)
    if match is None or match[1].decode().lower() not in _PROJECTIONS:
        return False
    full_width = _parse_xmp_number(packet, b"FullPanoWidthPixels")
    cropped_width = _parse_xmp_number(packet, b"CroppedAreaImageWidthPixels")
    return full_width is None or cropped_width is None or cropped_width >= full_width


def _parse_xmp_number(packet: bytes, name: bytes) -> int | None:
    """Return the whole number of an XMP property, as attribute or element; None where it is missing."""
    match = re.search(name + rb"\s*(?:=\s*[\"']|>)\s*(\d{1,9})", packet)
    return int(match[1]) if match else None


def _decompress_xmp(content: bytes) -> bytes:
    """Return the XMP of a PNG's iTXt chunk that is compressed (PNG specification, 11.3.3.4); empty for others."""
    if not content.startswith(_XMP_KEYWORD) or content[len(_XMP_KEYWORD):len(_XMP_KEYWORD) + 1] != b"\1":
        return b""
    text = content[len(_XMP_KEYWORD) + 2:].split(b"\0", 2)[-1]
    try:
        return zlib.decompressobj().decompress(text, _MAX_XMP_BYTES)
    except zlib.error:
        return b""
