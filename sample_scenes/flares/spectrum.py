# SPDX-License-Identifier: GPL-3.0-or-later
"""Wavelengths and what a camera's red, green and blue make of them."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHORTEST, LONGEST = 0.40, 0.70
"""Micrometres."""
PEAKS = (0.605, 0.540, 0.455)
WIDTHS = (0.046, 0.044, 0.036)


def wavelengths(count: int) -> Array:
    """Middles of `count` equal bands, micrometres."""
    return SHORTEST + (np.arange(count) + 0.5) * (LONGEST - SHORTEST) / count


def responses(count: int) -> Array:
    """(count, 3): share of each band in R, G, B, a bell about each peak; an even spectrum gives (1, 1, 1).

    Bells of a camera's kind, not the eye's matching functions: those are negative in places, and light of
    one colour must never take away from another.
    """
    bells = np.exp(-0.5 * ((wavelengths(count)[:, None] - PEAKS) / WIDTHS) ** 2)
    return bells / bells.sum(axis=0)
