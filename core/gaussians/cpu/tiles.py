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
PARTS_MAX, SAMPLE = 8, 2048
"""Parts of the Gaussians that are sorted apart, and how many of them are asked where to cut."""


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
    return (tensor.detach() if tensor.requires_grad else tensor).numpy().ravel()


def bin_gaussians(
    records: Array, keys: Array, tiles: Array, rows: Array, bounds: Array, firsts: Array, chunk_bounds: Array,
    grid: Grid,
) -> Bins:  # fmt: skip
    """Sorts the n records into tiles, by key; the arguments are those of `binning.list_in_order`, which changes bounds
    and firsts, and the sums of the bounds over chunks."""
    n, parts = len(keys), min(torch.get_num_threads(), PARTS_MAX)  # each looks through all keys
    starts_of_chunks, cuts = np.empty(len(chunk_bounds), np.int64), np.empty(parts + 1, np.int64)
    room = binning.plan(
        keys, bounds, chunk_bounds, max(1, -(-n // SAMPLE)), np.empty(binning.CLASSES, np.int64), starts_of_chunks, cuts
    )
    listed = buffers.empty((room + parts) * binning.LISTED, np.int32)
    spans, numbers = np.empty((parts, 2), np.int64), np.empty((parts, grid.tiles), np.int32)
    parallel(
        binning.list_in_order, records, keys, tiles, rows, bounds, firsts, starts_of_chunks, cuts, grid.width,
        grid.height, grid.tiles_x, np.zeros(2, np.int64), np.empty((parts, binning.DIGITS, 1 << 11), np.int32),
        buffers.empty(2 * (n + parts), np.int64).reshape(2, -1), listed, spans, numbers,
    )  # fmt: skip
    starts = np.empty(grid.tiles + 1, np.int64)
    binning.deal(numbers, starts)
    entries = buffers.empty(int(starts[-1]) * layout.ENTRY, np.int32)
    parallel(binning.scatter, listed, spans, numbers, entries)
    return Bins(entries, starts, firsts, bounds, room)
