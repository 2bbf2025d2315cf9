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
    def num_tiles(self) -> int:
        return self.tiles_x * -(-self.height // layout.TILE_HEIGHT)


@dataclass(frozen=True)
class Bins:
    """Entries by tile, and the slots of each Gaussian; see `binning`.

    entries      flat, `layout.ENTRY` numbers each, tile by tile
    starts       (tiles + 1,) number of the first entry of each tile
    first_slots  (n,) first slot of each Gaussian
    slot_counts  (n,) number of its slots
    num_slots    number of all slots, including unused ones
    """

    entries: Array
    starts: Array
    first_slots: Array
    slot_counts: Array
    num_slots: int


def flat(tensor: Tensor) -> Array:
    """Return the numbers of a float32 tensor as a flat array, without a copy if the tensor is contiguous."""
    return (tensor.detach() if tensor.requires_grad else tensor).numpy().ravel()


def bin_gaussians(
    records: Array, keys: Array, small_tiles: Array, small_rows: Array, max_tiles: Array, first_slots: Array,
    chunk_max_tiles: Array, grid: TileGrid,
) -> Bins:  # fmt: skip
    """Sort n Gaussians into tiles, lowest key first; overwrites max_tiles and first_slots, which the result contains.

    records                  flat, 16 numbers for each Gaussian (`layout`)
    keys                     (n,) uint32; `binning.CULLED_KEY` for a Gaussian that is not drawn
    small_tiles, small_rows  (n,) results of `binning.small_footprints`; -1 for larger Gaussians
    max_tiles                (n,) upper bound on each Gaussian's number of tiles; becomes slot_counts
    first_slots              (n,) exclusive sums of max_tiles within chunks of CHUNK Gaussians; become first slots
    chunk_max_tiles          (chunks,) sums of max_tiles by chunk"""
    n = len(keys)
    parts = min(torch.get_num_threads(), MAX_PARTS, len(chunk_max_tiles))  # each part scans all keys
    chunk_starts, cuts = np.empty(len(chunk_max_tiles), np.int64), np.empty(parts + 1, np.int64)
    num_slots = binning.plan_parts(
        keys, max_tiles, chunk_max_tiles, max(1, -(-n // SAMPLE_SIZE)), np.empty(binning.HISTOGRAM_BINS, np.int64),
        chunk_starts, cuts,
    )  # fmt: skip
    # Each part needs one place more than it lists: it may write an entry that it does not count.
    tile_list = buffers.empty((num_slots + parts) * binning.LIST_ENTRY, np.int32)
    spans, tile_counts = np.empty((parts, 2), np.int64), np.empty((parts, grid.num_tiles), np.int32)
    parallel(
        binning.list_sorted, records, keys, small_tiles, small_rows, max_tiles, first_slots, chunk_starts, cuts,
        grid.width, grid.height, grid.tiles_x, np.zeros(2, np.int64),
        np.empty((parts, binning.DIGITS, 1 << 11), np.int32), buffers.empty(2 * (n + parts), np.int64).reshape(2, -1),
        tile_list, spans, tile_counts, limit=parts,
    )  # fmt: skip
    starts = np.empty(grid.num_tiles + 1, np.int64)
    binning.scan_tile_counts(tile_counts, starts)
    entries = buffers.empty(int(starts[-1]) * layout.ENTRY, np.int32)
    parallel(binning.scatter_entries, tile_list, spans, tile_counts, entries, limit=parts)
    return Bins(entries, starts, first_slots, max_tiles, num_slots)
