# SPDX-License-Identifier: GPL-3.0-or-later
"""Lists the picture files of folders, by suffix, without hidden files."""
from __future__ import annotations

from pathlib import Path

from ..system.file_names import natural_key
from .formats.kinds import SUFFIXES as KIND_BY_SUFFIX
from .formats.kinds import is_video

_SYSTEM_FILES = frozenset({"thumbs.db", "desktop.ini"})
"""Files that file managers leave, in lower case."""
SUFFIXES = frozenset(KIND_BY_SUFFIX)
"""Suffixes of pictures that are read, in lower case."""


def pictures_in(folder: Path) -> list[Path]:
    """List the pictures of a folder in natural order, without hidden ones: macOS keeps "._0001.png" beside 0001.png on
    foreign disks."""
    return sorted((path for path in folder.iterdir()
                   if path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith(".")),
                  key=natural_key)


def pictures_below(folder: Path) -> list[Path]:
    """List the pictures in a folder and its subfolders in natural order, without hidden ones.

    Broken links are included, for the reader to report: the disk that they lead to may be offline.
    """
    return [path for path in sorted(folder.rglob("*"), key=natural_key)
            if path.suffix.lower() in SUFFIXES and (path.is_file() or (path.is_symlink() and not path.exists()))
            and not any(part.startswith(".") for part in path.relative_to(folder).parts)]


def unlisted_entries(folder: Path, *, subfolders: bool = True) -> list[tuple[str, list[str]]]:
    """Return the names of a folder's entries that `pictures_in` leaves out, by reason: (reason, names).

    Hidden files and the systems' own (Thumbs.db, desktop.ini) are not mentioned. subfolders: mention subfolders
    that hold pictures, with their number.
    """
    names_by_reason: dict[str, list[str]] = {}
    for path in sorted(folder.iterdir(), key=natural_key):
        if path.name.startswith(".") or path.name.lower() in _SYSTEM_FILES:
            continue
        suffix = path.suffix.lower()
        if path.is_dir():
            count = len(pictures_below(path)) if subfolders else 0
            reason = f"a subfolder with {count} picture{'' if count == 1 else 's'}" if count else ""
        elif suffix in SUFFIXES:
            reason = "" if path.is_file() else "a link to a missing file" if path.is_symlink() else "not a file"
        elif is_video(path):
            reason = "a video, which is read by its own name"
        else:
            reason = f"{suffix[1:].upper()} is not read here" if suffix else "not a picture"
        if reason:
            names_by_reason.setdefault(reason, []).append(path.name)
    return list(names_by_reason.items())
