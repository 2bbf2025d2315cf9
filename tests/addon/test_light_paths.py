# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights that move become paths of lights.json and come back as keys; tracks of a clip are lights on the picture."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture(scope="session")
def facts(run_script: Callable[[str, int], Any]) -> Any:
    return run_script("light_paths", 5)


def test_a_lamp_on_a_moving_car_is_written_as_a_path(facts: Any) -> None:
    """Block of light_paths.py: "parented to something that moves, and dimmed"."""
    assert facts["on a car"] == [[0, 0.5, 0], [2, 0.5, 0]] and facts["between"]
    assert facts["current frame"] and facts["others stand"] == ["lamp"]


def test_the_panel_names_the_lights_that_are_fitted_along_their_animation(facts: Any) -> None:
    """Block of light_paths.py: "parented to something that moves, and dimmed"."""
    assert "Fitted along the animation, frame by frame: headlight." in facts["panel"]
    assert facts["icons"] == ["ANIM", "LIGHT_POINT"]


def test_the_brightness_of_a_dimmed_lamp_is_written(facts: Any) -> None:
    """Block of light_paths.py: "parented to something that moves, and dimmed"."""
    assert facts["dimmed"] == [1.0, 0.5]


def test_exposure_and_temperature_of_a_lamp_are_its_brightness(facts: Any) -> None:
    """Lamps have both from Blender 4.5 on.

    Block of light_paths.py: "parented to something that moves, and dimmed".
    """
    assert facts["pushed by physics"]
    if "keyed exposure" in facts:
        assert facts["keyed exposure"] == [1.0, 0.25]
        assert facts["keyed temperature"] and facts["temperature is measured"] == [True, True]


def test_a_path_becomes_keys_that_an_artist_corrects(facts: Any) -> None:
    """Block of light_paths.py: "read back, and corrected"."""
    assert facts["keyed between"] == pytest.approx([0.2, 0, 0.5], abs=1e-4)
    assert facts["corrected"] == [[0, 0, 0.5], [0.4, 0.25, 0.5]]
    assert facts["brightness stays"] == [1.0, 0.5] and facts["no longer doubtful"]


def test_lights_are_tracks_of_a_clip_and_back(facts: Any) -> None:
    """Block of light_paths.py: "the Movie Clip Editor"."""
    assert facts["clip"] == facts["written back"] == ""
    assert facts["markers"] == [[10, 8, False], [12, 9, True], [14, 10, False]]
    places = [place for place, _ in facts["picture"]]
    assert places[0] == [10, 8] and not places[1] and places[2] == pytest.approx([20, 11], abs=0.01)
    assert [on for _, on in facts["picture"]] == [1.0, 0.5, None]
