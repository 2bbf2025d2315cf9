# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import blenders
import pytest
from blenders import ROOT, Blender, newer


@pytest.fixture(scope="session", params=["newer", "older", "named"])
def blender(request: pytest.FixtureRequest) -> Blender:
    """Each of the Blenders that are set up here."""
    found = getattr(blenders, request.param)()
    if found is None:
        pytest.skip("no Blender is named by FIT_FLARE_BLENDER" if request.param == "named" else
                    f"the {request.param} Blender is not set up here (`make setup`)")
    return found


@pytest.fixture(scope="session")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if newer() is None:
        pytest.skip("Blender's packer comes with the bpy package (`make setup`)")
    out = tmp_path_factory.mktemp("package")
    done = subprocess.run([sys.executable, str(ROOT / "headless" / "package.py"), str(out)], capture_output=True,
                          text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(out.glob("*.zip"))
