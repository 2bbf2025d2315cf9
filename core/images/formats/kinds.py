# SPDX-License-Identifier: GPL-3.0-or-later
"""Recognises formats by their first bytes, whatever a file is named, and by suffix where bytes do not say."""
from __future__ import annotations

from typing import Literal

Kind = Literal["png", "jpeg", "tiff", "exr", "webp", "dpx", "cineon", "psd", "bmp", "hdr", "tga", "gif", "jp2", "jxl",
               "heif", "avif", "raw", ""]
"""A format; "" for an unknown one."""
HEAD_BYTES = 32
"""First bytes of a file that `kind_of` needs."""
SUFFIXES: dict[str, Kind] = {
    ".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".jfif": "jpeg", ".jpe": "jpeg", ".tif": "tiff", ".tiff": "tiff",
    ".exr": "exr",
    ".webp": "webp", ".dpx": "dpx", ".cin": "cineon", ".psd": "psd", ".psb": "psd", ".bmp": "bmp", ".hdr": "hdr",
    ".tga": "tga", ".gif": "gif", ".jp2": "jp2", ".j2k": "jp2", ".j2c": "jp2", ".jxl": "jxl", ".heic": "heif",
    ".heif": "heif", ".hif": "heif", ".avif": "avif",
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"), "raw")}
"""The formats that are read, by suffix in lower case."""
JPEG_SUFFIXES = tuple(suffix for suffix, kind in SUFFIXES.items() if kind == "jpeg")
"""Suffixes of JPEGs; browsers on Windows save them as .jfif."""
_MAGIC: tuple[tuple[bytes, Kind], ...] = (
    (b"\x89PNG\r\n\x1a\n", "png"), (b"\xff\xd8", "jpeg"), (b"\x76\x2f\x31\x01", "exr"), (b"SDPX", "dpx"),
    (b"XPDS", "dpx"), (b"\x80\x2a\x5f\xd7", "cineon"), (b"\xd7\x5f\x2a\x80", "cineon"), (b"8BPS", "psd"),
    (b"BM", "bmp"), (b"#?RADIANCE", "hdr"), (b"#?RGBE", "hdr"), (b"GIF8", "gif"), (b"\0\0\0\x0cjP  \r\n", "jp2"),
    (b"\xff\x4f\xff\x51", "jp2"), (b"\xff\x0a", "jxl"), (b"\0\0\0\x0cJXL ", "jxl"))
_TIFFS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"miaf")


def kind_of(head: bytes, suffix: str) -> Kind:
    """Return the format of a file by its first HEAD_BYTES, and by its suffix where a format has no signature."""
    named = SUFFIXES.get(suffix.lower(), "")
    if head[:4] in _TIFFS or named == "raw":
        return "raw" if named == "raw" else "tiff"
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "webp"
    if head[4:8] == b"ftyp":
        brands = {head[8:12], *(head[at:at + 4] for at in range(16, len(head) - 3, 4))}
        if brands & {b"avif", b"avis"}:
            return "avif"
        return "heif" if brands.intersection(_HEIF_BRANDS) else ""
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return kind
    return "tga" if named == "tga" else ""
