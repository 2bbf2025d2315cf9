# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps drive their flares, in the camera view, in bakes and in transfers alike."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blenders import Blender
from test_work import a_flare

SCRIPT = Path(__file__).parent / "scripts" / "lamps.py"


@pytest.fixture(scope="session")
def facts(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    base = tmp_path_factory.mktemp("lamps")
    return blender.run(SCRIPT, package, a_flare(base / "lamp.flare"), user=base / "user")


def test_power_and_colour_of_a_lamp_drive_its_flare(facts: Any) -> None:
    """Block of lamps.py: "lamps drive their flares"."""
    assert facts["dimmed by hand"] == [0.5, 0.25, 0.5]
    assert facts["half as bright"] == pytest.approx(0.5, abs=1e-3)
    assert facts["not following"] == [1, 1, 1]
    assert facts["keyed"] == [[1, 1, 1], [3, 3, 3]], "relative to the first frame"
    assert facts["keyed, in a bake"] == facts["keyed, in a transfer"] == [1, 3]
    assert facts["driven"] == [4, [1, 1, 1], [4, 4, 4]], "and the timeline stays where it was"


def test_a_lamp_that_is_animated_later_is_the_same_in_view_bake_and_transfer(facts: Any) -> None:
    """Factors on red and green in the first and the last frame.

    Block of lamps.py: "lamps that are driven later, and other keys of their power".
    """
    exact = {"driven power": [[1, 1], [5, 5]], "driven green": [[1, 1], [1, 9]], "keyed colour": [[1, 1], [0.5, 2]],
             "keyed colour, driven power": [[1, 1], [2.5, 10]], "keyed exposure": [[1, 1], [4, 4]],
             "driven exposure": [[1, 1], [4, 4]]}
    measured = facts["animated later"]
    assert len(measured) in (4, 6), "lamps have an exposure from Blender 4.5 on"
    for name, routes in measured.items():
        for route, factors in routes.items():
            assert np.ravel(factors) == pytest.approx(np.ravel(exact[name]), abs=2e-3), (name, route)


def test_a_drawing_of_the_camera_view_keeps_a_pose_without_keys(facts: Any) -> None:
    """The view measures a driven lamp in the first frame only, and the panel names it until then.

    Block of lamps.py: "lamps that are driven later, and other keys of their power".
    """
    assert facts["posed by hand"] == [[7, 8, 9], False, True]
    assert facts["posed, first frame"] == [True, [20, 20, 20], False]


def test_a_flare_follows_all_of_its_lamp_but_nothing_of_a_light_of_the_capture(facts: Any) -> None:
    """Block of lamps.py: "lamps switch their flares"."""
    assert facts["switches"] == [[True] * 4, pytest.approx(8.016, abs=1e-3)]
    assert facts["switches of a capture"] == [False] * 4
    assert facts["switches again"] == [True] * 4


@pytest.mark.parametrize("how", ["keyed hide_render", "keyed hide_viewport", "driven hide_render"])
def test_a_lamp_that_is_switched_off_has_no_flare(facts: Any, how: str) -> None:
    """Block of lamps.py: "lamps switch their flares"."""
    assert facts[how] == [[1, 0, 1]] * 2, "in the camera view, in a bake"


def test_hidden_lamps_are_followed_in_transfers_collections_and_the_panel(facts: Any) -> None:
    """Block of lamps.py: "lamps switch their flares"."""
    assert facts["hidden, in a transfer"] == [1, 0, 1]
    assert facts["hidden, not followed"] == [False, None, True]
    assert facts["hidden, not followed in a transfer"] == [1, 1, 1]
    assert "switch Follow Visibility off" in facts["hidden, in the panel"]
    assert facts["in a hidden collection"] == [True, False]
    assert facts["hidden behind a wall"] == 0, "it is smoothed over frames"
    assert facts["disabled and animated"] == [0, 0, 0], "and not refused"


def test_the_cone_of_a_spot_limits_its_flare(facts: Any) -> None:
    """Block of lamps.py: "lamps switch their flares"."""
    assert facts["hard spot"] == [[1, 1, 0]] * 2, "in the camera view, in a bake"
    assert facts["spot, in a transfer"] == [1, 0]
    assert "does not shine at the camera" in facts["spot, in the panel"] and facts["spot, reported"]
    assert facts["spot, not followed"]
    measured, exact = facts["soft spot"]
    assert 0.1 < exact < 0.9 and measured == pytest.approx(exact, abs=1e-3)
    assert facts["keyed cone"] == [True, 0]
    assert facts["area as a point"] == pytest.approx(0.5, abs=1e-3)
    assert facts["sides of a mirrored lamp"] == [True, False] * 2, "along its -Z"


def test_a_mirrored_capture_shows_the_visible_half_of_an_area_light(facts: Any) -> None:
    """Block of lamps.py: "lamps switch their flares"."""
    assert facts["half a lamp in a mirrored capture"] == [[True, 0.5, True]] * 3


def test_a_flare_dims_with_the_square_of_the_distance(facts: Any) -> None:
    """Block of lamps.py: "lamps switch their flares"."""
    assert facts["twice as far"] == [[1, pytest.approx(0.25, abs=2e-3)]] * 2, "in the camera view, in a bake"
    assert facts["twice as far, not followed"] == [[1, pytest.approx(1, abs=2e-3)]] * 2
    assert facts["in a scaled capture"] == pytest.approx(1, abs=1e-3), "at the reference distance"
    assert facts["distance, in a transfer"] == [pytest.approx(8.016, abs=1e-3)] * 2
    assert facts["a sun has no distance"] == [0, 0]


def test_a_camera_view_is_rendered_anew_only_where_something_changed(facts: Any) -> None:
    """Block of lamps.py: "a camera view that is drawn again". How often two drawings render, and whether they agree."""
    drawn = facts["drawn again"]
    assert drawn.pop("unchanged") == [0, True]
    assert drawn.pop("mute") == [0, True], "without a flare"
    assert len(drawn) == 17 and set(map(tuple, drawn.values())) == {(1, True)}, drawn
    one, *sums = facts["sums of a flare more and less"]
    assert sums[0] == sums[2] > 1.2 * one and sums[1] == sums[3] == one == 1


def test_views_and_eyes_do_not_redraw_each_other(facts: Any) -> None:
    """Block of lamps.py: "a camera view that is drawn again". The buffers of few views are kept, of others freed."""
    assert facts["in turns"] == {"two regions": 2, "two eyes": 2}
    assert facts["buffers"] == {"sizes": [[26, 13]], "freed": 1, "kept": [1, 3, 4, 5], "another size": 2,
                                "all": 6, "of closed regions": [1, [0, 2, 3]]}


def test_the_sum_is_drawn_where_the_flare_is(facts: Any) -> None:
    """Block of lamps.py: "the part of a region that the sum is drawn in". Area of the part, light in it, all light."""
    areas, inside, light = map(list, zip(*facts["parts"], strict=True))
    assert inside == pytest.approx(light, rel=1e-6) and min(light[:4]) > 0
    assert areas[0] > areas[1] > areas[2] > 0 and max(areas[2:4]) < 0.2
    assert areas[4] == light[4] == 0, "outside of the region"


def test_boxes_of_objects_save_rays_but_change_no_visibility(facts: Any) -> None:
    """Block of lamps.py: "many lamps among walls". Visibility by rays, whether a box is near, and visibility with
    boxes."""
    by_rays, is_near, with_boxes = map(list, zip(*facts["among walls"], strict=True))
    assert with_boxes == by_rays
    assert min(by_rays) == 0 and by_rays.count(max(by_rays)) > 10
    assert 5 < sum(is_near) < 36
