# SPDX-License-Identifier: GPL-3.0-or-later
"""The compositor set-up keeps an artist's own nodes, in every state and after every button."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blenders import Blender

from core.bake.exr import write_layers
from core.bake.layers import FrameLayers

SCRIPT = Path(__file__).parent / "scripts" / "artists_nodes.py"
SCENE, FLARE, PLATE = 0.125, 0.25, 0.5


@pytest.fixture(scope="session")
def facts(blender: Blender, tmp_path_factory: pytest.TempPathFactory) -> Any:
    base = tmp_path_factory.mktemp("artists_nodes")
    scene, flare = (np.full((8, 16, 3), value, np.float32) for value in (SCENE, FLARE))
    write_layers(base / "layers" / "layers.0001.exr", FrameLayers(scene, {"lamp": flare}, scene[..., 0]))
    return blender.run(SCRIPT, base / "layers", base / "out", user=base / "user")


def test_nodes_of_the_artist_stay_when_the_compositor_is_removed(facts: Any) -> None:
    """Block of artists_nodes.py: "taken away from a composite that an artist has built round it"."""
    assert facts["with our own tree"] == 2 * (PLATE + FLARE)
    assert facts["our own tree, removed"] == [2 * PLATE, ["Grade", "Sky"]]
    assert facts["render goes on"]
    assert facts["made since"] == [PLATE, ["Plate"]]
    assert facts["set up again"] == [PLATE, ["Plate"]]


@pytest.mark.parametrize(("over", "below"), [("present", PLATE), ("scene", SCENE)])
def test_nodes_after_the_flare_stay_when_it_is_set_up_again_or_removed(facts: Any, over: str, below: float) -> None:
    """Block of artists_nodes.py: "nodes behind the flare"."""
    assert facts[f"graded, {over}"] == [2 * (below + FLARE)] * 2
    assert facts[f"graded, {over}, removed"] == [2 * PLATE, ["Grade", "Plate"]]


def test_a_cycle_from_an_earlier_set_up_is_repaired(facts: Any) -> None:
    """Block of artists_nodes.py: "nodes behind the flare"."""
    assert facts["a cycle"] is None
    assert facts["no cycle"] == PLATE + FLARE


def test_the_present_image_returns_after_the_baked_scene(facts: Any) -> None:
    """Block of artists_nodes.py: "over the baked scene, and back"."""
    graded = 2 * PLATE
    assert facts["over"] == [graded + FLARE, SCENE + FLARE, graded + FLARE, graded]


def test_the_active_output_gets_the_flare(facts: Any) -> None:
    """Block of artists_nodes.py: "two outputs, of which the second counts"."""
    assert facts["two outputs"] == [*2 * [PLATE + FLARE, ["Plate", "Fit Flare"]], PLATE]


def test_a_group_with_a_renamed_slider_is_shown_and_removed(facts: Any) -> None:
    """Block of artists_nodes.py: "a slider of the group that has another name"."""
    assert facts["renamed in the panel"] == ["Tint"]
    assert facts["renamed sockets"] == [PLATE, ["Plate"]]


def test_a_linked_compositor_gets_the_flare_in_a_copy(facts: Any) -> None:
    """Block of artists_nodes.py: "a compositor that is linked from another file (up to 4.5 it is its scene's)"."""
    assert facts["linked"] == [PLATE + FLARE, True]
    assert facts["linked, removed"] == [PLATE, ["Plate"]]
