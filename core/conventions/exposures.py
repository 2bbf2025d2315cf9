# SPDX-License-Identifier: GPL-3.0-or-later
"""The exposures of a run's frames, relative to the capture's median frame.

`core/fit` writes the file; bake and the add-on read it, so it needs numpy alone.
"""
from __future__ import annotations

from pathlib import Path

from ..choices import Blend
from ..errors import RunError
from ..system.files import read_json

FILE = "exposures.json"
"""File in the folder of a run: exposure by view. Absent where all frames are exposed alike."""
MIN_EXPOSURE = 2.0**-10
"""Smallest exposure; the greatest is its inverse. Ten stops either way cover all frames of one capture."""
DISPLAY_GAMMA = 2.2
"""Gamma by which display values follow the exposure."""


def read_exposures(folder: Path) -> dict[str, float]:
    """Read the exposures of the run in a folder; empty where there is no file. Raises RunError where it is damaged."""
    path = folder / FILE
    if not path.exists():
        return {}
    exposures = read_json(path, RunError)
    if not isinstance(exposures, dict) or not all(
            isinstance(value, int | float) and MIN_EXPOSURE <= value <= 1 / MIN_EXPOSURE
            for value in exposures.values()):
        raise RunError(f"{path} is damaged; fit the capture again.")
    return {name: float(value) for name, value in exposures.items()}


def colour_scale(exposure: float, blend: Blend) -> float:
    """Factor on the colours of a flare's Gaussians: linear light where it adds, display values where it covers."""
    return exposure if blend == "add" else exposure ** (1 / DISPLAY_GAMMA)
