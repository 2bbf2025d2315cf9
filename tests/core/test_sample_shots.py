# SPDX-License-Identifier: GPL-3.0-or-later
"""The sample shots: what they promise of their lamps, and that their files agree."""
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from core.capture import Capture, read_lights
from core.colour.srgb import srgb_from_linear
from core.system.progress import Progress
from sample_scenes import render_shot
from sample_scenes.raycast import Lamp, quad, visible_share
from sample_scenes.shot_scenes import FRAMES, OUT_FRAMES, SHOTS


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", sorted(SHOTS))
def test_lamps_are_seen_and_hidden(name: str, seed: int) -> None:
    scene = SHOTS[name](seed)
    values = [render_shot.lights_in_frame(scene, scene.frame_state(index)) for index in range(0, FRAMES, 2)]
    for light in values[0]:
        pixels = np.array([value[light].xy for value in values])
        inside = ((pixels > 0) & (pixels < (scene.camera.width, scene.camera.height))).all(axis=1)
        strength = np.array([value[light].flare_strength for value in values])
        assert (inside & (strength > 0.05)).sum() >= 6
        hidden = sum(value[light].visible_share < 0.05 for value in values)
        assert hidden >= 1 if name != "drive" else hidden == 0


def test_the_right_headlight_is_out_for_some_frames() -> None:
    scene = SHOTS["drive"](0)
    strengths = [scene.frame_state(index).strengths for index in range(FRAMES)]
    assert sum(strength["right"] == 0 for strength in strengths) == OUT_FRAMES
    assert all(strength["left"] > 0 for strength in strengths)


def test_half_of_a_lamp_behind_an_edge_is_half_visible() -> None:
    lamp = Lamp(np.array([0.0, 0.0, 5.0]), 0.1, np.ones(3), 1.0, 1.0)
    screen = quad((0, -1, 2), (1, 0, 0), (0, 2, 0), np.ones((2, 2, 3), np.float32))
    assert visible_share(lamp, np.zeros(3), [screen]) == pytest.approx(0.5, abs=0.03)


def test_the_files_of_a_shot_agree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render_shot, "FRAMES", 1)
    render_shot.make_shot("drive", 0, tmp_path, Progress())
    assert not (tmp_path / "lights.json").exists()
    (tmp_path / "split.json").unlink()  # it names later frames
    capture = Capture.open(tmp_path, need_cameras=False)
    assert {light.name for light in read_lights(tmp_path / "truth" / "lights.json")} == {"left", "right"}
    for view in capture.views:
        scene, flare = capture.truth_scene(view), capture.truth_flare(view)
        assert scene is not None and flare is not None and flare.pixels.max() > 0.05
        filmed = srgb_from_linear(np.clip(scene.pixels + flare.pixels, 0, 1))
        assert np.abs(capture.frame(view).display() - filmed).mean() < 0.02
    entry = json.loads((tmp_path / "truth" / "lights.json").read_text())["lights"][0]["frames"]["0001.png"]
    x, y = map(int, entry["xy"])
    assert capture.frame(capture.views[0]).display()[y, x].min() > 0.97
