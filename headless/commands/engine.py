# SPDX-License-Identifier: GPL-3.0-or-later
"""engine: reports the versions and the device of the engine, and tests it."""
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
    """Add no options."""


def run(_args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Report version, torch and device. Raises EngineError where a test rasterisation gives a wrong result."""
    import torch

    from ...core.gaussians import splat

    version = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))["version"]
    # Two equal Gaussians of light 1 in the middle of a picture of 16 pixels.
    centres = torch.full((2, 2), 8.0)
    covariances = torch.tensor([[4.0, 0.0, 4.0]]).repeat(2, 1)
    light = splat(centres, covariances, torch.ones(2), torch.ones(2, 3), 16, 16, blend="add").colour
    if not float(light.max()) > 1:  # both Gaussians overlap; also false for NaN
        raise EngineError(f"The engine of {sys.executable} rasterises wrongly: two Gaussians of light 1 add up to "
                          f"{float(light.max()):.3g}; set it up again.")
    threads = torch.get_num_threads()
    device = (torch.cuda.get_device_name(0) if torch.cuda.is_available()
              else f"CPU, {threads} thread{'s' if threads > 1 else ''}")
    progress.say(f"Fit Flare {version}, Python {platform.python_version()}, torch {torch.__version__}, {device}.")
    return {"version": version, "python": platform.python_version(), "torch": str(torch.__version__), "device": device}


COMMAND = Command(
    "engine", "Reports the versions and the device of the engine.",
    """Rasterises two Gaussians as a test.

  run.py engine""",
    arguments, (Step("engine", "engine", run),))
