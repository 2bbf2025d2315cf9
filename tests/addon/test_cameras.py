# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras, axes and frame numbers convert between the core and Blender."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blenders import Blender

SCRIPT = Path(__file__).parent / "scripts" / "cameras.py"


@pytest.fixture(scope="session")
def facts(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return blender.run(SCRIPT, package, user=tmp_path_factory.mktemp("cameras"))


def test_intrinsics_equal_blenders_for_every_sensor_fit_and_pixel_aspect(facts: Any) -> None:
    """Block of cameras.py: "every way to fit the sensor"."""
    assert len(facts["intrinsics"]) == 18
    for name, (blenders, ours) in facts["intrinsics"].items():
        np.testing.assert_allclose(ours, blenders, atol=2e-4, err_msg=name)


def test_cameras_of_different_size_or_pixel_aspect_give_a_warning(facts: Any) -> None:
    """Block of cameras.py: "what a scene has one of"."""
    alike, of_another_size, of_other_pixels = facts["unlike"]
    assert alike == []
    assert of_another_size == ["The frames differ in size; the scene has the size of the first frame."]
    assert ["others are up to 2.0% too wide" in note for note in of_other_pixels] == [True]


def test_non_square_pixels_survive_a_round_trip(facts: Any) -> None:
    """Block of cameras.py: "a camera of the core with other pixels than square, into Blender and back"."""
    for given, back in facts["back"]:
        np.testing.assert_allclose(back, given, atol=1e-3)


def test_the_up_axis_of_a_capture_is_up_in_blender(facts: Any) -> None:
    """Block of cameras.py: "what was up in the capture is up in Blender"."""
    for name, up in facts["up"].items():
        np.testing.assert_allclose(up, (0, 0, 1), atol=1e-6, err_msg=name)


def test_frame_numbers_are_those_of_blender(facts: Any) -> None:
    """Blender shows the file with the number frame - frame_start + 1 + frame_offset.

    Block of cameras.py: "frames".
    """
    assert facts["custom"] == [3, 4, 5]
    assert facts["footage"] == "plate.1007.exr"


def test_live_edits_are_not_baked(facts: Any) -> None:
    """Block of cameras.py: "what the compositor does live is not baked too"."""
    assert facts["baked edits"] == ["lamp.scale=2"]


def test_a_moved_light_makes_the_look_foreign_to_the_capture(facts: Any) -> None:
    """Block of cameras.py: "a light that was moved from where it was learned shows its flare as the source does"."""
    assert facts["native"] == [[True, True, False], [False, False, False]], "a scene without a capture is another"
    assert facts["query"] == ["target", "source"]
