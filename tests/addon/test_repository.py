# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension installed from its static repository, and the weights that it downloads from there."""
from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from blenders import Blender

from tests.core.flared import flared_capture

SCRIPT = Path(__file__).parent / "scripts" / "repository.py"


@pytest.fixture(scope="session")
def facts(blender: Blender, repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    base = tmp_path_factory.mktemp("from_repository")
    capture = flared_capture(base / "capture", 3)
    for name in ("removed", "truth"):
        shutil.rmtree(capture / name, ignore_errors=True)
    (base / "out").mkdir()
    return blender.run(SCRIPT, repository / "index.json", capture, base / "out", user=base / "user")


def test_the_extension_installs_from_its_repository(facts: Any) -> None:
    """Block of repository.py: "beginning"."""
    assert facts["enabled"]


def test_the_weights_are_downloaded_from_the_repository(facts: Any) -> None:
    """Block of repository.py: "weights"."""
    assert facts["in the package"] == [] and facts["offered"]
    assert facts["set-up brings them"] and facts["the preferences offer them"]
    assert facts["downloaded"] == ["done", "", True, True]
    assert facts["the preferences name them"] and facts["passed to the engine"]


def test_nothing_is_downloaded_without_online_access(facts: Any) -> None:
    """Block of repository.py: "weights"."""
    assert all("Allow Online Access" in text for text in facts["offline"])


def test_what_needs_the_weights_says_so(facts: Any) -> None:
    """Block of repository.py: "weights"."""
    assert "needs its weights. Open the preferences" in facts["fit without weights"]
    assert "choose No Clean Frames" in facts["fit without weights"]
    assert "needs its weights" in facts["cleaning without weights"]
    assert facts["fit by parallax"] == facts["fit with weights"] == ""


def test_weights_are_named_in_the_preferences(facts: Any) -> None:
    """Block of repository.py: "weights"."""
    assert facts["those of the preferences"]
    assert "named by the preferences are missing" in facts["those of the preferences are missing"]
