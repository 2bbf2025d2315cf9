# SPDX-License-Identifier: GPL-3.0-or-later
"""Frame numbers of views, and the files of their layers, from the names of the views.

A view's frame number is the number its name ends with ("DSC_0123.JPG" is frame 123), so that layers line up with the
footage; views without one come after the last that has one. Where no name of a folder has one, or two would share one,
the number is the one in which the names differ ("sh_9_comp.png" and "sh_10_comp.png" are 9 and 10); where they differ
otherwise, the views of that folder are counted from 1 in natural order. Ten digits and more are a time, not a number.
"""
from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath

from ..errors import SettingsError
from ..system.file_names import natural_key

_LAST_NUMBER = re.compile(r"(?<!\d)(\d{1,9})$")
_BELOW_0 = re.compile(r"[._]-\d+$")
_MAX_DIGITS = 9
"""Digits of a frame number; a longer number is a time."""


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
    """Number views by the rules at the top of this module; return them sorted by folder and number. The file of a view
    in a folder is in that folder too: `left/layers.0001.exr`.

    Raises SettingsError for a number below 0.
    """
    folders: dict[PurePosixPath, list[str]] = {}
    for view in views:
        folders.setdefault(PurePosixPath(view).parent, []).append(view)
    frames: list[NumberedFrame] = []
    for folder, names in sorted(folders.items()):
        parsed = {name: _parse_number(PurePosixPath(name)) for name in sorted(names, key=natural_key)}
        numbers = {name: number for name, number in parsed.items() if number is not None}
        if not numbers or len(set(numbers.values())) < len(numbers):
            numbers = _differing_numbers(list(parsed))
        next_number = max(numbers.values(), default=0) + 1
        numbers.update(zip((name for name in parsed if name not in numbers), itertools.count(next_number)))
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


def _differing_numbers(names: Sequence[str]) -> dict[str, int]:
    """Return the number in which the names differ, by name; empty unless they differ in exactly one number."""
    pieces = {name: re.split(r"(\d+)", PurePosixPath(name).stem) for name in names}
    if len(pieces) < 2 or len({len(name_pieces) for name_pieces in pieces.values()}) > 1:
        return {}
    differing = [column for column, values in enumerate(zip(*pieces.values(), strict=True)) if len(set(values)) > 1]
    if len(differing) != 1 or differing[0] % 2 == 0:  # `re.split` puts texts at even indices, numbers at odd ones
        return {}
    numbers = {name: name_pieces[differing[0]] for name, name_pieces in pieces.items()}
    if any(len(number) > _MAX_DIGITS for number in numbers.values()):
        return {}
    number_by_name = {name: int(number) for name, number in numbers.items()}
    return number_by_name if len(set(number_by_name.values())) == len(number_by_name) else {}


def number_sequences(paths: Iterable[Path]) -> dict[Path, int]:
    """Return the frame number of each plate; every sequence is numbered by itself (`number_views`).

    The plates of a folder are one sequence. If two of them have the same number, the folder is split into sequences by
    the names before the number: sh010.1001.png and sh020.1001.png are both frame 1001.
    """
    folders: dict[Path, list[Path]] = {}
    for path in dict.fromkeys(paths):
        folders.setdefault(path.parent, []).append(path)
    numbers: dict[Path, int] = {}
    for folder_paths in folders.values():  # one group, unless two plates share a number
        end_numbers = [number for path in folder_paths if (number := _parse_number(path)) is not None]
        groups: dict[tuple[str, str], list[Path]] = {}
        for path in folder_paths:
            match = _LAST_NUMBER.search(path.stem)
            key = ((path.stem[:match.start()], path.suffix.lower()) if match else ("", ""))
            groups.setdefault(key if len(set(end_numbers)) < len(end_numbers) else ("", ""), []).append(path)
        for group in groups.values():
            by_name = {path.name: path for path in group}
            numbers |= {by_name[frame.view]: frame.number for frame in number_views(by_name)}
    return numbers


def plates_by_number(pictures: Sequence[Path]) -> dict[int, Path]:
    """Map plates by the number that each name ends with; plates without one are left out.

    If no name ends with a number, the plates are numbered by the number in which their names differ, or else counted
    from 1 in natural order. Raises SettingsError where two share a number, or one has a number below 0.
    """
    plates: dict[int, Path] = {}
    for path in pictures:
        number = _parse_number(path)
        if number is None:
            continue
        if number in plates:
            raise SettingsError(f"{plates[number]} and {path} have one number; keep one sequence in a folder.")
        plates[number] = path
    if plates:
        return plates
    by_name = {path.name: path for path in pictures}
    return {frame.number: by_name[frame.view] for frame in number_views(by_name)}


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
        raise _no_frames_error(frames, text)
    return selected


def select_task_frames(frames: Sequence[NumberedFrame], text: str | None,
                       job_text: str | None = None) -> list[NumberedFrame]:
    """Return the frames in the list `text` of one task of a job; empty if the task has nothing to do.

    job_text: the list of frames of the whole job; None if unknown. If none of the task's frames exists, it has nothing
    to do as long as other frames of the job exist or, without `job_text`, its frames lie between existing ones;
    otherwise SettingsError is raised. text: None selects all frames.
    """
    if text is None:
        return list(frames)
    ranges, job_ranges = _parse_ranges(text), _parse_ranges(job_text) if job_text is not None else []
    numbers = sorted(frame.number for frame in frames)
    if any(number in job_range for number in numbers for job_range in ranges):
        return select_frames(frames, text)
    has_others = any(number in job_range for number in numbers for job_range in job_ranges)
    if not has_others and (job_text is not None or not _is_between(numbers, ranges)):
        raise _no_frames_error(frames, job_text or text)
    return []


def _is_between(numbers: Sequence[int], ranges: Sequence[range]) -> bool:
    """Return whether any of the ranges lies between the first and the last of the sorted numbers."""
    return bool(numbers) and any(numbers[0] < number_range[0] and number_range[-1] < numbers[-1]
                                 for number_range in ranges)


def _no_frames_error(frames: Sequence[NumberedFrame], text: str) -> SettingsError:
    """Return the error for a list `text` of which no frame exists."""
    numbers = [frame.number for frame in frames]
    existing = f"there are {min(numbers)} to {max(numbers)}" if frames else "there are none"
    return SettingsError(f"None of the frames {text!r} exists; {existing}.")


def missing_numbers(frames: Sequence[NumberedFrame], text: str | None) -> str:
    """Return the numbers in the list `text` that no frame has, as a list of the same form ("3,5-9"); "" where none is
    missing, or `text` is None."""
    existing, gaps = {frame.number for frame in frames}, []
    for numbers in _parse_ranges(text) if text is not None else []:
        # Indices of the range's numbers that exist, between two sentinels; a gap is where neighbours differ by more
        # than 1.
        present = [-1, *sorted(numbers.index(number) for number in existing if number in numbers), len(numbers)]
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
