# SPDX-License-Identifier: GPL-3.0-or-later
"""The engine's set-up by one click, with a package made on the spot in place of torch."""
from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

from blenders import ROOT

SCRIPT = ROOT / "headless" / "set_up.py"


def wheel(folder: Path, name: str) -> Path:
    """A package that holds one empty module."""
    path = folder / f"{name}-1.0-py3-none-any.whl"
    info = f"{name}-1.0.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}.py", "")
        archive.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    return path


def set_up(folder: Path, *wanted: Path) -> tuple[int, list[dict[str, Any]]]:
    done = subprocess.run([sys.executable, "-I", str(SCRIPT), str(folder), *map(str, wanted)], capture_output=True,
                          text=True, check=False)
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()]


def test_it_makes_an_environment_and_fills_it(tmp_path: Path) -> None:
    (tmp_path / "engine").mkdir()
    (tmp_path / "engine" / "left").write_text("by a set-up that was stopped")
    status, events = set_up(tmp_path / "engine", wheel(tmp_path, "sham_torch"))
    assert status == 0
    assert [event["type"] for event in events] == ["stage", "say", "progress", "say", "progress", "result"]
    python = events[-1]["data"]["engine"]
    assert subprocess.run([python, "-c", "import sham_torch"], check=False).returncode == 0
    assert not (tmp_path / "engine" / "left").exists()


def test_a_failure_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    status, events = set_up(tmp_path / "engine", tmp_path / "nowhere-1.0-py3-none-any.whl")
    assert status == 1
    assert "could not be installed (" in events[-1]["text"]
    assert "nowhere-1.0" in events[-1]["text"], "what pip said"
    assert not (tmp_path / "engine").exists()
