# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the pictures that belong to the names of a camera solve, a list or a mask, whatever program wrote the names.

Separators, the form of accents (NFC, NFD), the case of letters and the suffix may differ between a name and its file.
`Capture` and the importer of the add-on use it.
"""
from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from ..errors import CaptureError
from ..images.listing import SUFFIXES, pictures_below, pictures_in
from ..system.file_names import canonical_name, find_entry
from ..system.files import safe_join

_SUFFIX_ORDER = (".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".jfif", ".jpe")
"""Suffixes in the order in which they are tried where a name's own is not there: the deepest first."""
_SUFFIXES = (*_SUFFIX_ORDER, *sorted(SUFFIXES - set(_SUFFIX_ORDER)))


class PictureIndex:
    """The pictures below a folder, found by the names of frames elsewhere, which may have another suffix."""

    def __init__(self, folder: Path, folders: Iterable[Path] | None = None) -> None:
        """List the pictures below `folder`, or those of `folders`, without their subfolders."""
        self.paths = (pictures_below(folder) if folders is None else
                      [path for each in folders if each.is_dir() for path in pictures_in(each)])
        self.names = [path.relative_to(folder).as_posix() for path in self.paths]
        self._canonical: dict[str, str] = {}
        self._folded: dict[str, str] = {}
        for name in self.names:
            self._canonical.setdefault(canonical_name(name), name)
            self._folded.setdefault(canonical_name(name).casefold(), name)

    def find(self, frame: Path | str) -> str | None:
        """Return the name below the folder of a frame's picture, or None.

        Its own name is tried first, then other suffixes, then the same without regard to case.
        """
        name = canonical_name(frame)
        stem = PurePosixPath(name)
        keys = [name, *(str(stem.with_suffix(suffix)) for suffix in _SUFFIXES if stem.name)]
        keys += [f"{name}{suffix}" for suffix in _SUFFIXES]  # a name without its suffix
        for key in keys:
            if key in self._canonical:
                return self._canonical[key]
        return next((self._folded[key.casefold()] for key in keys if key.casefold() in self._folded), None)


def matching_pictures(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Map the names of frames to their pictures in `folder`, a layer of a capture such as removed/.

    Raises CaptureError where the folder has pictures and none belongs to a frame, or where one is a link that leads
    out.
    """
    matches: dict[str, Path] = {}
    layer = find_entry(folder.parent, folder.name)
    if layer is None or not layer.is_dir():
        return matches
    pictures = PictureIndex(layer)
    for name in names:
        safe_join(layer, name, CaptureError)  # raises for a name that leads out
        match = pictures.find(name)
        if match is not None:
            matches[name] = safe_join(layer, match, CaptureError)
    if pictures.paths and names and not matches:
        raise CaptureError(f"{layer} holds {len(pictures.paths)} pictures, the first {pictures.paths[0].name}, and "
                           f"none has the name of a frame, such as {names[0]}; give them the frames' names.")
    return matches


def mask_pictures(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Map the names of frames to their masks in `folder`: the same name, or with a suffix behind it as for COLMAP.

    0001.jpg has the mask 0001.png or 0001.jpg.png. Frames without a mask are left out.
    """
    masks: dict[str, Path] = {}
    mask_folder = find_entry(folder.parent, folder.name)
    if mask_folder is None or not mask_folder.is_dir():
        return masks
    pictures = PictureIndex(mask_folder)
    for name in names:
        match = pictures.find(f"{name}.png") or pictures.find(name)
        if match is not None:
            masks[name] = safe_join(mask_folder, match, CaptureError)
    return masks


def view_name(name: str, starts_at_capture: bool) -> str:
    """Return a frame's name with forward slashes and composed accents, below images/ where it starts from there."""
    text = str(PurePosixPath(unicodedata.normalize("NFC", name.replace("\\", "/"))))
    return text[len("images/"):] if starts_at_capture and text.casefold().startswith("images/") else text
