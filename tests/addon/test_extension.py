# SPDX-License-Identifier: GPL-3.0-or-later
"""The built extension: packed by Blender's packer, installed, used, disabled."""
from __future__ import annotations

import hashlib
import importlib.util
import json
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blenders import ROOT, Blender

from core.bake.exr import write_layers
from core.bake.layers import FrameLayers
from core.removal.model.weights_file import published_digest, published_name

MAX_PACKAGE_BYTES = 8_000_000
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
            "headless/set_up.py", "constraints.txt", "pyproject.toml",
            "flare_addon/library_looks/LICENSE.txt"} <= set(names)
    strangers = [name for name in names if name.split("/")[0].startswith(".") or "__pycache__" in name
                 or name.split("/")[0] in ("tests", "benchmarks", "sample_scenes", "build", "tmp", "docs", "Makefile",
                                           "ARCHITECTURE.md", "CONTRIBUTING.md", "README.md")
                 or name.endswith((".safetensors", ".csv", "headless/package.py"))]
    assert strangers == []
    assert package.stat().st_size < MAX_PACKAGE_BYTES


def test_the_manifest_passes_the_platforms_rules(package: Path) -> None:
    """The tags of the platform, a website, a reason for each permission, the licences of program and looks."""
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    assert manifest["website"].startswith("https://")
    assert manifest["license"] == ["SPDX:GPL-3.0-or-later", "SPDX:CC0-1.0"]
    assert f"**Tagline:** {manifest['tagline']}\n" in (ROOT / "docs" / "listing.md").read_text(encoding="utf-8")
    for text in (manifest["tagline"], *manifest["permissions"].values()):
        assert 0 < len(text) <= 64 and text[-1].isalnum()
    assert set(manifest["permissions"]) == {"files", "network"}
    packer = importlib.util.find_spec("bpy")
    assert packer is not None and packer.submodule_search_locations
    scripts, = Path(packer.submodule_search_locations[0]).glob("*/scripts")
    tags = scripts / "modules" / "_bpy_internal" / "extensions" / "tags.py"
    done = subprocess.run([sys.executable, str(scripts / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"),
                           "validate", str(package), "--valid-tags", str(tags)],
                          capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_weights_of_a_repository_are_those_of_the_program(repository: Path) -> None:
    weights = next(repository.glob("*.safetensors"))
    assert weights.name == published_name()
    assert hashlib.sha256(weights.read_bytes()).hexdigest() == published_digest()
    index = json.loads((repository / "index.json").read_text(encoding="utf-8"))
    assert [(entry["id"], entry["archive_url"]) for entry in index["data"]] == [
        ("fit_flare", f"./{next(repository.glob('*.zip')).name}")]


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
