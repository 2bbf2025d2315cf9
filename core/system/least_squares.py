# SPDX-License-Identifier: GPL-3.0-or-later
"""Solves small least squares problems whose unknowns have bounds, such as the gains of layers in a picture."""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

REWEIGHTINGS, DESCENT_SWEEPS = 8, 50
"""Reweightings of the least squares, and sweeps of coordinate descent in each."""
L1_EPSILON = 0.01
"""Residuals below this count by their squares."""


def robust_bounded_fit(columns: Floats, values: Floats, start: Floats, low: ArrayLike, high: ArrayLike,
                       prior_weight: float) -> Floats:
    """Return x (n,) within bounds that brings columns (m, n) @ x nearest to values (m,), by least absolute errors.

    low, high: the bounds, (n,) or one for all. prior_weight: per value, of the squared distance from `start`, which
    decides where the values do not.
    """
    lower, upper = np.broadcast_to(low, start.shape), np.broadcast_to(high, start.shape)
    solution, weights = start.copy(), np.ones(len(values))
    prior = prior_weight * max(len(values), 1) * np.eye(len(start))
    for _ in range(REWEIGHTINGS):
        weighted = columns.T * weights
        solution = bounded_least_squares(weighted @ columns + prior, weighted @ values + prior @ start, solution,
                                         lower, upper)
        # So weighted, the square of a residual counts as its absolute value.
        weights = 1 / (np.abs(values - columns @ solution) + L1_EPSILON)
    return solution


def bounded_least_squares(product: Floats, target: Floats, start: Floats, low: Floats, high: Floats) -> Floats:
    """Return x (n,) between bounds (n,) that minimises x^T product x / 2 - target^T x, by coordinate descent.

    product (n, n): of the normal equations product x = target, which x solves where no bound holds. start (n,)."""
    solution = start.copy()
    for _ in range(DESCENT_SWEEPS):
        for index in range(len(solution)):
            residual = target[index] - product[index] @ solution + product[index, index] * solution[index]
            solution[index] = min(max(residual / product[index, index], low[index]), high[index])
    return solution
