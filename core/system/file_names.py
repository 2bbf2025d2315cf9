# SPDX-License-Identifier: GPL-3.0-or-later
"""Orders and compares the names of files: by number, and in one form whatever program wrote them.

Captures, plates and sequences are listed by `natural_key`; names in models and lists are compared by `canonical_name`.
"""
from __future__ import annotations

import re
import unicodedata
from functools import lru_cache
from pathlib import Path, PurePath, PurePosixPath

_DIGITS = re.compile(r"(\d+)")
_DRIVE = re.compile(r"[A-Za-z]:")
_MAX_DIGITS = 4000
"""Digits that Python converts to an integer."""


def natural_key(name: PurePath | str) -> list[tuple[tuple[int, int, str], ...]]:
    """Return the key of natural order, folder by folder: numbers in a name by value, so that 9 comes before 10.

    Names that are equal but for leading zeros or the form of their letters keep a fixed order by their text.
    """
    parts = PurePosixPath(str(name).replace("\\", "/")).parts
    return [*(_part_key(part) for part in parts), ((2, 0, str(name)),)]


@lru_cache(maxsize=1 << 14)
def _part_key(part: str) -> tuple[tuple[int, int, str], ...]:
    """Return the key of one part of a path: numbers as (0, value, ""), which come before texts as (1, 0, text)."""
    return tuple((0, int(piece), "") if piece.isascii() and piece.isdigit() and len(piece) < _MAX_DIGITS
                 else (1, 0, piece) for piece in _DIGITS.split(unicodedata.normalize("NFC", part)) if piece)


def canonical_name(name: PurePath | str) -> str:
    """Return one form of a relative path for comparison: forward slashes, no "./", NFC, suffix in lower case.

    Windows' tools write backslashes, macOS stores accents decomposed (NFD), and cameras write .JPG.
    """
    path = PurePosixPath(unicodedata.normalize("NFC", str(name).replace("\\", "/")))
    return str(path.with_suffix(path.suffix.lower())) if path.suffix else str(path)


def name_below(folder: Path, name: str) -> str:
    """Return the end of an absolute path, made on any machine, that is found below `folder`; other names unchanged.

    "D:/shots/one/images/1.png" is images/1.png if the folder has images/.
    """
    parts = PurePosixPath(name.replace("\\", "/")).parts
    if not parts or ".." in parts or not (parts[0] == "/" or _DRIVE.fullmatch(parts[0])):
        return name
    for first in range(1, len(parts)):
        # The file itself may be missing, but not the folder that it lies in.
        entry = find_entry(folder, "/".join(parts[first:-1] or parts[first:]))
        if entry is not None:
            return "/".join(parts[first:])
    return name


def find_entry(folder: Path, name: str) -> Path | None:
    """Return `folder / name` (forward slashes), in any case of letters where it does not exist as written; or None."""
    path = folder / name
    if path.exists():
        return path
    path = folder
    for part in name.split("/"):
        try:
            # Of names that differ in case alone, the first in order counts.
            entries = {entry.name.casefold(): entry for entry in sorted(path.iterdir(), reverse=True)}
        except OSError:
            return None
        match = entries.get(part.casefold())
        if match is None:
            return None
        path = match
    return path
