# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the colour space that a picture file declares: by its profile, code points, curve or primaries.

`read.py` and `plates.py` convert by it. A file that declares nothing is sRGB with integer codes, and scene-linear Rec.
709 with floats.
"""
from __future__ import annotations

import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..colour import REC_709, Chromaticities, ColourSpace, colour_space
from ..colour.cicp import space_of_code_points
from ..colour.curves import power_curve
from ..colour.spaces import CHROMATICITY_TOLERANCE, curved_space
from ..system.reading import open_regular
from .decoders import describe, file_kind, profile_space
from .formats import jpeg, png, tiff

MAX_PROFILE_BYTES = 16 << 20
"""Bound of an uncompressed profile; those of tables have some megabytes."""
_SRGB_GAMMAS = (44000, 47000)
"""Values of gAMA that mean sRGB (1 / 2.2), with what programs round them to."""


def declared_space(path: Path) -> ColourSpace | None:
    """Return the space that a file declares; None where it declares none, and for an EXR (`exr.py` reads its space).

    Raises OSError, and FrameError for a profile that cannot be honoured.
    """
    kind = file_kind(path)
    if kind in ("", "exr"):
        return None
    if kind == "png":
        return _png_space(path)
    if kind == "jpeg":
        with open_regular(path) as stream:
            return profile_space(path, jpeg_profile(stream))
    if kind == "tiff":
        with open_regular(path) as stream:
            if stream.read(4) in tiff.BIG_TIFF:
                return describe(path, kind).space
            tags = tiff.read_tags(stream, (tiff.COLOUR_PROFILE,))
        profile = tags[tiff.COLOUR_PROFILE].values if tiff.COLOUR_PROFILE in tags else None
        return profile_space(path, profile.astype(np.uint8).tobytes()) if profile is not None else None
    return describe(path, kind).space


def jpeg_profile(stream: BinaryIO) -> bytes:
    """Join the ICC profile of a JPEG from its segments (ICC.1:2022, annex B.4); empty where it has none or a part is
    missing."""
    parts: dict[int, bytes] = {}
    for marker, content in jpeg.segments(stream):
        if marker == jpeg.APP2 and content.startswith(b"ICC_PROFILE\0") and len(content) > 14:
            parts[content[12]] = content[14:]
    numbers = sorted(parts)
    return b"".join(parts[number] for number in numbers) if numbers == list(range(1, len(parts) + 1)) else b""


def _png_space(path: Path) -> ColourSpace | None:
    """Return the space of a PNG; None for none. The first of these chunks counts, by the order of the specification
    (third edition, 4.3): cICP, iCCP, sRGB, then gAMA with cHRM."""
    with open_regular(path) as stream:
        chunks = dict(png.chunks(stream, (b"cICP", b"iCCP", b"sRGB", b"gAMA", b"cHRM"), before_pixels=True))
    code_points = chunks.get(b"cICP", b"")
    if len(code_points) == 4 and (space := space_of_code_points(code_points[0], code_points[1])) is not None:
        return space
    if b"iCCP" in chunks:
        space = profile_space(path, _inflate(chunks[b"iCCP"].partition(b"\0")[2][1:]))  # after name and method
        if space is not None:
            return space
    if b"sRGB" in chunks:
        return colour_space("srgb")
    gamma = int.from_bytes(chunks.get(b"gAMA", b""), "big")  # 100 000 times the exponent that encodes; 0 for none
    primaries = _parse_chromaticities(chunks.get(b"cHRM", b""))
    if not gamma and primaries is None:
        return None
    if not gamma or _SRGB_GAMMAS[0] <= gamma <= _SRGB_GAMMAS[1]:
        srgb = colour_space("srgb")
        return srgb if primaries is None else curved_space("sRGB curve", srgb.to_linear, srgb.from_linear, primaries)
    if not 5000 <= gamma <= 1_000_000:  # damaged: exponents of 0.05 to 10 are usable
        return None
    return curved_space(f"gamma {100_000 / gamma:.3g}", *power_curve(100_000 / gamma), primaries or REC_709)


def _parse_chromaticities(chunk: bytes) -> Chromaticities | None:
    """Return the chromaticities of a PNG's cHRM in EXR's order; None if it is missing, spans no space or is Rec. 709.
    """
    if len(chunk) != 32:
        return None
    white_x, white_y, *primaries = (np.frombuffer(chunk, ">u4") / 100_000).tolist()
    values: Chromaticities = (*primaries, white_x, white_y)
    if np.abs(np.subtract(values, REC_709)).max() < CHROMATICITY_TOLERANCE:
        return None
    # Its determinant is twice the area between the primaries.
    triangle = np.array([[*primaries[0:2], 1], [*primaries[2:4], 1], [*primaries[4:6], 1]])
    return values if min(values[1::2]) > 0 and abs(np.linalg.det(triangle)) > 0.01 else None


def _inflate(data: bytes) -> bytes:
    """Uncompress a profile, up to its bound; empty where it is damaged."""
    try:
        return zlib.decompressobj().decompress(data, MAX_PROFILE_BYTES)
    except zlib.error:
        return b""
