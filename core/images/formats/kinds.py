# SPDX-License-Identifier: GPL-3.0-or-later
"""Recognises formats by their first bytes, whatever a file is named, and by suffix where bytes do not say."""
from __future__ import annotations

from pathlib import Path
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
SUFFIX_OF_KIND: dict[str, str] = {kind: suffix for suffix, kind in reversed(SUFFIXES.items())}
"""The usual suffix of each format."""
JPEG_SUFFIXES = tuple(suffix for suffix, kind in SUFFIXES.items() if kind == "jpeg")
"""Suffixes of JPEGs; browsers on Windows save them as .jfif."""
VIDEOS = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts", ".wmv", ".mxf",
                    ".ts", ".m2t", ".vob", ".3gp", ".flv", ".ogv", ".dv"})
"""Suffixes of video files."""
_MAGIC: tuple[tuple[bytes, Kind], ...] = (
    (b"\x89PNG\r\n\x1a\n", "png"), (b"\xff\xd8", "jpeg"), (b"\x76\x2f\x31\x01", "exr"), (b"SDPX", "dpx"),
    (b"XPDS", "dpx"), (b"\x80\x2a\x5f\xd7", "cineon"), (b"\xd7\x5f\x2a\x80", "cineon"), (b"8BPS", "psd"),
    (b"BM", "bmp"), (b"#?RADIANCE", "hdr"), (b"#?RGBE", "hdr"), (b"GIF8", "gif"), (b"\0\0\0\x0cjP  \r\n", "jp2"),
    (b"\xff\x4f\xff\x51", "jp2"), (b"\xff\x0a", "jxl"), (b"\0\0\0\x0cJXL ", "jxl"))
_TIFFS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_VIDEO_MAGIC = (b"\x1a\x45\xdf\xa3", b"\x00\x00\x01\xba", b"\x06\x0e\x2b\x34", b"FLV\x01", b"OggS", b"\x30\x26\xb2\x75")
"""First bytes of Matroska, MPEG, MXF, Flash, Ogg and Windows Media."""
_HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"miaf")


def kind_of(head: bytes, suffix: str) -> Kind:
    """Return the format of a file by its first HEAD_BYTES, and by its suffix where a format has no signature."""
    suffix_kind = SUFFIXES.get(suffix.lower(), "")
    if head[:4] in _TIFFS or suffix_kind == "raw":  # most raw files are TIFFs by their first bytes
        return "raw" if suffix_kind == "raw" else "tiff"
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "webp"
    if head[4:8] == b"ftyp":
        brands = {head[8:12], *(head[offset:offset + 4] for offset in range(16, len(head) - 3, 4))}
        if brands & {b"avif", b"avis"}:
            return "avif"
        return "heif" if brands.intersection(_HEIF_BRANDS) else ""
    for magic, kind in _MAGIC:
        if head.startswith(magic):
            return kind
    return "tga" if suffix_kind == "tga" else ""


def is_video(path: Path) -> bool:
    """Return whether a file's name is a video's."""
    return path.suffix.lower() in VIDEOS


def holds_video(head: bytes) -> bool:
    """Return whether the first HEAD_BYTES of a file that is no picture are a video's."""
    is_box = head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide") and head[8:12] != b"crx "  # Canon's raw files
    return is_box or head.startswith(_VIDEO_MAGIC) or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")
