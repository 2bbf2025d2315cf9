# SPDX-License-Identifier: GPL-3.0-or-later
"""Wavelengths, and a camera's response to them in red, green and blue."""
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIN_WAVELENGTH, MAX_WAVELENGTH = 0.40, 0.70
"""Micrometres."""
PEAKS = (0.605, 0.540, 0.455)
WIDTHS = (0.046, 0.044, 0.036)
"""Peaks and standard deviations of the responses in R, G, B, micrometres."""


def wavelengths(count: int) -> Array:
    """Return the middles of `count` equal bands, micrometres."""
    return MIN_WAVELENGTH + (np.arange(count) + 0.5) * (MAX_WAVELENGTH - MIN_WAVELENGTH) / count


def responses(count: int) -> Array:
    """Return (count, 3), the share of each band in R, G, B: a Gaussian about each peak; an even spectrum gives (1, 1,
    1).

    They are a camera's curves, not the eye's matching functions: those are negative in places, and monochromatic light
    must never reduce another colour.
    """
    bells = np.exp(-0.5 * ((wavelengths(count)[:, None] - PEAKS) / WIDTHS) ** 2)
    return bells / bells.sum(axis=0)
