# SPDX-License-Identifier: GPL-3.0-or-later
"""No Python that the program starts imports a module from the folder in which it happens to start."""
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from fit_flare.headless import hand_off, set_up
from fit_flare.headless.set_up import install_step, venv_step
from fit_flare.headless.set_up import test_step as check_step

from tests.headless.conftest import RUN

TRAPS = ("venv", "pip", "torch", "numpy", "cv2", "multiprocessing", "json")


@pytest.fixture
def trapped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder whose modules leave a mark when something imports them; yields the mark's path."""
    mark = tmp_path / "mark"
    for name in TRAPS:
        (tmp_path / f"{name}.py").write_text(f"import os\nopen({str(mark)!r}, 'w').close()\nos._exit(9)\n")
    monkeypatch.chdir(tmp_path)
    return mark


def test_the_traps_work(trapped: Path) -> None:
    """Without protection, modules in the working folder are imported in place of Python's: they fail and leave a
    mark."""
    assert subprocess.run([sys.executable, "-m", "venv", "--help"], capture_output=True, check=False).returncode
    assert trapped.exists()


def test_the_engine_is_set_up_without_the_working_folder(trapped: Path, tmp_path: Path) -> None:
    environment = tmp_path / "engine"
    steps = [venv_step(sys.executable, environment), install_step(environment, "x"), check_step(environment)]
    for step in steps:
        command = [sys.executable, *step.command[1:]]  # without an environment
        if "install" in command:
            command = [*command[:command.index("install")], "--version"]
        elif "venv" in command:
            command = [*command[:-1], "--help"]
        assert set_up.run_logged(command) == ""
        assert not trapped.exists(), step.message


def test_the_search_for_an_engine_ignores_the_working_folder(trapped: Path) -> None:
    assert hand_off._has_torch(Path(sys.executable))
    assert not trapped.exists()


def test_children_of_a_command_ignore_the_working_folder(trapped: Path, tmp_path: Path) -> None:
    """By the variable that run.py sets, which processes that multiprocessing spawns inherit."""
    script = tmp_path / "outer.py"
    child = """    sys.exit(subprocess.call([sys.executable, "-c", "import json, multiprocessing"]))\n"""
    script.write_text(RUN.read_text().replace("    package = register_package()\n    if", f"{child}    if"))
    done = subprocess.run([sys.executable, "-P", str(script)], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not trapped.exists()
