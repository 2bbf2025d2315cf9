# SPDX-License-Identifier: GPL-3.0-or-later
"""The joint fit of scene and flare: settings, training, checkpoints, and the run folder it leaves."""
from __future__ import annotations

from .run import Run
from .run_loop import fit
from .settings import FitSettings, preset

__all__ = ["FitSettings", "Run", "fit", "preset"]
