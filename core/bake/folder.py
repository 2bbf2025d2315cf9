# SPDX-License-Identifier: GPL-3.0-or-later
"""A folder of baked layers as Blender reads it: one numbered sequence of EXR files. The add-on and `compose` open it.
"""
from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

from ..errors import FrameError
from ..images.exr import exr_pixel_aspect
from ..images.formats import exr_header
from ..images.size import picture_size
from ..images.window import DataWindow
from ..system.reading import open_regular
from ..system.steps import FRAMES_PER_STEP, Steps, finish

_NUMBERED = re.compile(r"(.*?)(\d+)\.exr", re.IGNORECASE)


@dataclass(frozen=True)
class LayerFolder:
    """Frame numbers, in order, and the file of each. Numbers may have gaps."""

    folder: Path
    files: dict[int, Path]

    @classmethod
    def open(cls, folder: Path | str) -> LayerFolder:
        """Open a folder. Raises FrameError for what Blender cannot show: no numbered EXR files, more than one sequence,
        a truncated file, and frames that differ in their layers or data windows.

        Blender reads the names of the layers from the first frame alone. It ignores data windows, so it would show a
        frame with another window, or with a part of the picture, in the wrong place.
        """
        return finish(cls.open_in_steps(folder))

    @classmethod
    def open_in_steps(cls, folder: Path | str) -> Steps[LayerFolder]:
        """Open a folder as `open` does, in steps of FRAMES_PER_STEP frames. Raises FrameError."""
        folder = Path(folder).resolve()
        files = _find_sequence(folder)
        headers: dict[Path, _Header] = {}
        distinct_headers: dict[_Header, _Header] = {}
        for path in files.values():
            header = _read_header(path)
            headers[path] = distinct_headers.setdefault(header, header)  # frames of a bake share one
            if len(headers) % FRAMES_PER_STEP == 0:
                yield
        first, *others = files.values()
        for path in others:
            if headers[path].layers != headers[first].layers:
                only_first, only_other = (" and ".join(sorted(headers[a].layers - headers[b].layers)) or "no others"
                                          for a, b in ((first, path), (path, first)))
                raise FrameError(f"{folder} holds frames of two bakes: beside the layers that both have, {first.name} "
                                 f"has {only_first}, {path.name} has {only_other}; bake each into its own folder.")
        _check_windows(folder, {path: header.window for path, header in headers.items()})
        return cls(folder, files)

    def window(self, number: int | None = None) -> DataWindow:
        """Return the data window of a frame, by default of the first, from its header: where its pixels lie."""
        path = self.files[self.first if number is None else number]
        with open_regular(path) as stream:
            return _read_window(path, stream)

    @property
    def first(self) -> int:
        return min(self.files)

    @property
    def last(self) -> int:
        return max(self.files)

    def size(self) -> tuple[int, int]:
        """Return (width, height) of the first frame, from its header."""
        return picture_size(self.files[self.first])

    def pixel_aspect(self) -> float:
        """Return the width of the first frame's pixels relative to their height."""
        return exr_pixel_aspect(self.files[self.first])


def _find_sequence(folder: Path) -> dict[int, Path]:
    """Return the numbered EXR files of a folder by number, in order. Raises FrameError where there are none, or more
    than one sequence."""
    sequences: dict[str, dict[int, Path]] = {}
    for path in sorted(folder.glob("*")):
        match = _NUMBERED.fullmatch(path.name)
        if match and not path.name.startswith("."):
            sequences.setdefault(match[1], {})[int(match[2])] = path
    if not sequences:
        subfolders = sorted({path.parent.name for path in folder.glob("*/*") if _NUMBERED.fullmatch(path.name)})
        if subfolders:
            raise FrameError(f"{folder} holds its layers in {', '.join(subfolders)}; choose one of these.")
        raise FrameError(f"{folder} holds no baked layers (files such as layers.0001.exr); bake into it first.")
    if len(sequences) > 1:
        prefixes = " and ".join(f"{prefix}*.exr" for prefix in sorted(sequences)[:2])
        raise FrameError(f"{folder} holds more than one sequence ({prefixes}); keep each in a folder of its own.")
    return dict(sorted(next(iter(sequences.values())).items()))


class _Header(NamedTuple):
    """The names of the layers in a file, of which the composite has none, and its data window."""

    layers: frozenset[str]
    window: DataWindow


def _read_header(path: Path) -> _Header:
    """Read the header of a file, which is opened once. Raises FrameError where it is missing, truncated or no EXR."""
    try:
        with open_regular(path) as stream:
            if stream.read(4) != exr_header.MAGIC:
                raise FrameError(f"{path} is not an EXR; bake it again.")
            if exr_header.is_truncated(stream):
                raise FrameError(f"{path} ends before its last lines; bake it again.")
            names = exr_header.channel_kinds(stream)
            if not names:
                raise FrameError(f"{path} has a damaged header; bake it again.")
            return _Header(frozenset(name.rpartition(".")[0] for name in names) - {""}, _read_window(path, stream))
    except OSError as problem:
        raise FrameError(f"{path} cannot be read: {problem.strerror or problem}.") from problem


def _read_window(path: Path, stream: BinaryIO) -> DataWindow:
    """Return the data window of a file from its open stream. Raises FrameError where its header is damaged."""
    corners = exr_header.window_corners(stream)
    if len(corners) < 2:
        raise FrameError(f"{path} has a damaged header; bake it again.")
    (x0, y0, x1, y1), (left, top, right, bottom) = corners["dataWindow"], corners["displayWindow"]
    return DataWindow((x1 - x0 + 1, y1 - y0 + 1), (x0 - left, y0 - top), (right - left + 1, bottom - top + 1))


def _check_windows(folder: Path, windows: Mapping[Path, DataWindow]) -> None:
    """Raise FrameError for data windows by which the compositor would show layers in the wrong place. windows: by the
    file, the first frame first."""
    partial = next((path for path, window in windows.items() if not window.holds_frame), None)
    if partial is not None:
        raise FrameError(f"{partial} stores a part of its frame, which Blender shows in another place; bake or "
                         "transfer it again.")
    first = next(iter(windows))
    other = next((path for path, window in windows.items() if window != windows[first]), None)
    if other is not None and not all(window.is_frame for window in windows.values()):
        raise FrameError(f"{folder} holds layers whose data windows differ ({first.name}, {other.name}), and "
                         "Blender shows these in other places; bake or transfer them again.")
