# SPDX-License-Identifier: GPL-3.0-or-later
"""Frame numbers of names in any form, of several sequences, and the frames of one task of a farm."""
from __future__ import annotations

from pathlib import Path

import pytest

from core.conventions.frame_numbers import (
    number_sequences,
    number_views,
    plates_by_number,
    select_task_frames,
)
from core.errors import SettingsError


@pytest.mark.parametrize(("names", "expected"), [
    (["sh_10_comp.png", "sh_11_comp.png", "sh_9_comp.png"], [9, 10, 11]),
    (["shot/10_v2.exr", "shot/9_v2.exr"], [9, 10]),  # all end with one number, which is no frame's
    (["IMG_9.edit.jpg", "IMG_100.edit.jpg"], [9, 100]),
    (["a1.jpg", "a10.jpg", "a2.jpg"], [1, 2, 10]),
    (["x10.a.png", "x9.a.png", "x9.b.png"], [1, 2, 3]),  # in natural order, since more than a number differs
    (["t1700000010_a.png", "t1700000009_a.png"], [1, 2]),  # times
])
def test_views_are_numbered_by_the_number_in_which_their_names_differ(names: list[str], expected: list[int]) -> None:
    frames = number_views(names)
    assert [frame.number for frame in frames] == expected
    numbers = [int("".join(filter(str.isdigit, Path(frame.view).stem.split("_v2")[0])) or 0) for frame in frames]
    assert numbers == sorted(numbers)


def test_plates_without_a_final_number_follow_the_shot_by_their_own() -> None:
    pictures = [Path("sh_10_comp.png"), Path("sh_9_comp.png")]
    assert plates_by_number(pictures) == {9: pictures[1], 10: pictures[0]}


def test_each_sequence_has_its_own_numbers() -> None:
    paths = [Path(f"a/sh{shot}.{number}.png") for shot in ("010", "020") for number in (1001, 1002)]
    paths += [Path("b/x.1001.exr"), Path("b/x.1002.exr"), Path("b/still.exr")]
    assert list(number_sequences(paths).values()) == [1001, 1002, 1001, 1002, 1001, 1002, 1003]
    mixed = [Path("c/x.1.exr"), Path("c/x.1.png"), Path("c/y.1.png")]
    assert set(number_sequences(mixed).values()) == {1}


def test_a_task_in_a_gap_has_nothing_to_do() -> None:
    frames = number_views(f"plate.{number}.png" for number in (1001, 1002, 1003, 1007, 1008, 1009))
    for first in range(1001, 1012, 3):
        for size in (1, 2, 3):
            expected = [number for number in range(first, first + size) if number in (1001, 1002, 1003, 1007, 1008,
                                                                                      1009)]
            task = select_task_frames(frames, f"{first}-{first + size - 1}", "1001-1012")
            assert [frame.number for frame in task] == expected
    assert select_task_frames(frames, "1004-1006") == []
    assert select_task_frames(frames, None) == frames
    for task in (("1010-1012",), ("1004", "1004-1006"), ("2001-2003", "2001-2009")):
        with pytest.raises(SettingsError, match="None of the frames"):
            select_task_frames(frames, *task)
    with pytest.raises(SettingsError, match="not a list"):
        select_task_frames(frames, "1004", "all")
