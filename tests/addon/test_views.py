# SPDX-License-Identifier: GPL-3.0-or-later
"""What a camera view shows and what a render shows; tests/window/agreement.py compares their pixels."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture(scope="session")
def facts(run_script: Callable[[str, int], Any]) -> Any:
    return run_script("views", 3)


def test_a_flare_is_drawn_only_in_views_that_do_not_composite_it(facts: Any) -> None:
    """Block of views.py: "views that show the compositor's result"."""
    assert facts["without a node"] == [False, False]
    assert {name for name, is_composited in facts["composited"].items() if is_composited} == {
        "MATERIAL CAMERA", "MATERIAL ALWAYS", "RENDERED CAMERA", "RENDERED ALWAYS"}
    assert len(facts["composited"]) == 12
    assert not facts["composited, muted"]


def test_an_effect_that_is_off_in_preview_composites_no_view(facts: Any) -> None:
    """Block of views.py: "views that show the compositor's result"."""
    if not facts["has effects"]:
        assert facts["composited, no compositing of renders"], "Blender composites views all the same"
        pytest.skip("this Blender has no stack of compositor effects; 5.3 has")
    assert facts["composited, off in preview"] == [False, True, False]
    assert facts["composited, off in renders"] == [True, False]
    assert facts["composited, another off"]


def test_footage_bypasses_the_view_transform_unless_it_is_viewed_as_a_render(facts: Any) -> None:
    """Block of views.py: "footage that bypasses the view transform"."""
    assert facts["bypassing"] == {"nothing": False, "an image": True, "viewed as a render": False, "transparent": False,
                                  "hidden": False, "no clip": 1, "an empty": False, "a clip": True}


def test_the_panel_offers_to_view_footage_as_a_render(facts: Any) -> None:
    """Block of views.py: "footage that bypasses the view transform"."""
    text, switches = facts["hint"]
    assert "bypasses the view transform AgX" in text and "clip" not in text
    assert switches == [["photo", "use_view_as_render"]]
    text, switches = facts["hint of a clip"]
    assert "A movie clip always bypasses the view transform" in text and switches == []
    assert facts["hint after the switch"] == facts["hint, plain view transform"] == ["", []]
    assert facts["hint, exposed"] == 1


@pytest.mark.parametrize("kind", ["animated", "each"])
def test_the_first_render_after_an_import_shows_the_frame(facts: Any, kind: str) -> None:
    """Differences in codes. Block of views.py: "the first render after an import"."""
    over, off, note = facts[f"imported, {kind}"]
    assert over == "plate" and note == ""
    assert off and max(off) <= 1.01, "dithering included"


def test_an_import_leaves_other_compositors_and_renders_alone(facts: Any) -> None:
    """Block of views.py: "the first render after an import"."""
    assert "footage of another camera" in facts["another camera"]
    assert facts["imported again"] <= 1.01
    assert facts["imported without frames"] == [True, "present", False]
    assert facts["imported beside an artist's nodes"] == [True, True]
    assert facts["cancelled"] == [True, False, False]


def test_objects_lie_over_the_footage_and_the_flare_over_both(facts: Any) -> None:
    """Block of views.py: "objects before the footage"."""
    assert max(facts["board over footage"]) < 2e-3
    brightest, off = facts["flare over both"]
    assert brightest > 0.1 and max(off) < 2e-3 * brightest, "the layers are half floats"
    assert facts["transparent"] == "" and "the world hides the footage" in facts["opaque"]
    note, difference, renders = facts["set up, opaque"]
    assert "no objects of the scene" in note and difference < 2e-3 * brightest
    assert renders == [], "Blender does not render what nothing shows"
    assert max(facts["set up, transparent again"]) < 2e-3 * brightest
    assert facts["over the baked scene"] == []
    assert facts["objects removed"]


def test_a_film_that_is_made_transparent_later_shows_the_objects_after_an_import(facts: Any) -> None:
    """Block of views.py: "a film that is made transparent after an import"."""
    film = facts["film"]
    note, difference = film["opaque"]
    assert "no objects of the scene" in note and difference < 2e-3
    note, note_after, off, _, has_artists_node, has_render = film["transparent"]
    assert "without the objects of the scene" in note and "import" in note and note_after == ""
    assert max(off) < 2e-3 and has_artists_node and has_render
    _, note_after, _, difference, has_artists_node, has_render = film["opaque again"]
    assert "no objects of the scene" in note_after and difference < 2e-3
    assert has_artists_node and not has_render, "Blender does not render what nothing shows"
    assert "without the objects of the scene; press Set Up Compositor again" in film["set up, transparent later"]
    assert film["set up again"] == ""
    assert film["over an artist's picture"] == [True, ""], "the artist's nodes decide what there is of the render"


def test_single_picture_and_import_turn_the_largest_view_to_the_camera(facts: Any) -> None:
    """Block of views.py: "views that turn to the camera"."""
    assert facts["turned"] == ["0001", "Camera"]
    assert facts["through the camera"] == [True, ["PERSP", True], ["CAMERA", False]]
    assert facts["nothing to look through"] == [False, False]
