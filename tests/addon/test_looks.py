# SPDX-License-Identifier: GPL-3.0-or-later
"""Other looks are tried on flares that an artist has edited: every choice stays, and nothing is left out silently."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture(scope="session")
def facts(run_look_script: Callable[[str], Any]) -> Any:
    return run_look_script("looks")


def test_edits_keys_and_drivers_of_elements_outlast_a_look_without_them(facts: Any) -> None:
    """Block of looks.py: "another look and back"."""
    assert facts["edited"] == [2.0, True, 0.5, 1.0, 0.25]
    assert facts["back"] == facts["after a tour"] == facts["edited"]
    assert facts["solo again"]
    assert facts["after a reset"] == [1.0, False, 1.0]


def test_edits_of_elements_that_a_look_lacks_show_nowhere(facts: Any) -> None:
    """Block of looks.py: "another look and back"."""
    assert facts["leaks"] == facts["shot"] == facts["saved"] == facts["headings"] == []
    assert facts["neutral"]
    assert facts["listed"] == [True, ["glare"], True, True]
    assert facts["listed, inverted by Blender"] == [True, True], "as a name is given, and without one"
    assert facts["highlight of a hidden one"] is None


def test_a_choice_against_the_file_stays(facts: Any) -> None:
    """Block of looks.py: "a choice against the file"."""
    assert facts["chosen against the file"] == [False, True, 0.0]
    assert facts["as fitted again"] == [False]


def test_each_flare_returns_to_the_light_of_its_first_look(facts: Any) -> None:
    """Block of looks.py: "two lights, one light, two lights"."""
    assert facts["each its own look"] == [True, ["light", "light"], ["sun", "moon"]]
    assert facts["without a light object"] == [[["sun", "sun", "Lamp 1"], ["moon", "moon", ""]], 0.25]


def test_a_selected_light_gets_a_flare_once(facts: Any) -> None:
    """Block of looks.py: "flares from selected"."""
    assert facts["pressed once"] == [
        ["Camera: a camera gets no flare",
         "Lamp 1: already has a flare from the light sun. Adjust Last Operation offers the other lights of the .flare"],
        [["Lamp 2", "sun", "Lamp 2"]]]
    reported, added = facts["pressed twice"]
    assert added == 1 and "Lamp 1, Lamp 2" in reported[-1]
    assert facts["another of its looks"] == [["FINISHED"], ["Lamp 1", "moon", "Lamp 1"]]
    assert facts["added again"] == [["Lamp 1, Lamp 2: already has a flare, so none was added"], 2]


def test_saving_names_what_the_library_does_not_store(facts: Any) -> None:
    """Block of looks.py: "saving several flares"."""
    assert facts["nothing left out"] == ["Both is in the library"]
    assert facts["one of two"] == ["One of Two is in the library, with the sliders of the panel Look as they are now. "
                                   "Not stored: the sliders of Lamp 2"]
    (text,) = facts["with switches"]
    assert text.endswith("Not stored: the sliders of Lamp 2, keys and drivers, the Follow switches, Extent and Light "
                         "Size of Lamp 1, Lamp 2")


def test_a_look_that_has_left_the_library_is_not_replaced_silently(facts: Any) -> None:
    """Block of looks.py: "files of the library change"."""
    is_chosen, refused, shown = facts["renamed while shown"]
    assert is_chosen and shown == "Muted"
    assert refused == "Muted was deleted from the library or renamed; choose another look."
    assert facts["chosen after"] == ["", True]
    assert facts["of the file"] == [True, 0.5]
    assert "is missing" in facts["deleted"] or "does not exist" in facts["deleted"] or "not found" in facts["deleted"]
    assert facts["after the deletion"] == [False, 0.0, 1.5], "only what the artist has chosen stays"


def test_a_file_that_was_replaced_outside_blender(facts: Any) -> None:
    """Block of looks.py: "files of the library change"."""
    assert facts["replaced"] == [["Lamp 1/glare.scale=2"], ""]
    assert facts["updated"]


def test_a_look_on_the_flare_of_a_deleted_lamp(facts: Any) -> None:
    """Block of looks.py: "a deleted lamp"."""
    text, rows = facts["no object selected"]
    assert text == "Lamp 1: choose the light object in the panel Look"
    assert rows == [["Lamp 1", "light", "Lamp 1"]]
    assert facts["placed anew"] == [[["Lamp 1", "light", "Lamp 2"]], 0.5]


def test_a_look_is_undone(facts: Any) -> None:
    """Block of looks.py: "undo after a look"."""
    assert facts["undone"] == ["Anamorphic Blue", 2.0, 1, ["Lamp 1"]]
    assert facts["redone"] == ["Wide Angle Sun", True]


@pytest.mark.parametrize("kind", ["linked copy", "full copy"])
def test_a_change_in_a_copied_scene_leaves_the_original_alone(facts: Any, kind: str) -> None:
    """Block of looks.py: "copies of a scene"."""
    placed, other, count, intensities = facts[kind]
    assert placed == [True, True]
    assert other == ["Anamorphic Blue", 0.0]
    assert count == 2
    assert intensities == [[1.0], [1.0, 1.0]]
