# SPDX-License-Identifier: GPL-3.0-or-later
"""What torch reads from the environment."""
from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_it_is_prepared_without_torch_and_what_the_user_has_set_stays() -> None:
    script = ("import os, sys; from core.torch_environment import prepare_for_torch; prepare_for_torch(); "
              "assert 'torch' not in sys.modules; "
              "print(os.environ['OMP_WAIT_POLICY'], os.environ['THP_MEM_ALLOC_ENABLE'])")
    given = {name: value for name, value in os.environ.items() if name != "THP_MEM_ALLOC_ENABLE"}
    found = subprocess.run([sys.executable, "-c", script], cwd=ROOT, env={**given, "OMP_WAIT_POLICY": "ACTIVE"},
                           capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["ACTIVE", "1"]


def test_the_door_prepares_it() -> None:
    script = ("import os, runpy, sys; sys.argv = ['run.py', '--help']\n"
              "try: runpy.run_path('headless/run.py', run_name='__main__')\n"
              "except SystemExit: pass\n"
              "print(os.environ['OMP_WAIT_POLICY'], os.environ['THP_MEM_ALLOC_ENABLE'])")
    given = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "THP_"))}
    found = subprocess.run([sys.executable, "-c", script], cwd=ROOT, env=given, capture_output=True, text=True,
                           check=True)
    assert found.stdout.split()[-2:] == ["PASSIVE", "1"]
