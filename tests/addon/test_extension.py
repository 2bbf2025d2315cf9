# SPDX-License-Identifier: GPL-3.0-or-later
"""The built extension: packed by Blender's packer, installed, used, disabled."""
from __future__ import annotations

import tomllib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blenders import ROOT, Blender

from core.bake.exr import write_layers
from core.bake.layers import FrameLayers

SCRIPTS = Path(__file__).parent / "scripts"


@pytest.fixture(scope="session")
def facts(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    base = tmp_path_factory.mktemp("installed")
    layer = np.ones((8, 16, 3), np.float32)
    write_layers(base / "layers" / "layers.0007.exr", FrameLayers(layer, {"lamp": layer}, layer[..., 0]))
    return blender.run(SCRIPTS / "install.py", package, base / "layers", user=base / "user")


def test_the_versions_agree() -> None:
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert manifest["version"] == project["version"]


def test_the_package_holds_the_program_and_nothing_else(package: Path) -> None:
    names = zipfile.ZipFile(package).namelist()
    assert {"__init__.py", "blender_manifest.toml", "LICENSE", "core/errors.py", "headless/run.py",
            "headless/set_up.py", "constraints.txt", "pyproject.toml"} <= set(names)
    strangers = [name for name in names if name.split("/")[0].startswith(".") or "__pycache__" in name
                 or name.split("/")[0] in ("tests", "benchmarks", "sample_scenes", "build", "tmp", "docs", "Makefile",
                                           "ARCHITECTURE.md", "CONTRIBUTING.md")]
    assert strangers == []


def test_the_extension_installs_and_registers(facts: Any) -> None:
    """Block of install.py: "beginning"."""
    assert facts["enabled"]
    classes = {"FITFLARE_OT_set_up_compositor", "FITFLARE_PT_bake", "FITFLARE_PT_look", "FITFLARE_AP_preferences"}
    assert classes <= set(facts["classes"])


def test_the_preferences_name_the_engine(facts: Any) -> None:
    """Block of install.py: "beginning"."""
    assert facts["engine"] == ["", facts["python"]]


def test_set_up_compositor_works_and_refuses_with_a_sentence(facts: Any) -> None:
    """Block of install.py: "beginning"."""
    assert facts["set up"] == ["FINISHED"]
    assert facts["size"] == [16, 8, 7, 7]
    assert "holds no baked layers" in facts["refusal"]


def test_disabling_the_extension_restores_blender(facts: Any) -> None:
    """Block of install.py: "beginning"."""
    assert facts["sys.path"] == []
    assert facts["strays"] == []
    assert facts["left"] == []
    assert not facts["operator left"]
