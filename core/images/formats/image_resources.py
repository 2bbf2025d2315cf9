# SPDX-License-Identifier: GPL-3.0-or-later
"""Parses Photoshop's image resources (Adobe Photoshop File Formats Specification, "Image Resource Blocks"), which JPEG
and TIFF hold, to leave out the thumbnails: they show the picture as it was."""
from __future__ import annotations

_SIGNATURES = (b"8BIM", b"MeSa", b"PHUT", b"AgHg", b"DCSR")
"""First bytes of a resource; then follow its number, its name, the length of its data, and the data."""
_THUMBNAILS = (1033, 1036)
"""Numbers of the resources that hold a thumbnail: Photoshop 4's and later ones'."""


def without_thumbnails(resources: bytes) -> bytes:
    """Return image resources without thumbnails; from the first resource that cannot be parsed, all bytes stay."""
    others, offset = [], 0
    while resources[offset:offset + 4] in _SIGNATURES and len(resources) >= offset + 12:
        length_offset = offset + 7 + resources[offset + 6]  # after the name, padded to an even size
        length_offset += (length_offset - offset) % 2
        length = int.from_bytes(resources[length_offset:length_offset + 4], "big")
        end = length_offset + 4 + length + length % 2
        if length_offset + 4 + length > len(resources):
            break
        if int.from_bytes(resources[offset + 4:offset + 6], "big") not in _THUMBNAILS:
            others.append(resources[offset:end])
        offset = end
    return b"".join(others) + resources[offset:]
