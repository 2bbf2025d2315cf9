# SPDX-License-Identifier: GPL-3.0-or-later
"""The driven flow in a real Blender's window, where one is named: FIT_FLARE_BLENDER_WINDOW=/path/to/blender, or
FIT_FLARE_WINDOW_COMMAND with a command line as tests/window/run.py takes it."""
from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from run import agreement

BLENDER, COMMAND = (os.environ.get(f"FIT_FLARE_{name}", "") for name in ("BLENDER_WINDOW", "WINDOW_COMMAND"))


@pytest.mark.skipif(not BLENDER and not COMMAND,
                    reason="neither FIT_FLARE_BLENDER_WINDOW nor FIT_FLARE_WINDOW_COMMAND names a real Blender; "
                           "the flow of tests/window was not run")
def test_the_whole_work_in_the_real_window(tmp_path: Path) -> None:
    """The way of an artist from import to transfer works by mouse and keys, without blocking the window."""
    runner = Path(__file__).with_name("run.py")
    done = subprocess.run([sys.executable, str(runner), "--blender", BLENDER, "--out", str(tmp_path)],
                          capture_output=True, text=True, timeout=1500, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["done"][-1] == "all"
    assert max(facts["ours_at_work_ms"].values()) < 100
    assert agreement(tmp_path) > 50
