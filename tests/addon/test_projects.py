# SPDX-License-Identifier: GPL-3.0-or-later
"""The files of a project are not overwritten, and are found after it moves."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture(scope="session")
def facts(run_script: Callable[[str, int], Any]) -> Any:
    return run_script("projects", 6)


@pytest.mark.parametrize("how", ["under other numbers", "over others"])
def test_plates_are_not_replaced_by_those_of_a_capture(facts: Any, how: str) -> None:
    """Block of projects.py: "plates in the folder that a capture is to go to"."""
    said, whole = facts[how]
    assert "exists already and would be replaced by" in said and "choose another folder" in said
    assert whole


def test_plates_in_the_folder_of_the_capture_are_used_in_place(facts: Any) -> None:
    """Block of projects.py: "plates in the folder that a capture is to go to"."""
    assert facts["under their own"] == ["", True]


def test_a_capture_can_be_written_again_but_not_from_its_own_pictures(facts: Any) -> None:
    """Block of projects.py: "plates in the folder that a capture is to go to"."""
    assert facts["made again"] == 6
    assert "would be replaced by" in facts["of its own pictures"]


def test_an_interrupted_capture_is_finished(facts: Any) -> None:
    """Block of projects.py: "plates in the folder that a capture is to go to"."""
    assert facts["begun before"] == ""


def test_plates_of_another_aspect_ratio_are_refused(facts: Any) -> None:
    """Block of projects.py: "plates in the folder that a capture is to go to"."""
    assert facts["of another shape"].endswith("is 64 x 40 pixels and the scene renders 1920 x 40, which is another "
                                              "aspect ratio; set the scene's resolution to that of the pictures.")


def test_a_camera_that_is_mirrored_or_skewed_is_refused_before_anything_is_written(facts: Any) -> None:
    """Block of projects.py: "plates in the folder that a capture is to go to"."""
    mirrored, skewed, written = facts["mirrored"]
    for said in (mirrored, skewed):
        assert said == ("The camera 'Camera' is mirrored or skewed at frame 1; apply the scale of it and of its "
                        "parents.")
    assert not written


def test_linked_plates_become_pictures_of_the_capture(facts: Any) -> None:
    """Block of projects.py: "plates that are links"."""
    if facts["links"] is None:
        pytest.skip("symbolic links cannot be made here")
    assert facts["links"] == [6, 6]


def test_plates_of_a_linked_camera_are_found_beside_its_file(facts: Any) -> None:
    """Block of projects.py: "a camera that is linked from another folder's .blend"."""
    assert facts["linked camera"]


def test_an_appended_scene_keeps_its_paths(facts: Any) -> None:
    """Block of projects.py: "a scene that is appended to another project"."""
    if facts["appended"] == [False, True] and not facts["tells of imports"]:
        pytest.skip("this Blender says nothing of what was appended")
    assert facts["appended"] == [True, True]


def test_footage_moves_with_its_project(facts: Any) -> None:
    """Block of projects.py: "a capture imported into a project that moves"."""
    assert facts["footage after a move"]
    assert facts["stills and sequences"] == [["FILE", 1], ["SEQUENCE", 1]]


def test_a_cancelled_import_leaves_nothing(facts: Any) -> None:
    """Block of projects.py: "an import that is cancelled"."""
    assert facts["cancelled import"] == [True] * 5


def test_the_scene_gets_the_objects_of_a_capture_in_portions(facts: Any) -> None:
    """Block of projects.py: "the objects of an import, in portions"."""
    first, portions, count, has_root, unused_collections = facts["portions of objects"]
    assert count > first + 4 and has_root, "the root, the scene's camera and the lights come first"
    assert portions == [*(min(number, count) for number in range(first + 2, count + 2, 2)), count]
    assert unused_collections == []


def test_an_import_that_is_closed_late_is_completed(facts: Any) -> None:
    """Block of projects.py: "an import whose window is closed after the scene has its camera"."""
    few, count, unused_collections = facts["closed after the scene has its camera"]
    assert few + 4 < count
    assert unused_collections == []


def test_an_import_leaves_every_other_turn_to_the_window(facts: Any) -> None:
    """Block of projects.py: "an import that leaves every other turn to the window".

    Steps that were done after each turn.
    """
    assert facts["turns"] == [0, 1, 1, 2, 2, 3, 3]


def test_an_import_ends_where_its_scene_is_deleted(facts: Any) -> None:
    """Block of projects.py: "an import whose scene is deleted". Whether nothing of it remains, and what ended."""
    *ended, calls = facts["scene deleted meanwhile"]
    assert ended == [True] * 3
    assert calls == ["window_manager.event_timer_remove", "workspace.status_text_set"]


def test_missing_footage_is_left_out_when_it_is_loaded(facts: Any) -> None:
    """Block of projects.py: "footage that is missing when it is loaded". Pictures that were tried."""
    assert facts["missing pictures"] == 2, "each is left out"


def test_a_cloud_is_sent_to_the_gpu_over_several_drawings(facts: Any) -> None:
    """Block of projects.py: "a large cloud"."""
    drawings, most = facts["cloud"]
    assert drawings == [[], [], [most], [most, most], [most, most, 5]]


def test_lights_follow_a_fit_in_a_scene_that_no_window_shows(facts: Any) -> None:
    """Block of projects.py: "a fit that ends while its scene is not the one in the window"."""
    assert facts["moved unseen"] < 1e-4


def test_the_chosen_flare_of_the_library_stays_chosen(facts: Any) -> None:
    """Block of projects.py: "another flare is saved into the library while one is chosen"."""
    assert facts["chosen"] == "zed"


def test_where_no_flare_of_the_library_is_chosen_it_is_the_first(facts: Any) -> None:
    """Block of projects.py: "another flare is saved into the library while one is chosen"."""
    assert facts["chosen at first"] == "mid"
    assert facts["chosen is gone"] == "aaa"
