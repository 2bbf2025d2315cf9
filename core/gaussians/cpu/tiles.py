# SPDX-License-Identifier: GPL-3.0-or-later
"""From records to tiles: what the scene and the flare have in common around the kernels of `binning`."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from . import binning, buffers, layout
from .buffers import Array
from .threads import parallel

EMPTY = np.empty(0, np.float32)


@dataclass(frozen=True)
class Grid:
    """A picture and its tiles."""

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
    """Entries by tile, and the slots of each Gaussian; see `binning`."""

    entries: Array
    starts: Array
    firsts: Array
    counts: Array
    slots: int


def flat(tensor: Tensor) -> Array:
    """The numbers of a float32 tensor, as one contiguous row; the same memory if they are."""
    return np.ravel(tensor.detach().numpy())


def bin_gaussians(
    records: Array, bounds: Array, chunk_bounds: Array, grid: Grid, *, by_depth: bool = True
) -> Bins:
    """Sorts the n records into tiles; by depth or in the order given."""
    n = len(bounds)
    starts_of_chunks = np.cumsum(chunk_bounds) - chunk_bounds
    room = int(chunk_bounds.sum())
    slots = buffers.empty(room, np.int32)
    firsts, counts = buffers.empty(n, np.int32), buffers.empty(n, np.int32)
    keys, spare_keys = buffers.empty(n, np.uint32), buffers.empty(n, np.uint32)
    order, spare_order = buffers.empty(n, np.int32), buffers.empty(n, np.int32)
    places = np.empty((binning.DIGITS, 1 << 11), np.int32)
    parallel(
        binning.list_and_sort, records, records.view(np.uint32), bounds, starts_of_chunks,
        grid.width, grid.height, grid.tiles_x, by_depth, slots, firsts, counts,
        places, keys, spare_keys, order, spare_order,
    )  # fmt: skip
    m = int(np.count_nonzero(bounds))
    numbers = np.empty((torch.get_num_threads(), grid.tiles), np.int32)
    starts = np.empty(grid.tiles + 1, np.int64)
    parallel(binning.count, order, m, slots, firsts, counts, numbers)
    binning.deal(numbers, starts)
    entries = buffers.empty(int(starts[-1]) * layout.ENTRY, np.int32)
    parallel(binning.scatter, order, m, slots, firsts, counts, numbers, entries)
    return Bins(entries, starts, firsts, counts, room)
