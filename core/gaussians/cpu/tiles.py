# SPDX-License-Identifier: GPL-3.0-or-later
"""Bins records into tiles: runs the kernels of `binning` for `scene` and `splats`."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from . import binning, buffers, layout
from .buffers import Array
from .threads import parallel

EMPTY = np.empty(0, np.float32)
MAX_PARTS, SAMPLE_SIZE = 8, 2048
"""Most parts that are sorted separately, and the number of Gaussians sampled to balance them."""


@dataclass(frozen=True)
class TileGrid:
    """Size of a picture, px, and its number of tiles."""

    width: int
    height: int

    @property
    def tiles_x(self) -> int:
        return -(-self.width // layout.TILE_WIDTH)

    @property
    def tiles(self) -> int:
        return self.tiles_x * -(-self.height // layout.TILE_HEIGHT)


@dataclass(frozen=True)
class Bins:
    """Entries by tile, and the slots of each Gaussian; see `binning`.

    entries   flat, `layout.ENTRY` numbers each, tile by tile
    starts    (tiles + 1,) number of the first entry of each tile
    firsts    (n,) first slot of each Gaussian
    counts    (n,) number of its slots
    slots     number of all slots, including unused ones
    """

    entries: Array
    starts: Array
    firsts: Array
    counts: Array
    slots: int


def flat(tensor: Tensor) -> Array:
    """Return the numbers of a float32 tensor as a flat array, without a copy if the tensor is contiguous."""
    return (tensor.detach() if tensor.requires_grad else tensor).numpy().ravel()


def bin_gaussians(
    records: Array, keys: Array, tiles: Array, rows: Array, bounds: Array, firsts: Array, chunk_bounds: Array,
    grid: TileGrid,
) -> Bins:  # fmt: skip
    """Sort n records into tiles, by key; for the arguments see `binning.list_sorted`, which replaces bounds by counts
    and firsts by first slots.

    chunk_bounds: sums of the bounds over chunks."""
    n, parts = len(keys), min(torch.get_num_threads(), MAX_PARTS)  # each part scans all keys
    starts_of_chunks, cuts = np.empty(len(chunk_bounds), np.int64), np.empty(parts + 1, np.int64)
    capacity = binning.plan_parts(
        keys, bounds, chunk_bounds, max(1, -(-n // SAMPLE_SIZE)), np.empty(binning.HISTOGRAM_BINS, np.int64),
        starts_of_chunks, cuts,
    )  # fmt: skip
    # Each part needs one place more than it lists: it may write an entry that it does not count.
    tile_list = buffers.empty((capacity + parts) * binning.LIST_ENTRY, np.int32)
    spans, tile_counts = np.empty((parts, 2), np.int64), np.empty((parts, grid.tiles), np.int32)
    parallel(
        binning.list_sorted, records, keys, tiles, rows, bounds, firsts, starts_of_chunks, cuts, grid.width,
        grid.height, grid.tiles_x, np.zeros(2, np.int64), np.empty((parts, binning.DIGITS, 1 << 11), np.int32),
        buffers.empty(2 * (n + parts), np.int64).reshape(2, -1), tile_list, spans, tile_counts,
    )  # fmt: skip
    starts = np.empty(grid.tiles + 1, np.int64)
    binning.scan_tile_counts(tile_counts, starts)
    entries = buffers.empty(int(starts[-1]) * layout.ENTRY, np.int32)
    parallel(binning.scatter, tile_list, spans, tile_counts, entries)
    return Bins(entries, starts, firsts, bounds, capacity)
