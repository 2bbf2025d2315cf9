# SPDX-License-Identifier: GPL-3.0-or-later
"""Light objects have the right positions, also when disabled or moved by a fit, and none is lost."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture(scope="session")
def facts(run_script: Callable[[str, int], Any]) -> Any:
    return run_script("lights", 5)


@pytest.mark.parametrize("how", ["visible", "disabled", "excluded"])
def test_a_disabled_light_follows_its_parent(facts: Any, how: str) -> None:
    """Block of lights.py: "switched off in the viewport"."""
    assert facts[f"on a car, {how}"] == [[0, 1, 0], [10, 1, 0]]
    assert facts[f"written, {how}"] == [10, 1, 0]


def test_a_disabled_light_with_animated_brightness_is_accepted(facts: Any) -> None:
    """Block of lights.py: "switched off in the viewport"."""
    assert facts["blinking"] == [[0, 1, 0], [10, 1, 0]]


def test_a_disabled_light_with_animated_position_is_refused(facts: Any) -> None:
    """Block of lights.py: "switched off in the viewport"."""
    assert facts["moved by itself"].startswith("'Headlamp' is disabled in the viewport")


@pytest.mark.parametrize("how", ["excluded", "disabled"])
def test_lights_of_a_disabled_capture_keep_their_positions(facts: Any, how: str) -> None:
    """Though Blender does not say where that is once the file is opened again.

    Block of lights.py: "the whole capture switched off, and the file opened again".
    """
    lamp, learned, added, placed, native = facts[f"capture {how}"]
    assert lamp == placed == learned
    assert added == [0, 0, 0]
    assert native


def test_a_light_keeps_its_position_when_it_is_parented(facts: Any) -> None:
    """Block of lights.py: "parented where it stood"."""
    assert facts["parented, brought back"] == [True, True, True]


@pytest.mark.parametrize("how", ["open", "closed"])
def test_lights_move_to_a_fit_whether_the_file_was_open_or_closed(facts: Any, how: str) -> None:
    """Block of lights.py: "a fit that has ended while the .blend was closed"."""
    assert facts[f"fitted, {how}"] == [True, True], "where it was learned, and known to be of this capture"


def test_found_lights_are_kept_until_they_are_used_or_removed(facts: Any) -> None:
    """Block of lights.py: "lights that were found while the .blend was closed"."""
    assert "found" in facts["found"]
    assert facts["kept"] == [{"name": "found", "xyz": [1, 2, 3], "score": 0.5}]
    names, left = facts["used"]
    assert "found" in names and not left
    names, left = facts["taken out"]
    assert "found" not in names and not left
    assert "found" not in facts["of the version before"]


def test_lights_moved_or_renamed_during_a_search_stay_so(facts: Any) -> None:
    """Block of lights.py: "lights that were found while the .blend was closed"."""
    names, off, error = facts["found meanwhile"]
    assert {"desk lamp", "more"} <= set(names)
    assert "lamp" not in names
    assert off < 1e-6
    assert not error


def test_a_scene_without_lights_gets_all_that_are_found(facts: Any) -> None:
    """Block of lights.py: "lights that were found while the .blend was closed"."""
    assert set(facts["found with none left"]) >= {"lamp", "more"}


def test_each_scene_with_the_capture_has_lights_of_its_own(facts: Any) -> None:
    """Block of lights.py: "other scenes with the capture: linked from a file, and made of this one's settings"."""
    assert facts["added in the second"] == ""
    assert facts["of each scene"] == {"Linked": ["lamp"], "First": ["lamp", "later"], "Second": ["later", "own"]}
    assert facts["beside a linked root"] == ["", True]


def test_removing_a_light_deletes_only_an_empty_made_for_it(facts: Any) -> None:
    """Block of lights.py: "an empty of one's own"."""
    assert facts["left by X"] == [True, False]


def test_lamps_that_are_not_rendered_do_not_flare(facts: Any) -> None:
    """Block of lights.py: "lamps that are not rendered"."""
    assert facts["lamps"] == ["Lamp On"]


def test_an_empty_as_the_active_camera_is_refused(facts: Any) -> None:
    """Block of lights.py: "an empty as the camera, and another file"."""
    assert not facts["no camera"]
    assert facts["an empty"].startswith("The scene's active camera is not a camera object")


def test_loading_a_file_clears_the_caches(facts: Any) -> None:
    """Block of lights.py: "an empty as the camera, and another file"."""
    assert facts["another file"] == ["", 0]


def test_a_light_can_be_picked_only_inside_the_picture(facts: Any) -> None:
    """However picking ends, cursor and status line are as they were before.

    Block of lights.py: "a click in the picture".
    """
    clicks = facts["clicks"]
    for beside in ("beside the picture", "below the view", "on the panel"):
        assert clicks[beside] == [["PASS_THROUGH"], False]
    assert clicks["on the light"] == [["FINISHED"], True]
    assert facts["clicked"] == [0.25, 0.75]
    for gone in ("the camera is gone", "the view is gone"):
        assert clicks[gone] == [["CANCELLED"], True]


def test_lamps_of_a_linked_asset_become_lights_with_an_override(facts: Any) -> None:
    """Block of lights.py: "lamps of a linked asset"."""
    assert facts["linked"] == {"linked": [False, []], "overridden": [True, ["Streetlamp"]]}
