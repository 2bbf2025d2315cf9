# SPDX-License-Identifier: GPL-3.0-or-later
"""The Blenders that tests run scripts in, each as a process of its own, so that the tests never import bpy."""
from __future__ import annotations

import importlib.util
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
_PYTHON = "Scripts/python.exe" if os.name == "nt" else "bin/python"
OLDER = Path(os.environ.get("FIT_FLARE_OLDER", "") or ROOT / ".venv-bpy45" / _PYTHON)
NEWEST = Path(os.environ.get("FIT_FLARE_NEWEST", "") or ROOT / ".venv-bpy53" / _PYTHON)
NEWEST_MISSING = ROOT / ".venv-bpy53.missing"  # `make setup` writes there why it installed none


@dataclass(frozen=True)
class Blender:
    """A Python that has Blender as a module; `run` gives back what a script printed last, read as JSON."""

    python: Path

    def run(self, script: Path, *args: object, user: Path) -> Any:
        command: Sequence[str] = [str(self.python), str(script), *map(str, args)]
        environment = {**os.environ, "BLENDER_USER_RESOURCES": str(user)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
        lines = [line for line in done.stdout.splitlines() if line.startswith(("{", "["))]
        return json.loads(lines[-1])


@dataclass(frozen=True)
class Program(Blender):
    """A whole Blender, by the words that start it; the script sees the words that a module's would."""

    words: tuple[str, ...] = ()

    def run(self, script: Path, *args: object, user: Path) -> Any:
        """Run a script in this Blender and return the JSON that it prints last. user: folder of Blender's user
        resources."""
        argv = [str(script), *map(str, args)]
        code = f"import runpy, sys; sys.argv = {argv!r}; runpy.run_path({str(script)!r}, run_name='__main__')"
        command = [*self.words, "-b", "--python-exit-code", "1", "--python-expr", code]
        environment = {**os.environ, "BLENDER_USER_RESOURCES": str(user)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240, check=False)
        assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
        lines = [line for line in done.stdout.splitlines() if line.startswith(("{", "["))]
        return json.loads(lines[-1])


def named() -> Blender | None:
    """The Blender that FIT_FLARE_BLENDER names, a program or a whole command line."""
    text = os.environ.get("FIT_FLARE_BLENDER", "")
    args = [text] if Path(text).is_file() else shlex.split(text, posix=os.name != "nt")
    return Program(Path(args[0]), tuple(args)) if args else None


def newer() -> Blender | None:
    """Blender 5 beside the engine."""
    return Blender(Path(sys.executable)) if importlib.util.find_spec("bpy") else None


def older() -> Blender | None:
    """Blender 4.5 in a Python without an engine, or what FIT_FLARE_OLDER names."""
    return Blender(OLDER) if OLDER.is_file() else None


def newest() -> Blender | None:
    """Blender 5.3 in a Python 3.13 without an engine, or what FIT_FLARE_NEWEST names."""
    is_complete = os.environ.get("FIT_FLARE_NEWEST") or (ROOT / ".venv-bpy53" / ".ready").is_file()
    return Blender(NEWEST) if is_complete and NEWEST.is_file() else None


def missing_reason(name: str) -> str:
    """Return why a test of the Blender of this name is skipped."""
    if name == "named":
        return "no Blender is named by FIT_FLARE_BLENDER"
    if name == "newest":
        why = NEWEST_MISSING.read_text(encoding="utf-8").strip() if NEWEST_MISSING.is_file() else "run `make setup`"
        return f"Blender 5.3 is not set up here: {why}"
    return f"the {name} Blender is not set up here (`make setup`)"
