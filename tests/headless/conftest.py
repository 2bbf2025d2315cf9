# SPDX-License-Identifier: GPL-3.0-or-later
"""The tree under the name that the commands give it, and a small capture to run them on."""
from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.core.flared import flared_capture

ROOT = Path(__file__).resolve().parents[2]
RUN = ROOT / "headless" / "run.py"

_spec = importlib.util.spec_from_file_location("fit_flare_run", RUN)
assert _spec is not None
assert _spec.loader is not None
_run = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_run)
_run.register_package()


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny capture with everything, shared by the tests."""
    return flared_capture(tmp_path_factory.mktemp("capture") / "tiny", count=9, dots=60)


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Callable[..., list[dict[str, Any]]]:
    """A function that runs a command in this process and returns its events; `status` is the exit status it expects."""
    from fit_flare.headless import cli  # after the tree has its name

    def go(*args: object, status: int = 0) -> list[dict[str, Any]]:
        capfd.readouterr()
        ended = cli.main([*map(str, args), "--progress", "json"])
        output = capfd.readouterr()
        assert ended == status, output.out + output.err
        return [json.loads(line) for line in output.out.splitlines()]

    return go
