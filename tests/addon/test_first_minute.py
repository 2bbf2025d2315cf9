# SPDX-License-Identifier: GPL-3.0-or-later
"""An artist's first minutes with the library, without a capture and without an engine."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture(scope="session")
def facts(run_look_script: Callable[[str], Any]) -> Any:
    return run_look_script("first_minute")


def test_one_button_shows_a_look_of_the_library(facts: Any) -> None:
    """Block of first_minute.py: "add flare"."""
    assert facts["in the box"] >= 12
    assert facts["added"] == ["FINISHED"]
    assert facts["added rows"] == [["Lamp 1", "light", "Lamp 1"]]
    assert facts["is lit"]
    assert facts["in the menu"] == ["_draw_menu"]


def test_a_flare_is_added_once_for_each_light(facts: Any) -> None:
    """Block of first_minute.py: "add flare"."""
    assert facts["added again"] == [["Lamp 1", "light", "Lamp 1"]]
    assert facts["added at another"] == [["Lamp 1", "light", "Lamp 1"], ["Lamp 2", "light", "Lamp 2"]]


def test_a_scene_without_a_light_in_view_gets_one(facts: Any) -> None:
    """Block of first_minute.py: "add flare"."""
    assert facts["none in view"] == ["Flare", "Anamorphic Blue", True]
    assert facts["beside a selected mesh"] == [["Lamp 1", "light", "Lamp 1"]]
    assert facts["a new one"] == ["Lamp 1", "Flare"]
    assert facts["without a camera"] == [True, ["Flare"], True]


def test_a_look_that_is_applied_again_doubles_nothing(facts: Any) -> None:
    """Block of first_minute.py: "another look"."""
    assert facts["two lights, one lamp"] == [["sun", "sun", "Lamp 1"], ["moon", "moon", ""]]
    assert facts["applied twice"] == facts["two lights, one lamp"]
    assert facts["opened twice"] == [["sun", "sun", "Lamp 1"], ["moon", "moon", "Lamp 2"]]


def test_another_look_keeps_lamps_and_sliders(facts: Any) -> None:
    """Block of first_minute.py: "another look"."""
    placed = [["sun", "lamp", "Lamp 1"], ["moon", "lamp", "Lamp 2"]]
    assert facts["another look"] == [placed, 0.25, 0.5, [1, 0.5, 0.25]]
    assert facts["back again"] == [[["sun", "sun", "Lamp 1"], ["moon", "moon", "Lamp 2"]], 0.25, 0.5, 2.0]


def test_an_entry_of_the_library_keeps_its_edits(facts: Any) -> None:
    """Block of first_minute.py: "the library keeps edits"."""
    same, count, brightness = facts["edits"]
    assert same and count == 6
    assert brightness == pytest.approx(1, abs=1e-3)
    assert facts["thumbnail differs"]


def test_applying_an_entry_keeps_what_the_artist_has_chosen(facts: Any) -> None:
    """Block of first_minute.py: "the library keeps edits"."""
    assert facts["chosen"] == [3, False, 1.5]
    assert facts["as fitted"] == [3, 1, 1]


def test_flares_of_deleted_lamps_are_removed_together(facts: Any) -> None:
    """Block of first_minute.py: "deleted lamps"."""
    assert facts["offered"] == ["Remove Flares of Deleted Lights (3)"]
    assert facts["left"] == [[["Lamp 3", "lamp", "Lamp 3"]], 0.5]
    assert "has its light object" in facts["none is lost"]


def test_looks_are_assets_and_a_dropped_one_flares(facts: Any) -> None:
    """Block of first_minute.py: "the asset browser"."""
    if not facts["reports drops"]:
        pytest.skip("this Blender does not report dropped assets; 4.3 does")
    assert facts["not listed by itself"]
    assert facts["offered as assets"] == [True, 1, 0, True]
    assert facts["dropped"] == ["Torch", [["Torch", "light", "Torch"], ["Torch.001", "light", "Torch.001"]], True]
    assert facts["taken out"]


def test_layers_are_baked_without_an_engine(facts: Any) -> None:
    """Block of first_minute.py: "bake without an engine"."""
    assert facts["no engine"]
    assert facts["baked"] == ["FINISHED"]
    assert facts["in the user's folder"], "the .blend is not saved, and the look is in the extension's folder"
    assert facts["frames"] == [["layers.0001.exr", "layers.0004.exr", "layers.0007.exr"], 4], "the frame step counts"
    assert facts["kept"]
    assert "needs the engine" in facts["scene of a fit"]


def test_the_frame_step_counts_in_ranges_and_warnings(facts: Any) -> None:
    """Block of first_minute.py: "bake without an engine"."""
    assert facts["warnings after the bake"] == [], "the frames between those of the Frame Step need no layers"
    assert facts["custom frames"] == [2, 5]
    (warning,) = facts["custom frame of a longer scene"]
    assert "has the frames 1-10 in steps of 3, and there are no layers of 10," in warning


def test_the_first_render_shows_the_flare(facts: Any) -> None:
    """Block of first_minute.py: "bake without an engine"."""
    assert facts["set up by itself"] and facts["is seen"]
    assert max(facts["first render"]) < 2e-3
    assert facts["live"] < 2e-3
    assert facts["left alone"], "with Composite Too switched off"


def test_a_flare_lies_over_a_stack_of_effects(facts: Any) -> None:
    """Block of first_minute.py: "a stack of effects"."""
    if not facts["has effects"]:
        pytest.skip("this Blender has no stack of compositor effects; 5.3 has")
    names, difference, left = facts["one effect"]
    assert (names, left) == (["Fit Flare"], 0)
    assert difference < 2e-3
    stacked, again, names, warned, restored = facts["beside others"]
    assert max(stacked, again) < 5e-3, "once, over the picture of all effects"
    assert names == ["half", "double"] and warned
    assert restored == 0


def test_a_scene_is_read_a_frame_at_a_time(facts: Any) -> None:
    """Block of first_minute.py: "reading a scene in steps"."""
    assert facts["read one"] == [1, 3, 1]
    assert facts["restored"] == 1
    assert "was deleted while" in facts["camera deleted while it reads"]
    during, ended = facts["another file is opened"]
    assert "A bake is running" in during and ended


def test_a_timer_reads_the_scene_and_can_be_cancelled(facts: Any) -> None:
    """Block of first_minute.py: "reading a scene in steps"."""
    calls, interval, fraction = facts["a frame in each call"]
    assert calls == [[interval, 1, 2], [interval, 2, 5], [interval, 3, 8]] and fraction == 1
    stopped = "Stopped before it began."
    assert facts["cancelled"] == [["FINISHED"], 4, True, stopped, None, 0], "the frame is the artist's again"
    assert facts["cancelled while the shot is written"] == [6, 0, True, 1, []]
    assert facts["read to the end"] == [True, 4, "", [3], True]
    assert facts["camera deleted between calls"] == [None, True, 4, True]


def test_a_single_picture_is_rendered_with_its_flare(facts: Any) -> None:
    """Block of first_minute.py: "a single picture"."""
    assert facts["picture"] == [1, 1, "Standard", "plate", 64]
    assert facts["picture is rendered"] == pytest.approx([0.0509, 0.214, 0.5225], abs=2e-3)
    assert facts["picture with its flare"] < 2e-3
    assert facts["picked"] == [["Flare", True], ["light1", False]], "the new light is moved first"
    assert facts["picture alone removed"] and facts["picture removed"]


def test_area_lights_flare_as_areas(facts: Any) -> None:
    """Block of first_minute.py: "lights that are areas"."""
    shape, size, emission, share = facts["area"]
    assert (shape, emission) == ("rectangle", pytest.approx(1))
    assert size == pytest.approx([2, 0, 1], abs=0.11)
    assert share == pytest.approx(0.5, abs=0.05)
    assert facts["half hidden"] == pytest.approx(0.5, abs=0.06)
    assert facts["from behind"] == 0
    assert facts["as a point"]
    assert facts["as a sphere"] == ["sphere", pytest.approx(0.5)]
    assert facts["as a mesh"] == ["points", [4, 0, 1]]
    assert "choose Point as its extent" in facts["an area of nothing"]


def test_bake_and_camera_view_agree_on_an_area_light_behind_a_fence(facts: Any) -> None:
    """Block of first_minute.py: "lights that are areas"."""
    shares = 0.5, 0.48, 0.5  # of the lamp, exactly
    for (difference, ratio, brightest, share), exact in zip(facts["behind a fence"], shares, strict=True):
        assert brightest > 100, "in codes"
        assert difference < max(2, facts["a point"]), "in codes, as for points"
        assert ratio == pytest.approx(1, abs=0.01)
        assert share == pytest.approx(exact, abs=0.015)
