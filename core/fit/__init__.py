# SPDX-License-Identifier: GPL-3.0-or-later
"""The joint fit of scene and flare to a capture.

`run_loop.fit` runs it: `initialise` makes the first scene and flare, `trainer` optimises them, and `run` is the folder
of settings, checkpoint and results that `core.bake`, `core.metrics` and `core.transfer` read.
"""
from __future__ import annotations

from .run import Run
from .run_loop import fit
from .settings import FitSettings, preset

__all__ = ["FitSettings", "Run", "fit", "preset"]
