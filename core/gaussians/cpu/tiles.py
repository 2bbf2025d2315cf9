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
PARTS_MAX, SAMPLE = 8, 1024
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
    return np.ravel(tensor.detach().numpy())


def bin_gaussians(
    records: Array, keys: Array, bounds: Array, firsts: Array, chunk_bounds: Array, grid: Grid
) -> Bins:
    """Sorts the n records into tiles, by key; the arguments are those of `binning.list_in_order`, which changes bounds
    and firsts, and the sums of the bounds over chunks."""
    n, parts = len(keys), min(torch.get_num_threads(), PARTS_MAX)  # each looks through all keys
    room = int(chunk_bounds.sum())
    listed = buffers.empty(room * binning.LISTED, np.int32)
    spans, numbers = np.empty((parts, 2), np.int64), np.empty((parts, grid.tiles), np.int32)
    parallel(
        binning.list_in_order, records, keys, bounds, firsts, np.cumsum(chunk_bounds) - chunk_bounds,
        _cuts(keys, bounds, parts), grid.width, grid.height, grid.tiles_x,
        np.zeros(2, np.int64), np.empty((parts, binning.DIGITS, 1 << 11), np.int32),
        buffers.empty(2 * (n + parts), np.int64).reshape(2, -1), listed, spans, numbers,
    )  # fmt: skip
    starts = np.empty(grid.tiles + 1, np.int64)
    binning.deal(numbers, starts)
    entries = buffers.empty(int(starts[-1]) * layout.ENTRY, np.int32)
    parallel(binning.scatter, listed, spans, numbers, entries)
    return Bins(entries, starts, firsts, bounds, room)


def _cuts(keys: Array, bounds: Array, parts: int) -> Array:
    """(parts + 1,) keys between which there is about the same number of tiles to list, judged by a sample."""
    cuts = np.zeros(parts + 1, np.int64)
    cuts[parts] = binning.NOWHERE
    if parts > 1 and len(keys):
        step = -(-len(keys) // SAMPLE)
        order = np.argsort(keys[::step])
        work = np.cumsum(bounds[::step][order])
        places = np.searchsorted(work, work[-1] * np.arange(1, parts) / parts)
        cuts[1:parts] = np.minimum(keys[::step][order[places]], binning.NOWHERE)
    return cuts
