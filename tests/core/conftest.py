# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights that tests of the removal share."""
from __future__ import annotations

from pathlib import Path

import pytest

from tests.core.removal_cases import network_file


@pytest.fixture(scope="module")
def flare_everywhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights that see a flare in every pixel."""
    return network_file(tmp_path_factory.mktemp("weights") / "everywhere.safetensors", bias=0.2)


@pytest.fixture(scope="module")
def no_flare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights that never see one."""
    return network_file(tmp_path_factory.mktemp("weights") / "nowhere.safetensors", bias=-1.0)
