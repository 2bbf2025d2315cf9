# SPDX-License-Identifier: GPL-3.0-or-later
"""Installs the engine: `python headless/set_up.py FOLDER` makes a virtual environment there and fills it.

The add-on runs it with Blender's own Python, which has pip; it needs nothing but the standard library. The
packages are those of the group "engine" in pyproject.toml, at the versions of constraints.txt where this
Python has them. Events go to standard output, one JSON object a line (core/progress.py). A folder that a
stopped set-up left is made anew.
"""
from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def say(**event: object) -> None:
    print(json.dumps(event), flush=True)


def packages() -> list[str]:
    """Names of the engine's packages."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return list(project["dependency-groups"]["engine"])


def python_in(folder: Path) -> Path:
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def main(words: list[str]) -> int:
    if not words:
        print(__doc__, file=sys.stderr)
        return 2
    folder, wanted = Path(words[0]), words[1:] or packages()
    steps = ["a place of its own", *wanted, "a test"]
    say(type="stage", name="set up", total=len(steps), done=0)
    shutil.rmtree(folder, ignore_errors=True)
    python = python_in(folder)
    constraints = ROOT / "constraints.txt"
    pip = [str(python), "-m", "pip", "install", "--disable-pip-version-check", "--no-input"]
    if constraints.is_file():
        pip += ["-c", str(constraints)]
    test = "import importlib.util, sys; sys.exit(importlib.util.find_spec('torch') is None)"
    commands = [[sys.executable, "-m", "venv", str(folder)], *([*pip, name] for name in wanted)]
    if not words[1:]:
        commands.append([str(python), "-c", test])
    for number, (what, command) in enumerate(zip(steps, commands, strict=False)):
        say(type="say", text=f"Installing {what}")
        done = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=sys.stderr, stderr=sys.stderr, check=False)
        if done.returncode:
            shutil.rmtree(folder, ignore_errors=True)
            say(type="error", text=f"{what.capitalize()} could not be installed (status {done.returncode}); look at "
                                   "the log, check the network and the free disk space, and set up again.")
            return 1
        say(type="progress", stage="set up", done=number + 1, total=len(steps), left_s=None, figures={})
    say(type="result", data={"engine": str(python)})
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        say(type="error", text="Stopped during set up as asked; set up again to go on.")
        sys.exit(130)
