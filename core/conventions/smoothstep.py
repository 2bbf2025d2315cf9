# SPDX-License-Identifier: GPL-3.0-or-later
"""The smoothstep curve, by which scores and fades rise from one bound to another."""
from __future__ import annotations

from typing import Any

import numpy as np


def smoothstep(value: Any, low: float, high: float) -> Any:
    """Return 0 below `low`, 1 above `high`, a cubic between; reversed for low > high. value: a number or an array."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)
