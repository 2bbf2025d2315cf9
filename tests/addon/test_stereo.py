# SPDX-License-Identifier: GPL-3.0-or-later
"""Stereo renders get a flare for each view, at the place of its light in that view."""
from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from blenders import Blender

from core.flare import file as flare_file
from core.flare.deformation import QueryRange
from core.flare.file import FlareFile, TrainedCamera
from core.flare.model import OURS, FlareModel, LightFlare
from core.images.exr import read_exr
from tests.core.flared import HEIGHT, LIGHT, WIDTH, cameras

SCRIPT = Path(__file__).parent / "scripts" / "stereo.py"


def glow(path: Path) -> Path:
    """Write a .flare that is one round Gaussian at its light; return the path."""
    views = cameras(5)
    seen = torch.tensor(np.array([camera.project_normalised(LIGHT)[0][0] for camera in views])).float()
    query_range = QueryRange.of(torch.tensor(np.array([camera.position for camera in views])).float(), seen)
    light = LightFlare(replace(OURS, rings=False), query_range, 1, torch.Generator().manual_seed(1))
    with torch.no_grad():
        light.gaussians["positions"].fill_(1.0)
        light.gaussians["offsets"].zero_()
        light.gaussians["opacity_logits"].fill_(2.0)
        light.gaussians["log_scales"].fill_(math.log(0.02))
    model = FlareModel(["lamp"], torch.tensor(LIGHT[None]), [light])
    flare_file.save(path, FlareFile(model, "add", TrainedCamera(WIDTH, HEIGHT, 70.0, 70.0, 33.0, 19.5)))
    return path


def light_centres(files: dict[str, str]) -> dict[str, list[float]]:
    """Return the centre of the light in the picture of each view, px from the top left. files: by the view's name."""
    centres = {}
    for view, file in files.items():
        light = np.asarray(read_exr(file)["G"], np.float64)
        y, x = np.mgrid[:light.shape[0], :light.shape[1]] + 0.5
        centres[view] = (np.array([(light * x).sum(), (light * y).sum()]) / light.sum()).tolist()
    return centres


@pytest.fixture(scope="session")
def facts(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    base = tmp_path_factory.mktemp("stereo")
    return blender.run(SCRIPT, package, glow(base / "glow.flare"), base, user=base / "user")


def test_the_cameras_of_the_views_are_those_of_a_render(facts: Any) -> None:
    """Block of stereo.py: "the cameras of the views, against renders of a small ball"."""
    assert len(facts["cameras"]) == 5
    for name, (files, projected) in facts["cameras"].items():
        rendered = light_centres(files)
        for view in ("left", "right"):
            # Sampling noise of a ball of 6 px moves its centre by up to 0.02 px.
            assert rendered[view] == pytest.approx(projected[view], abs=0.05), (name, view)
        assert abs(rendered["left"][0] - rendered["right"][0]) > 1, name


def test_a_camera_without_a_partner_serves_every_view(facts: Any) -> None:
    """Block of stereo.py: "the cameras of the views, against renders of a small ball"."""
    assert facts["pair"] == [["left", "Cam_L", "Cam_L"], ["right", "Cam_R", "Cam_R"]]
    assert facts["no partner"] == [["left", "Alone", "Alone_L"], ["right", "Alone", "Alone_R"]]


def test_each_view_renders_the_flare_of_its_camera_at_the_light(facts: Any) -> None:
    """Block of stereo.py: "a bake and its render"."""
    assert facts["baked"] == ""
    assert facts["files"] == [f"Camera_{eye}/layers.{frame:04d}.exr" for eye in "LR" for frame in (1, 3)]
    for files, lamp in facts["frames"]:
        rendered = light_centres(files)
        for view in ("left", "right"):
            assert rendered[view] == pytest.approx(lamp[view], abs=1)
        # 0.5 between the eyes, at 6 of 12 units: half of the 50 mm / 36 mm * 96 px * 0.5 / 6 of parallel eyes.
        assert rendered["left"][0] - rendered["right"][0] == pytest.approx(50 / 36 * 96 * 0.5 * (1 / 6 - 1 / 12), abs=1)
    assert facts["warnings"] == []
    assert facts["note"] == "Stereo: a bake has layers for each view (left, right)."
    assert facts["kept"], "a bake of the same scene keeps the layers of all views"


def test_a_renamed_camera_keeps_the_layers_of_its_views(facts: Any) -> None:
    """Block of stereo.py: "a bake and its render"."""
    assert facts["renamed"] == ["", ["left", "right"]]


def test_spherical_stereo_gives_a_warning(facts: Any) -> None:
    """Block of stereo.py: "a bake and its render"."""
    (warning,) = facts["spherical"]
    assert "The camera has Spherical Stereo" in warning


def test_layers_of_another_number_of_views_are_reported(facts: Any) -> None:
    """Block of stereo.py: "the present mode of the scene is another than that of the layers"."""
    (warning,), note, refused = facts["no stereo now"]
    assert "This scene does not render stereo" in warning and warning in note
    assert "no layers of the camera 'Camera', only of 'Camera_L', 'Camera_R'" in refused
    assert "Stereoscopy switched on" in refused
    assert facts["mono"] == [[], [], []]
    refused, (warning,) = facts["mono layers"]
    assert refused == ""
    assert "the compositor has no flare of its own for left and right" in warning
    assert facts["stereo layers"] == ["", []]
    assert facts["removed"] == [True, []]


def test_each_view_has_a_separate_sequence(facts: Any) -> None:
    """Block of stereo.py: "one view alone, equal suffixes, and selected cameras"."""
    assert facts["right alone"] == ["Camera_R"]
    assert facts["equal suffixes"] == ["Camera_left", "Camera_right"]
    assert facts["selected"] == ["Camera_L", "Camera_R", "Second_L", "Second_R"]
    assert facts["selected pair"] == ["Cam_L", "Cam_R"]


def test_a_reading_ends_where_the_stereo_settings_change(facts: Any) -> None:
    """Block of stereo.py: "stereo settings that change while a bake reads the scene"."""
    assert facts["changed meanwhile"] == ["The stereo settings changed while the scene was read; bake again."] * 2


def test_the_overlay_matches_the_displayed_view(facts: Any) -> None:
    """Block of stereo.py: "the view that a 3D view shows"."""
    assert facts["shown"] == [[name, name] for name in ("", "left", "right")]
