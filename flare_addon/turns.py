# SPDX-License-Identifier: GPL-3.0-or-later
"""Computations in steps (`core/system/steps.py`) that a timer runs in short turns, so that the window stays responsive.
"""
from __future__ import annotations

import time

from ..core.system.steps import PAUSE, Steps

TURN_S = 0.02
"""Seconds for which a turn may block the window; a longer step is not interrupted."""
INTERVAL_S = 0.005
"""Seconds between two turns."""


def run_turn(steps: Steps[None]) -> bool:
    """Run steps for `TURN_S`, at least one, or until one yields PAUSE. Return whether steps remain.

    Raises what the steps raise.
    """
    start = time.perf_counter()
    try:
        while next(steps) != PAUSE and time.perf_counter() - start < TURN_S:
            pass
    except StopIteration:
        return False
    return True
