# SPDX-License-Identifier: GPL-3.0-or-later
"""Parses Photoshop's image resources (Adobe Photoshop File Formats Specification, "Image Resource Blocks"), which JPEG
and TIFF hold, to leave out the thumbnails: they show the picture as it was."""
from __future__ import annotations

_SIGNATURES = (b"8BIM", b"MeSa", b"PHUT", b"AgHg", b"DCSR")
"""First bytes of a resource; then follow its number, its name, the length of its data, and the data."""
_THUMBNAILS = (1033, 1036)
"""Numbers of the resources that hold a thumbnail: Photoshop 4's and later ones'."""


def without_thumbnails(resources: bytes) -> bytes:
    """Return image resources without thumbnails; what cannot be parsed stays byte for byte."""
    kept, at = [], 0
    while resources[at:at + 4] in _SIGNATURES and len(resources) >= at + 12:
        size_at = at + 7 + resources[at + 6]  # the name has a byte of length, and an even size in all
        size_at += (size_at - at) % 2
        length = int.from_bytes(resources[size_at:size_at + 4], "big")
        end = size_at + 4 + length + length % 2
        if size_at + 4 + length > len(resources):
            break
        if int.from_bytes(resources[at + 4:at + 6], "big") not in _THUMBNAILS:
            kept.append(resources[at:end])
        at = end
    return b"".join(kept) + resources[at:]
