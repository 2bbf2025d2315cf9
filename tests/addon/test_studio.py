# SPDX-License-Identifier: GPL-3.0-or-later
"""With a studio's colour configuration, such as ACES, nothing fails and layers keep their colours."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blenders import Blender
from test_work import a_flare

from core.bake.exr import write_layers
from core.bake.layers import FrameLayers
from core.images.exr import read_exr
from tests.core.flared import HEIGHT, WIDTH, flared_capture

SCRIPT = Path(__file__).parent / "scripts" / "studio.py"
REC_709 = """
  - !<ColorSpace>
    name: Linear Rec.709 (sRGB)
    to_scene_reference: !<MatrixTransform> {matrix: [0.439632981919, 0.382988698152, 0.177378319929, 0,
      0.089776443959, 0.813439428749, 0.096784127293, 0, 0.017541170383, 0.111546553302, 0.870912276314, 0,
      0, 0, 0, 1]}
"""
PICKED = 0.8, 0.5, 0.4
"""As in studio.py."""
CONFIGURATION = """ocio_profile_version: 2
strictparsing: true
roles: {default: raw, scene_linear: ACEScg, data: raw, color_picking: sRGB, aces_interchange: ACES2065-1}
file_rules:
  - !<Rule> {name: Default, colorspace: ACEScg}
displays:
  sRGB - Display:
    - !<View> {name: ACES 1.0 - SDR Video, colorspace: sRGB}
    - !<View> {name: VIEW, colorspace: sRGB}
colorspaces:
  - !<ColorSpace>
    name: ACES2065-1
  - !<ColorSpace>
    name: ACEScg
    to_scene_reference: !<MatrixTransform> {matrix: [0.695452241357, 0.140678696470, 0.163869062172, 0,
      0.044794563372, 0.859671118456, 0.095534318172, 0, -0.005525882558, 0.004025210306, 1.001500672252, 0,
      0, 0, 0, 1]}
  - !<ColorSpace>
    name: sRGB
    to_scene_reference: !<ExponentTransform> {value: [2.2, 2.2, 2.2, 1]}
  - !<ColorSpace>
    name: raw
    isdata: true
"""
RED_IN_ACESCG = 0.61310, 0.07019, 0.02062  # of linear Rec. 709, by ACES' own matrix


def run(blender: Blender, package: Path, base: Path, configuration: str, *space: str) -> tuple[Any, np.ndarray]:
    """Run the script with an OpenColorIO configuration; return its facts and the picture (h, w, 3) that a render shows.

    configuration: text of a config.ocio, "" for Blender's own. space: arguments that the script gets besides.
    """
    black = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    red = black + np.array([1, 0, 0], np.float32)
    write_layers(base / "layers" / "layers.0001.exr", FrameLayers(black, {"lamp": red}, black[..., 0]))
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("OCIO", raising=False)
        if configuration:
            (base / "config.ocio").write_text(configuration)
            patch.setenv("OCIO", str(base / "config.ocio"))
        facts = blender.run(SCRIPT, package, flared_capture(base / "capture", 3), a_flare(base / "lamp.flare"),
                            base / "layers", base, *space, user=base / "user")
    channels = read_exr(base / "shown.exr")
    return facts, np.stack([channels[name] for name in "RGB"], -1)


def test_layers_and_the_camera_view_keep_their_colours(blender: Blender, package: Path, tmp_path: Path) -> None:
    """Block of studio.py: "beginning"."""
    configuration = CONFIGURATION.replace("VIEW", "Un-tone-mapped") + REC_709.strip("\n")
    facts, shown = run(blender, package, tmp_path, configuration)
    assert (facts["import"], facts["misread"]) == ([["FINISHED"], "Un-tone-mapped"], "")
    np.testing.assert_allclose(shown, np.broadcast_to(RED_IN_ACESCG, shown.shape), atol=1e-3)
    np.testing.assert_allclose(facts["red in the camera view"], shown[0, 0], atol=1e-3)
    check_tints(facts)


def test_the_working_space_of_a_blend_is_followed(blender: Blender, package: Path, tmp_path: Path) -> None:
    """Block of studio.py: "beginning"."""
    facts, shown = run(blender, package, tmp_path, "", "ACEScg")
    if facts["working space"] != "ACEScg":
        pytest.skip("this Blender has one working space; from 5.0 on a .blend may have another")
    np.testing.assert_allclose(facts["red in the camera view"], RED_IN_ACESCG, atol=1e-3)
    np.testing.assert_allclose(facts["red in the camera view"], shown[0, 0], atol=1e-3)
    check_tints(facts)


def check_tints(facts: dict[str, Any]) -> None:
    """Check that a white flare gets the tint that is picked in the working space: in the camera view, a bake and a
    transfer. Block of studio.py: "the tint that an artist picks"."""
    assert facts["tints"].keys() == {"camera view", "bake", "transfer"}
    for name, tint in facts["tints"].items():
        np.testing.assert_allclose(tint, PICKED, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(facts["tint of a file"], PICKED, atol=1e-5)
    assert facts["white"]


def test_a_colour_space_missing_from_the_configuration_is_reported(blender: Blender, package: Path,
                                                                   tmp_path: Path) -> None:
    """Block of studio.py: "beginning"."""
    facts, _ = run(blender, package, tmp_path, CONFIGURATION.replace("VIEW", "Log"))
    assert facts["import"] == [["FINISHED"], "ACES 1.0 - SDR Video"]
    assert "no space for linear Rec. 709" in facts["misread"]
