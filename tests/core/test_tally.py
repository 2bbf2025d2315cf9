# SPDX-License-Identifier: GPL-3.0-or-later
"""The sentence that counts what a command used and left out, and the order and form of file names."""
from __future__ import annotations

import json
from pathlib import Path

import pytest

from core.system.file_names import canonical_name, natural_key
from core.system.tally import MAX_NAMES, MAX_REASONS, Tally


def test_a_complete_folder_leaves_nothing_out() -> None:
    tally = Tally("plate", "cleaned")
    tally.use(2)
    assert tally.summary() == "2 plates cleaned, none left out."
    tally = Tally()
    tally.use()
    assert tally.summary() == "1 frame used, none left out."


def test_names_are_listed_by_reason_in_natural_order() -> None:
    tally = Tally()
    tally.use(14)
    tally.skip("a video", "cut.mov")
    tally.skip("HEIC needs pillow-heif", "10.heic", "9.heic", "11.heic", "12.heic", "9.heic")
    assert tally.summary() == ("14 frames used; 5 left out: 9.heic, 10.heic, 11.heic and 1 more (HEIC needs "
                                "pillow-heif), cut.mov (a video).")
    assert tally.as_result() == {"used": 14, "left_out": 5, "skipped": [
        {"name": "cut.mov", "reason": "a video"},
        *({"name": f"{n}.heic", "reason": "HEIC needs pillow-heif"} for n in (9, 10, 11, 12))]}
    json.dumps(tally.as_result())


def test_a_long_list_of_reasons_is_cut() -> None:
    tally = Tally()
    for number in range(MAX_REASONS + 3):
        tally.skip(f"reason {number}", f"{number}.png")
    assert tally.summary().count("(") == MAX_REASONS
    assert "7 left out" in tally.summary() and tally.summary().endswith("and 3 for other reasons.")
    tally.skip("reason 0", *(f"{n}.jpg" for n in range(9)))
    assert f"and {10 - MAX_NAMES} more (reason 0)" in tally.summary()


def test_tallies_are_merged() -> None:
    whole, part = Tally(), Tally()
    part.skip("no pose", "a.png", "b.png")
    whole.skip("no pose", "b.png")
    whole.merge(part.skipped.items())
    assert whole.skipped == {"no pose": ["b.png", "a.png"]} and whole.left_out == 2


@pytest.mark.parametrize(("names", "order"), [
    (["10.png", "9.png", "1.png"], ["1.png", "9.png", "10.png"]),
    (["b/1.png", "a/10.png", "a/9.png"], ["a/9.png", "a/10.png", "b/1.png"]),
    (["s2/f1.png", "s10/f1.png", "s2/f10.png"], ["s2/f1.png", "s2/f10.png", "s10/f1.png"]),
    (["v1.10.exr", "v1.9.exr", "v0.11.exr"], ["v0.11.exr", "v1.9.exr", "v1.10.exr"]),
    (["a.png", "a2.png", "9b.png"], ["9b.png", "a2.png", "a.png"]),
    ([f"{'9' * 5000}.png", "1.png"], ["1.png", f"{'9' * 5000}.png"]),
])
def test_names_are_ordered_by_number(names: list[str], order: list[str]) -> None:
    assert sorted(names, key=natural_key) == order
    assert sorted(map(Path, reversed(names)), key=natural_key) == list(map(Path, order))


def test_equal_numbers_keep_a_fixed_order() -> None:
    names, other = ["01.png", "1.png", "001.png"], ["1.png", "001.png", "01.png"]
    assert sorted(names, key=natural_key) == sorted(other, key=natural_key)


@pytest.mark.parametrize("name", ["sub\\bu\u0308ro.JPG", "./sub/bu\u0308ro.jpg", "sub//b\u00fcro.Jpg"])
def test_a_name_has_one_form(name: str) -> None:
    """Names that differ in separators, Unicode normalisation or the case of their suffix have one canonical form."""
    assert canonical_name(name) == "sub/b\u00fcro.jpg"
    assert canonical_name("sub\\frame") == "sub/frame"
