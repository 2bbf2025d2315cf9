# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel's sliders drive the compositor, in rendered pixels, and its removal leaves no trace."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blenders import Blender
from test_work import a_flare

from core.bake.exr import write_layers
from core.bake.layers import FrameLayers
from core.images.read import read_picture
from core.system.files import write_json

SCRIPTS = Path(__file__).parent / "scripts"
SCENE, FLARE = np.full((8, 16, 3), 0.125, np.float32), np.full((8, 16, 3), 0.25, np.float32)


@pytest.fixture(scope="session")
def facts(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Write layers of one light and of sixty, and run wired.py on them in Blender; return its facts."""
    base = tmp_path_factory.mktemp("wired")
    layers = base / "layers"
    for number in range(1, 6):
        write_layers(layers / f"layers.{number:04d}.exr", FrameLayers(SCENE, {"lamp": FLARE}, SCENE[..., 0]))
    write_json(layers / "live.json", {"lights": ["lamp"]})
    many, lamps = base / "many", ["lamp", *(f"lamp{number}" for number in range(1, 60))]
    write_layers(many / "layers.0001.exr", FrameLayers(SCENE, dict.fromkeys(lamps, FLARE), SCENE[..., 0]))
    write_json(many / "live.json", {"lights": lamps})
    return blender.run(SCRIPTS / "wired.py", package, a_flare(base / "lamp.flare"), layers, many, base,
                       user=base / "user")


@pytest.mark.parametrize("before", ["bare", "grey", "unused"])
@pytest.mark.parametrize("over", ["present", "scene"])
def test_the_compositor_is_removed_without_a_trace(facts: Any, before: str, over: str) -> None:
    changed, same, difference = facts[f"{before}, {over}"]
    assert changed
    assert same, difference


@pytest.mark.parametrize(("name", "gain"), [
    ("plain", (1, 1, 1)), ("graded", (3, 1.5, 0.75)), ("muted", (0, 0, 0)), ("animated", (3, 1.5, 0.75))])
def test_the_panels_sliders_act_on_the_render(facts: Any, name: str, gain: tuple[float, ...]) -> None:
    """Block of wired.py: "driven: the panel's sliders, animated too, in rendered pixels"."""
    assert facts["valid"]
    picture = read_picture(facts["files"][name]).pixels
    np.testing.assert_allclose(picture, SCENE + FLARE * np.array(gain, np.float32), rtol=1e-5)


def test_a_worker_without_the_extension_has_the_sliders_as_they_were_saved(facts: Any) -> None:
    """Block of wired.py: "driven: the panel's sliders, animated too, in rendered pixels"."""
    picture = read_picture(facts["files"]["on a worker"]).pixels
    np.testing.assert_allclose(picture, SCENE + FLARE * np.array((3, 1.5, 0.75), np.float32), rtol=1e-5)


def test_drivers_of_a_removed_flare_are_detected(facts: Any) -> None:
    """Block of wired.py: "rendered where the extension is not, after a save"."""
    assert facts["complete"] == [True, True, False]


@pytest.mark.parametrize(("name", "gain"), [
    ("many", 60), ("many, two solo", 3 + 1), ("many, one solo in a copy", 3), ("many, none solo", 3 + 59)])
def test_many_flares_stay_live(facts: Any, name: str, gain: float) -> None:
    """Block of wired.py: "driven: the panel's sliders, animated too, in rendered pixels"."""
    np.testing.assert_allclose(read_picture(facts["files"][name]).pixels, SCENE + gain * FLARE, rtol=1e-5)
