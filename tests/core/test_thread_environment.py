# SPDX-License-Identifier: GPL-3.0-or-later
"""What numpy and torch read from the environment."""
from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from core.system.thread_environment import VARIABLES

ROOT = Path(__file__).resolve().parents[2]
OTHERS = {name: value for name, value in os.environ.items() if name not in VARIABLES}


def variables_after(script: str, given: dict[str, str]) -> dict[str, str | None]:
    """VARIABLES as a process finds them in its environment after the script."""
    report = f"\nimport json, os; print(json.dumps({{name: os.environ.get(name) for name in {list(VARIABLES)}}}))"
    found = subprocess.run([sys.executable, "-c", script + report], cwd=ROOT, env={**OTHERS, **given},
                           capture_output=True, text=True, check=True)
    read: dict[str, str | None] = json.loads(found.stdout.splitlines()[-1])
    return read


def test_thread_variables_are_set_and_the_user_s_are_kept() -> None:
    script = ("import sys; from core.system.thread_environment import set_thread_environment\n"
              "set_thread_environment(); assert not {'numpy', 'torch'} & set(sys.modules)")
    assert variables_after(script, {"OMP_WAIT_POLICY": "ACTIVE"}) == {**VARIABLES, "OMP_WAIT_POLICY": "ACTIVE"}


def test_the_command_line_sets_the_thread_environment() -> None:
    script = ("import runpy, sys; sys.argv = ['run.py', '--help']\n"
              "try: runpy.run_path('headless/run.py', run_name='__main__')\n"
              "except SystemExit: pass")
    assert variables_after(script, {}) == VARIABLES
