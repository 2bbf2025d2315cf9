# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights that tests of the removal share, and one thread for small tensors."""
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from tests.core.removal_cases import network_file


@pytest.fixture(scope="module")
def flare_everywhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights that see a flare in every pixel."""
    return network_file(tmp_path_factory.mktemp("weights") / "everywhere.safetensors", bias=0.2)


@pytest.fixture(scope="module")
def no_flare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights that never see one."""
    return network_file(tmp_path_factory.mktemp("weights") / "nowhere.safetensors", bias=-1.0)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Let torch use one thread. The sums of a fit are then the same in every process, and small pictures are not slowed
    down by threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
