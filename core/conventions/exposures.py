# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames of one capture that were exposed to more or less light than most: as a run keeps them, and what a flare looks
like in them. Blender reads them too, so numpy is all it takes."""
from __future__ import annotations

from pathlib import Path

from ..choices import Blend
from ..errors import RunError
from ..system.files import read_json

FILE = "exposures.json"
"""In the folder of a run: by view, times the light of a frame in the middle. Absent where all are exposed alike."""
LEAST = 2.0**-10
"""Ten stops: no frames of one capture are farther apart."""
DISPLAY_GAMMA = 2.2
"""Of display values, by which what covers is brighter or darker where there is more light or less."""


def read(folder: Path) -> dict[str, float]:
    """Of the run in a folder; empty where there is no list. Raises RunError where it is damaged."""
    path = folder / FILE
    if not path.exists():
        return {}
    exposures = read_json(path, RunError)
    if not isinstance(exposures, dict) or not all(isinstance(one, int | float) and LEAST <= one <= 1 / LEAST
                                                  for one in exposures.values()):
        raise RunError(f"{path} is damaged; fit the capture again.")
    return {name: float(one) for name, one in exposures.items()}


def brightness(exposure: float, blend: Blend) -> float:
    """Times the colours of a flare's Gaussians: linear light where it adds, display values where it covers."""
    return exposure if blend == "add" else exposure ** (1 / DISPLAY_GAMMA)
