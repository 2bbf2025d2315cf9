# SPDX-License-Identifier: GPL-3.0-or-later
"""Which views are which frames: numbers for a sequence, from the names of the views.

A view's frame number is the number its name ends with ("DSC_0123.JPG" is frame 123), so that layers line
up with the footage; views without one come after the last that has one. Where no name of a folder has one, or two
would share one, the views of that folder are counted from 1 in their order. Ten digits and more are a time, and no
number.
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
class Frame:
    """A view's name, its number, and the file (relative, with forward slashes) its layers go to."""

    view: str
    number: int
    file: str


def layers_file(folder: PurePosixPath | str, number: int) -> str:
    """A frame's file in its folder, "" for none."""
    return str(PurePosixPath(folder) / f"layers.{number:04d}.exr")


def numbered(views: Iterable[str]) -> list[Frame]:
    """Frames for views, by folder and number. A view in a folder keeps the folder: `left/layers.0001.exr`. Raises
    SettingsError for a number below 0."""
    folders: dict[PurePosixPath, list[str]] = {}
    for view in views:
        folders.setdefault(PurePosixPath(view).parent, []).append(view)
    frames: list[Frame] = []
    for folder, names in sorted(folders.items()):
        found = {name: _number(PurePosixPath(name)) for name in sorted(names)}
        numbers = {name: number for name, number in found.items() if number is not None}
        if len(set(numbers.values())) < len(numbers):
            numbers = {}
        after = max(numbers.values(), default=0) + 1
        numbers.update(zip((name for name in found if name not in numbers), itertools.count(after)))
        pairs = sorted((number, name) for name, number in numbers.items())
        frames += [Frame(name, number, layers_file(folder, number)) for number, name in pairs]
    return frames


def _number(name: PurePath) -> int | None:
    """The number that a name ends with, None where it has none. Raises SettingsError where it is below 0."""
    if _BELOW_0.search(name.stem):
        raise SettingsError(f"{name} has a frame number below 0, which no layers can have; number the frames anew, "
                            "from 0 or more.")
    match = _LAST_NUMBER.search(name.stem)
    return int(match[1]) if match else None


def plates_by_number(pictures: Sequence[Path]) -> dict[int, Path]:
    """Plates by the number that each name ends with; those without one are no plates of the sequence, unless none has
    one: then they are counted from 1 in their order. Raises SettingsError where two have one number, or one has one
    below 0."""
    found: dict[int, Path] = {}
    for path in pictures:
        number = _number(path)
        if number is None:
            continue
        if number in found:
            raise SettingsError(f"{found[number]} and {path} have one number; keep one sequence in a folder.")
        found[number] = path
    return found or dict(enumerate(sorted(pictures), 1))


def chosen(frames: Sequence[Frame], text: str | None) -> list[Frame]:
    """The frames that `text` asks for: numbers, and ranges, by steps too: "3", "1-20", "1-20:2", "1-20,31,40-44"; None
    asks for all.

    Raises SettingsError where the text is no such list or asks for no frame that there is.
    """
    if text is None:
        return list(frames)
    asked = _asked(text)
    result = [frame for frame in frames if any(frame.number in some for some in asked)]
    if not result:
        there = f"{frames[0].number} to {frames[-1].number}" if frames else "none"
        raise SettingsError(f"None of the frames {text!r} is there: they are {there}.")
    return result


def absent(frames: Sequence[Frame], text: str | None) -> str:
    """Which numbers `text` asks for that no frame has, as such a text; "" where there is none."""
    known, gaps = {frame.number for frame in frames}, []
    for some in _asked(text) if text is not None else []:
        there = [-1, *sorted(some.index(number) for number in known if number in some), len(some)]
        gaps += [some[before + 1:after] for before, after in itertools.pairwise(there) if after > before + 1]
    return ",".join(str(gap[0]) if len(gap) == 1 else f"{gap[0]}-{gap[-1]}" + f":{gap.step}" * (gap.step > 1)
                    for gap in gaps)


def _asked(text: str) -> list[range]:
    """Raises SettingsError where the text is no list of frames."""
    ranges = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*(?::\s*(\d{1,9})\s*)?)?", part)
        if not match or int(match[2] or match[1]) < int(match[1]) or (match[3] and not int(match[3])):
            raise SettingsError(f"The frames {text!r} are not a list of numbers and ranges such as 1-20,31 or 1-99:2.")
        ranges.append(range(int(match[1]), int(match[2] or match[1]) + 1, int(match[3] or 1)))
    return ranges
