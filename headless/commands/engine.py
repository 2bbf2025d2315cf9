# SPDX-License-Identifier: GPL-3.0-or-later
"""engine: what the engine of this Python is."""
from __future__ import annotations

import argparse
import platform
import sys
import tomllib
from pathlib import Path
from typing import Any

from ...core.errors import EngineError
from ...core.system.progress import Progress
from ..command import Command, Step

ROOT = Path(__file__).resolve().parents[2]


def arguments(_parser: argparse.ArgumentParser) -> None:
    """It takes none."""


def run(_words: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Version, torch and device; splats a few Gaussians, and raises EngineError where that comes to nothing."""
    import torch

    from ...core.gaussians import splat

    version = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))["version"]
    centres = torch.full((2, 2), 8.0)
    covariances = torch.tensor([[4.0, 0.0, 4.0]]).repeat(2, 1)
    light = splat(centres, covariances, torch.ones(2), torch.ones(2, 3), 16, 16, blend="add").colour
    if not float(light.max()) > 1:  # where both lie over each other; no number is no more
        raise EngineError(f"The engine of {sys.executable} splats wrong: two Gaussians of light 1 come to "
                          f"{float(light.max()):.3g}; set it up anew.")
    threads = torch.get_num_threads()
    device = (torch.cuda.get_device_name(0) if torch.cuda.is_available()
              else f"CPU, {threads} thread{'s' if threads > 1 else ''}")
    progress.say(f"Fit Flare {version}, Python {platform.python_version()}, torch {torch.__version__}, {device}.")
    return {"version": version, "python": platform.python_version(), "torch": str(torch.__version__), "device": device}


COMMAND = Command(
    "engine", "Says what the engine is: versions and device.",
    """Splats two Gaussians to see that it works.

  run.py engine""",
    arguments, (Step("engine", "engine", run),))
