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


def robust_bounded_fit(design_matrix: Floats, values: Floats, initial: Floats, low: ArrayLike, high: ArrayLike,
                       prior_weight: float) -> Floats:
    """Bounded L1 regression by iteratively reweighted least squares.

    Return x (n,) within bounds that minimises the sum of absolute residuals, values (m,) - design_matrix (m, n) @ x.

    low, high: the bounds, (n,) or one for all. prior_weight: half of m * prior_weight times the squared distance of x
    from `initial` (n,) is added to the sum, so that x stays there where the values do not decide.
    """
    lower, upper = np.broadcast_to(low, initial.shape), np.broadcast_to(high, initial.shape)
    solution, weights = initial.copy(), np.ones(len(values))
    prior = prior_weight * max(len(values), 1) * np.eye(len(initial))
    for _ in range(REWEIGHTINGS):
        weighted = design_matrix.T * weights
        solution = bounded_least_squares(weighted @ design_matrix + prior, weighted @ values + prior @ initial,
                                         solution, lower, upper)
        # So weighted, the square of a residual counts as its absolute value.
        weights = 1 / (np.abs(values - design_matrix @ solution) + L1_EPSILON)
    return solution


def bounded_least_squares(normal_matrix: Floats, normal_vector: Floats, initial: Floats, lower: Floats,
                          upper: Floats) -> Floats:
    """Minimise x^T A x / 2 - b^T x over x (n,) within bounds, by coordinate descent; return x.

    normal_matrix (n, n), normal_vector (n,): A and b of the normal equations A x = b, which x solves where no bound is
    reached. initial: where to start, (n,). lower, upper: the bounds, (n,).
    """
    solution = initial.copy()
    for _ in range(DESCENT_SWEEPS):
        for index in range(len(solution)):
            diagonal = normal_matrix[index, index]
            residual = normal_vector[index] - normal_matrix[index] @ solution + diagonal * solution[index]
            solution[index] = min(max(residual / diagonal, lower[index]), upper[index])
    return solution
