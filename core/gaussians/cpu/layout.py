# SPDX-License-Identifier: GPL-3.0-or-later
"""Layout of the arrays that kernels pass on to each other: records, gradient rows and entries of tiles.

The arrays are flat. `record` is the index of a record's first number in `records`, and a field is read at `record` +
its constant here; likewise for rows and entries.
"""
from __future__ import annotations

import numpy as np

from .. import rendering

# A tile is one vector wide.
TILE_SHIFT_X, TILE_SHIFT_Y = 4, 6
TILE_WIDTH, TILE_HEIGHT = 1 << TILE_SHIFT_X, 1 << TILE_SHIFT_Y

# A record of 16 float32, a cache line, for each Gaussian. `projection` defines A, K, D, STEP and RUN. REACH: the
# exponent A u² + D d_y² at the rim. HALF_X, HALF_Y: half size of the bounding box, px. K_REST: what K loses by
# rounding, for needles; 0 in scenes.
X, Y, A, K, D, OPACITY, STEP, RUN, RED, GREEN, BLUE, DEPTH, REACH, HALF_X, HALF_Y, K_REST = range(16)
RECORD = 16

CHUNK = 1024
"""Gaussians that a thread processes at a time."""

# A row of gradients for each pair of Gaussian and tile: sums of g u, g d_y, g u², g u d_y, g d_y², g; then those of
# colour and depth, or of ring and arc (`flare`).
G_U, G_Y, G_UU, G_UY, G_YY, G, G_RED, G_GREEN, G_BLUE, G_DEPTH = range(10)
G_R0, G_WIDTH, G_ARC_U, G_ARC_Y = range(9, 13)

# An entry of a tile, int32: which Gaussian, first row within the tile and the row after the last, slot of its row of
# gradients.
GAUSSIAN, FIRST_ROW, END_ROW, SLOT, ENTRY = 0, 1, 2, 3, 4

OPACITY_MAX, ALPHA_MIN = np.float32(rendering.OPACITY_MAX), np.float32(rendering.ALPHA_MIN)
T_MIN = np.float32(rendering.TRANSMITTANCE_MIN)
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
