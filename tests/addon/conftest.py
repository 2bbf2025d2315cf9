# SPDX-License-Identifier: GPL-3.0-or-later
from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import blenders
import pytest
from blenders import ROOT, Blender, newer


@pytest.fixture(scope="session", params=["newer", "older", "newest", "named"])
def blender(request: pytest.FixtureRequest) -> Blender:
    """Each of the Blenders that are set up here."""
    found = getattr(blenders, request.param)()
    if found is None:
        pytest.skip(blenders.missing_reason(request.param))
    return found


@pytest.fixture(scope="session")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a static repository of the extension, with its weights; return its folder. Skips without Blender's
    packer."""
    if newer() is None:
        pytest.skip("Blender's packer comes with the bpy package (`make setup`)")
    out = tmp_path_factory.mktemp("repository")
    done = subprocess.run([sys.executable, str(ROOT / "headless" / "package.py"), "--repository", str(out)],
                          capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "warning" not in (done.stdout + done.stderr).lower(), done.stdout + done.stderr
    return out


@pytest.fixture(scope="session")
def package(repository: Path) -> Path:
    """The zip of the extension."""
    return next(repository.glob("*.zip"))


@pytest.fixture(scope="session")
def run_script(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, int], Any]:
    """Return a function that runs a script of `scripts` in Blender and returns its facts.

    The function takes the script's name and a number of frames. The script gets the package, a capture of so many
    frames, a .flare of the capture's light, and an empty folder for its output.
    """
    from test_work import a_flare

    from tests.core.flared import flared_capture

    def run(name: str, frames: int) -> Any:
        base = tmp_path_factory.mktemp(name)
        capture, flare = flared_capture(base / "capture", frames), a_flare(base / "lamp.flare")
        (base / "out").mkdir()
        return blender.run(Path(__file__).parent / "scripts" / f"{name}.py", package, capture, flare, base / "out",
                           user=base / "user")

    return run


@pytest.fixture(scope="session")
def run_look_script(blender: Blender, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Any]:
    """Return a function that runs a script of `scripts`, given by its name, in Blender and returns its facts.

    The script gets the package, a .flare of one light, one of the two lights "sun" and "moon", and a folder for its
    output.
    """
    from test_work import a_flare

    def run(name: str) -> Any:
        base = tmp_path_factory.mktemp(name)
        return blender.run(Path(__file__).parent / "scripts" / f"{name}.py", package, a_flare(base / "lamp.flare"),
                           a_flare(base / "two.flare", "sun", "moon"), base, user=base / "user")

    return run
