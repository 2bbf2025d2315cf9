# SPDX-License-Identifier: GPL-3.0-or-later
"""Frame numbers of views, and the files of their layers, from the names of the views.

A view's frame number is the number its name ends with ("DSC_0123.JPG" is frame 123), so that layers line up with the
footage; views without one come after the last that has one. Where no name of a folder has one, or two would share one,
the views of that folder are counted from 1 in their order. Ten digits and more are a time, not a number.
"""
from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath

from ..errors import SettingsError

_LAST_NUMBER = re.compile(r"(?<!\d)(\d{1,9})$")
_BELOW_0 = re.compile(r"[._]-\d+$")


@dataclass(frozen=True)
class NumberedFrame:
    """A view's name, its number, and the file (relative, with forward slashes) of its layers."""

    view: str
    number: int
    file: str


def layers_file(folder: PurePosixPath | str, number: int) -> str:
    """Return the path of a frame's layers in a folder ("" for none)."""
    return str(PurePosixPath(folder) / f"layers.{number:04d}.exr")


def number_views(views: Iterable[str]) -> list[NumberedFrame]:
    """Return frames for views, by folder and number. A view in a folder keeps the folder: `left/layers.0001.exr`.

    Raises SettingsError for a number below 0.
    """
    folders: dict[PurePosixPath, list[str]] = {}
    for view in views:
        folders.setdefault(PurePosixPath(view).parent, []).append(view)
    frames: list[NumberedFrame] = []
    for folder, names in sorted(folders.items()):
        parsed = {name: _parse_number(PurePosixPath(name)) for name in sorted(names)}
        numbers = {name: number for name, number in parsed.items() if number is not None}
        if len(set(numbers.values())) < len(numbers):
            numbers = {}
        after = max(numbers.values(), default=0) + 1
        numbers.update(zip((name for name in parsed if name not in numbers), itertools.count(after)))
        pairs = sorted((number, name) for name, number in numbers.items())
        frames += [NumberedFrame(name, number, layers_file(folder, number)) for number, name in pairs]
    return frames


def _parse_number(name: PurePath) -> int | None:
    """Return the number that a name ends with, or None. Raises SettingsError where it is below 0."""
    if _BELOW_0.search(name.stem):
        raise SettingsError(f"{name} has a frame number below 0, which no layers can have; number the frames anew, "
                            "from 0 or more.")
    match = _LAST_NUMBER.search(name.stem)
    return int(match[1]) if match else None


def plates_by_number(pictures: Sequence[Path]) -> dict[int, Path]:
    """Map plates by the number that each name ends with; plates without one are left out.

    Where no plate has a number, they are counted from 1 in their order. Raises SettingsError where two share a number,
    or one has a number below 0.
    """
    plates: dict[int, Path] = {}
    for path in pictures:
        number = _parse_number(path)
        if number is None:
            continue
        if number in plates:
            raise SettingsError(f"{plates[number]} and {path} have one number; keep one sequence in a folder.")
        plates[number] = path
    return plates or dict(enumerate(sorted(pictures), 1))


def select_frames(frames: Sequence[NumberedFrame], text: str | None) -> list[NumberedFrame]:
    """Return the frames in the list `text` of numbers and ranges ("3", "1-20", "1-20:2", "1-20,31,40-44"); None selects
    all.

    Raises SettingsError for an invalid list, and where none of the frames exists.
    """
    if text is None:
        return list(frames)
    ranges = _parse_ranges(text)
    selected = [frame for frame in frames if any(frame.number in numbers for numbers in ranges)]
    if not selected:
        existing = f"there are {frames[0].number} to {frames[-1].number}" if frames else "there are none"
        raise SettingsError(f"None of the frames {text!r} exists; {existing}.")
    return selected


def missing_numbers(frames: Sequence[NumberedFrame], text: str | None) -> str:
    """Return the numbers in `text` that no frame has, as such a list; "" where there are none."""
    known, gaps = {frame.number for frame in frames}, []
    for numbers in _parse_ranges(text) if text is not None else []:
        present = [-1, *sorted(numbers.index(number) for number in known if number in numbers), len(numbers)]
        gaps += [numbers[before + 1:after] for before, after in itertools.pairwise(present) if after > before + 1]
    return ",".join(str(gap[0]) if len(gap) == 1 else f"{gap[0]}-{gap[-1]}" + f":{gap.step}" * (gap.step > 1)
                    for gap in gaps)


def _parse_ranges(text: str) -> list[range]:
    """Parse a list of numbers and ranges. Raises SettingsError where it is invalid."""
    ranges = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*(?::\s*(\d{1,9})\s*)?)?", part)
        if not match or int(match[2] or match[1]) < int(match[1]) or (match[3] and not int(match[3])):
            raise SettingsError(f"The frames {text!r} are not a list of numbers and ranges such as 1-20,31 or 1-99:2.")
        ranges.append(range(int(match[1]), int(match[2] or match[1]) + 1, int(match[3] or 1)))
    return ranges
