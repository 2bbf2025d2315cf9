# SPDX-License-Identifier: GPL-3.0-or-later
"""Data of one shot or capture is not used for another, and is not deleted by accident."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture(scope="session")
def facts(run_script: Callable[[str, int], Any]) -> Any:
    return run_script("shots", 5)


def test_another_capture_has_its_own_run_and_lights(facts: Any) -> None:
    """Block of shots.py: "one capture after the other"."""
    assert facts["imported again"] == [True, "images", 1, 1]
    assert facts["another imported"] == ["", "none", 0]
    assert facts["shown of clean frames"], "whatever the suffix, as fits find them"
    assert not facts["another cleaned"]
    assert facts["the first's lights"] == 1
    assert facts["exported"] == ["", 2], "without a root all lights of the scene are where they stand"


def test_footage_changes_only_in_its_own_scene(facts: Any) -> None:
    """Block of shots.py: "footage that an artist's own nodes and another scene show too"."""
    assert facts["shared footage"] == [
        ["removed", "images", "removed", "images"], ["removed", "removed", "removed", "images"],
        ["images", "removed", "images", "images"], ["images"] * 4], "the artist's own node shows what it showed"
    assert facts["images of it"] == [3, 5], "no more than show different things, each of all frames"


def test_a_capture_from_a_camera_gets_the_newest_plates(facts: Any) -> None:
    """Block of shots.py: "a newer plate, from where pictures are linked and from where they have to be copied"."""
    assert facts["newer plates"] == [[True, True, ["000001.png"]]] * 2


def test_baked_frames_are_not_deleted_without_confirmation(facts: Any) -> None:
    """Block of shots.py: "frames of another bake"."""
    assert facts["as it was baked"] == ["", 1]
    said, begun, live = facts["colours no longer live"]
    assert "has layers of 4 frames from 1 to 4 that were baked" in said
    assert begun == 1 and live, "neither baked nor written down as if it were"
    assert facts["replaced"] == ["", 2]
    assert facts["all anew"] == ["", 3], "none is left that would be another's"
    assert "4 frames from 1 to 4" in facts["renamed"]


def test_edits_of_a_flare_without_a_light_are_not_baked(facts: Any) -> None:
    """Block of shots.py: "an edited flare without a light"."""
    (light,), texts = facts["edits"]
    assert texts == [f"{light}.intensity=2"]


def test_every_selected_camera_bakes_to_its_own_folder(facts: Any) -> None:
    """Block of shots.py: "chosen cameras"."""
    assert facts["one chosen"] == [facts["one chosen, read again"]] == ["Camera"]
    assert facts["the scene's own"] == [""]
    assert "has no layers of the camera 'Other', only of 'Camera'" in facts["renamed since"]
    assert "Stereoscopy" not in facts["renamed since"]
    assert facts["of an earlier bake"] == "Other_2", "which is kept beside those of the last"
    assert facts["none chosen"] == "No camera is selected; select those to bake from."


def test_a_moved_project_finds_its_files(facts: Any) -> None:
    """Block of shots.py: "a project that is saved for the first time, moved, and linked from elsewhere"."""
    assert facts["saved as a copy"], "the file that is open has no place yet"
    assert facts["saved first and moved"]
    assert facts["linked"]


def test_a_linked_scene_is_not_changed(facts: Any) -> None:
    """Block of shots.py: "a project that is saved for the first time, moved, and linked from elsewhere"."""
    why, engine = facts["changed when linked"]
    assert "The scene is linked from another file" in why
    assert not engine
