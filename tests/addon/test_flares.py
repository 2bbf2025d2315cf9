# SPDX-License-Identifier: GPL-3.0-or-later
"""Flares that are renamed, removed and animated keep their layers, sliders and keys."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blenders import Blender
from test_work import a_flare

from core.bake.exr import write_layers
from core.bake.layers import FrameLayers
from core.system.files import write_json

SCRIPT = Path(__file__).parent / "scripts" / "flares.py"
SCENE, PLATE, LAMP, KEY, RIM = 0.125, 0.5, 0.25, 0.5, 1.0


@pytest.fixture(scope="session")
def facts(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Write layers of two and of three lights and run the script on them in Blender; return its facts."""
    base = tmp_path_factory.mktemp("flares")
    layers, more = base / "layers", base / "more"
    scene, lamp, key, rim = (np.full((8, 16, 3), value, np.float32) for value in (SCENE, LAMP, KEY, RIM))
    for number in range(1, 4):
        flares = {"lamp": lamp, "key": key}
        write_layers(layers / f"layers.{number:04d}.exr", FrameLayers(scene, flares, scene[..., 0]))
        write_layers(more / f"layers.{number:04d}.exr", FrameLayers(scene, {**flares, "rim": rim}, scene[..., 0]))
    write_layers(base / "again.exr", FrameLayers(scene, {"lamp": rim, "key": key}, scene[..., 0]))
    write_json(layers / "live.json", {"lights": ["lamp", "key"]})
    return blender.run(SCRIPT, package, a_flare(base / "lamp.flare"), layers, more, base, user=base / "user")


def test_a_flare_keeps_its_layer_under_another_name(facts: Any) -> None:
    """Block of flares.py: "renamed"."""
    assert facts["both"] == SCENE + LAMP + KEY
    assert facts["renamed"] == [SCENE + 2 * LAMP + KEY, True]
    assert facts["renamed, set up again"] == [SCENE + 2 * LAMP + KEY, True, True]


def test_a_layer_without_a_flare_shows_as_it_was_baked(facts: Any) -> None:
    """Block of flares.py: "renamed"."""
    assert facts["unknown now"] == [SCENE + KEY, SCENE + LAMP + KEY]


def test_the_others_stay_live_when_a_flare_is_removed(facts: Any) -> None:
    """Block of flares.py: "removed"."""
    assert facts["removed"] == [SCENE + LAMP + 3 * KEY, True, SCENE + LAMP + KEY]


def test_a_file_of_an_earlier_version_keeps_its_drivers(facts: Any) -> None:
    """Block of flares.py: "drivers of an earlier version"."""
    assert facts["of an earlier version"] == [SCENE + 2 * LAMP + KEY, True] * 2


def test_drivers_without_a_flare_are_reported(facts: Any) -> None:
    """Block of flares.py: "dead drivers give a warning"."""
    assert "set it up again" in facts["dead"]


def test_keys_and_drivers_stay_with_their_flare(facts: Any) -> None:
    """Block of flares.py: "keyed"."""
    lamp, rim, added = facts["keyed"]
    assert lamp == ["lamp", 1, 1]
    assert rim == ["rim", 5, 2]
    assert added == [1, 1]


def test_keys_and_links_stay_with_their_slider_of_the_node(facts: Any) -> None:
    """Block of flares.py: "keyed"."""
    flare, more = (LAMP + KEY) / 2, (LAMP + KEY + RIM) / 2
    assert facts["keyed node"] == [SCENE + 4 * flare, SCENE + 4 * more, SCENE + more]


def test_an_artists_still_of_a_layer_stays_one(facts: Any) -> None:
    """Block of flares.py: "a layer that an artist looks at as a still"."""
    assert facts["still"] == ["FILE", "SEQUENCE"]


def test_a_frame_that_was_baked_again_is_shown(facts: Any) -> None:
    """Block of flares.py: "a frame that is shown is baked again"."""
    assert facts["baked again"] == [SCENE + LAMP + KEY, SCENE + RIM + KEY]
    assert facts["keeps frames"], "the cache of composited frames (5.3) is on as before"


def test_composited_frames_are_forgotten_after_a_bake(facts: Any) -> None:
    """Block of flares.py: "a frame that is shown is baked again".

    A render bypasses the cache of composited frames (5.3), so the assignments that free it are recorded.
    """
    switch = "use_compositor_frames_cache"
    assert facts["frames are forgotten"] == [[[[switch, False], [switch, True]], []], True]


def test_frames_without_layers_are_reported_and_show_no_flare(facts: Any) -> None:
    """Block of flares.py: "warnings about frames without layers and animated sliders"."""
    assert facts["all frames"] == []
    (warning,) = facts["too few"]
    assert "The scene has the frames 0-6, and there are no layers of 0,4-6," in warning
    last, *after = facts["after the last"]
    assert last == PLATE + LAMP + KEY
    if facts["missing is magenta"]:
        assert "which this version of Blender shows in magenta" in warning
    else:
        assert "which are without flare" in warning
        assert after == [PLATE, PLATE]


@pytest.mark.parametrize(("case", "sentence"), [
    ("switched off", "Compositing is switched off for this scene"),
    ("sequenced", "the video sequencer, which has 'title', in place of the compositor"),
    ("square", "The layers have 16 x 8 pixels and the scene renders 8 x 8, another aspect ratio"),
    ("stereo", "This scene renders stereo, and the compositor has no flare of its own for left and right"),
    ("transparent", "The film is transparent, and PNG files lose the flare"),
])
def test_renders_that_would_not_show_the_composite_give_a_warning(facts: Any, case: str, sentence: str) -> None:
    """Block of flares.py: "warnings about renders that would not show the composite as it is"."""
    (warning,) = facts[case]
    assert sentence in warning


@pytest.mark.parametrize("case", ["muted", "no alpha"])
def test_renders_that_show_the_composite_give_no_warning(facts: Any, case: str) -> None:
    """Block of flares.py: "warnings about renders that would not show the composite as it is"."""
    assert facts[case] == []


def test_animated_live_sliders_give_a_warning_for_farms(facts: Any) -> None:
    """Block of flares.py: "warnings about frames without layers and animated sliders"."""
    assert facts["scale keyed"] == []
    (warning,) = facts["intensity keyed"]
    assert "without this extension, as on a farm, they do not move" in warning


def test_a_touched_row_shows_its_element_in_the_view(facts: Any) -> None:
    """Block of flares.py: "a row is touched"."""
    assert facts["nothing touched"] is None
    is_flare, other, own, alone = facts["touched"]
    assert is_flare and len(alone) == 1
    assert other == pytest.approx(0.15, rel=1e-3)
    assert own == pytest.approx(1, rel=1e-3), "the element as it is without mute, and the dimmed rest"
    assert facts["sliders stay"]
    assert facts["outlined"] == [True, True]


def test_a_click_chooses_the_brightest_element(facts: Any) -> None:
    """Block of flares.py: "an element is picked"."""
    assert len(facts["picked"]) > 1 and all(facts["picked"])
    assert facts["picked in the dark"] == [False, True]
    assert facts["picked beside an unplaced namesake"] == [True, True]


def test_elements_are_picked_in_a_camera_view_alone_until_escape(facts: Any) -> None:
    """Block of flares.py: "an element is picked"."""
    assert facts["view at a place"] == [True, False, False, False], "not on a sidebar, nor in another view"
    assert "Picking needs Blender's window" in facts["picking without a window"]
    assert facts["picking ends"] == [["PASS_THROUGH"], ["RUNNING_MODAL"], ["RUNNING_MODAL"], ["CANCELLED"]]
    assert facts["picking leaves"] == ["window.cursor_modal_restore", "workspace.status_text_set"]


def test_a_viewport_render_is_saved_as_the_view_transform_shows_it(facts: Any) -> None:
    """What is drawn into it needs a window: tests/window/agreement.py compares it with a render.

    Block of flares.py: "a viewport render".
    """
    *names_and_sizes, colour = facts["viewport render"]
    assert names_and_sizes == ["view_0007.png", [8, 4], [8, 4]]
    assert colour == pytest.approx([255, 128, 128], abs=1)  # Blender 4.3 rounds 127.5 down
    camera, window = facts["viewport render refused"]
    assert "no camera" in camera and "need Blender's window" in window


def test_a_viewport_render_to_a_video_saves_pictures_and_says_so(facts: Any) -> None:
    """The output settings of the scene stay.

    Block of flares.py: "a viewport render".
    """
    assert facts["viewport render of a video"] == [["play0007.png", "PNG", [8, 4], True],
                                                   ["shot_0007.png", "PNG", [8, 4], True],
                                                   ["layers_0007.exr", "OPEN_EXR", [8, 4], True]]
    sentence, = facts["viewport render reported"]
    assert sentence.startswith("3 frames are in ") and "PNG pictures" in sentence and "Image/Sequence" in sentence


def test_viewport_renders_are_in_the_menu_view(facts: Any) -> None:
    """Block of flares.py: "a viewport render"."""
    assert facts["entries of the menu View"] == [
        ["fit_flare.viewport_render", "Viewport Render Image with Flare"],
        ["fit_flare.viewport_render", "Viewport Render Animation with Flare"]]


def test_a_viewport_render_that_fails_leaves_the_timeline_where_it_was(facts: Any) -> None:
    """Block of flares.py: "a viewport render"."""
    status, frame, subframe, sentence = facts["viewport render failed"]
    assert status == ["CANCELLED"] and (frame, subframe) == (7, 0.5) and "3D viewport was closed" in sentence


def test_look_and_bake_are_beside_the_compositor_and_the_picture(facts: Any) -> None:
    """Block of flares.py: "panels of other editors"."""
    assert facts["other editors"] == [True, True, [], True, True, ["fit_flare.shot_from_picture"], []]
    assert facts["other editors without a flare"] == [[], []]
