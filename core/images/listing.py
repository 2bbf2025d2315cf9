# SPDX-License-Identifier: GPL-3.0-or-later
"""Lists the picture files of folders, by suffix, without hidden files."""
from __future__ import annotations

from pathlib import Path

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr"})


def pictures_in(folder: Path) -> list[Path]:
    """List the pictures of a folder by name, without hidden ones: macOS keeps "._0001.png" beside 0001.png on foreign
    disks."""
    return sorted(path for path in folder.iterdir()
                  if path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith("."))


def pictures_below(folder: Path) -> list[Path]:
    """List the pictures in a folder and its subfolders by name, without hidden ones.

    Broken links are included, for the reader to report: the disk that they lead to may be offline.
    """
    return [path for path in sorted(folder.rglob("*"))
            if path.suffix.lower() in SUFFIXES and (path.is_file() or (path.is_symlink() and not path.exists()))
            and not any(part.startswith(".") for part in path.relative_to(folder).parts)]
