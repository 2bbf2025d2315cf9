# SPDX-License-Identifier: GPL-3.0-or-later
"""Captures from the motion tracker; suns are directions; objects that renders show hide lights."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from blenders import Blender

SCRIPTS = Path(__file__).parent / "scripts"


@pytest.fixture(scope="session")
def facts(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    base = tmp_path_factory.mktemp("tracked")
    return blender.run(SCRIPTS / "tracked.py", package, base / "out", user=base / "user")


@pytest.mark.parametrize("how", ["as solved", "set to the floor", "on a dolly"])
def test_points_of_the_tracker_lie_on_their_tracks(facts: Any, how: str) -> None:
    """The frames have the lens's distortion; without it points are 5 pixels off.

    Block of tracked.py: "beginning".
    """
    assert facts["solve error"] < 0.01
    assert facts[how] < 0.05


def test_distortion_applies_to_frames_of_the_clip_only(facts: Any) -> None:
    """Block of tracked.py: "beginning"."""
    assert facts["frames from elsewhere"] == {}
    assert "solve it with the model Polynomial" in facts["another model"]


def test_a_clip_with_an_offset_shows_its_own_frames(facts: Any) -> None:
    """Block of tracked.py: "beginning"."""
    assert facts["offset"] == ["0004.png", "0005.png"]


def test_sizes_are_rounded_as_blender_does(facts: Any) -> None:
    """Block of tracked.py: "sizes"."""
    assert facts["size at 35 %"] == [448, 252]


def test_a_sun_is_a_direction_independent_of_its_position(facts: Any) -> None:
    """Block of tracked.py: "a sun, and what hides it"."""
    assert len(facts["sun"]) == 3, "for a fit, a shot of a .blend, and the panel"
    assert max(facts["sun"]) < 1e-5


def test_a_solve_needs_no_lights(facts: Any) -> None:
    """A tracked file has its first lamp, switched off; lights are found later, in the frames.

    Block of tracked.py: "a sun, and what hides it".
    """
    assert facts["no lights"] == ["images", "points.ply", "transforms.json"]


def test_a_capture_of_a_blend_has_the_paths_of_its_lamps(facts: Any) -> None:
    """Block of tracked.py: "a sun, and what hides it"."""
    assert facts["moving lamps"] == [[[0, 0, 0], 1], [[4, 0, 0], 0.5], [[0, 0, 2], None], [[0, 0, 2], None]]


def test_a_shot_with_cuts_has_one_name_for_every_range(facts: Any) -> None:
    """Block of tracked.py: "a sun, and what hides it"."""
    whole, part, same = facts["cut"]
    assert whole == part == [""]
    assert same, "so a farm's chunks are those of the whole"


def test_a_light_or_camera_without_a_finite_position_is_reported(facts: Any) -> None:
    """Drivers may give such positions; writing the shot must not fail as a defect of ours.

    Block of tracked.py: "a sun, and what hides it".
    """
    (light, of_light), *of_cameras = facts["nowhere"]
    assert light == "CaptureError" and of_light.startswith("The position of the light 'Nowhere' is not finite at frame "
                                                           "1;")
    assert len(of_cameras) == 2
    for kind, said in of_cameras:
        assert kind == "CaptureError" and said.startswith("The camera 'Second' is scaled to zero, or its position is")


def test_objects_hidden_in_renders_hide_no_light(facts: Any) -> None:
    """Block of tracked.py: "a sun, and what hides it"."""
    assert facts["behind a wall"] == 0
    assert facts["that renders do not show"] == pytest.approx(1)
    assert facts["that cameras do not see"] == pytest.approx(1)


def test_a_lamp_does_not_hide_itself_as_an_instance(facts: Any) -> None:
    """Block of tracked.py: "a lamp that is an instance of an asset"."""
    assert facts["in its own asset"] == pytest.approx(1)
    assert facts["behind another lamp of its asset"] == 0
