# SPDX-License-Identifier: GPL-3.0-or-later
"""Assigns Gaussians to tiles, nearest first; called by `tiles.bin_gaussians` between projection and rasterization.

The extent of a Gaussian is the ellipse at which alpha is 1/255, so low opacity makes it smaller (SnugBox of Hanson et
al. 2025, Speedy-Splat). In a column of tiles it covers the pixel rows between the ellipse's smallest and largest y
there (their AccuTile). With X the offset of the column's edge from the centre, and the record's A, k, D, C and reach t
(all but k negative),

    A (X + k y)² + D y² = t   at   y = (-A k X ± sqrt(C t - A D X²)) / C

and the extreme points of the whole ellipse, y = ± half_y, lie at X = ∓ k half_y. For an ellipse far larger than the
picture the root loses all its digits, so y is clamped to ± half_y: nothing is listed beyond the rows that were
counted for the Gaussian.

Each Gaussian has a key; lower keys are drawn first. The key is the bit pattern of the depth, which sorts as the depth
does, or the Gaussian's index. `list_sorted` cuts the range of keys into parts of about equal work, one to a thread at
a time. Each part sorts its own Gaussians and lists their tiles. `scan_tile_counts` and `scatter` then distribute the
lists to the tiles, part after part, so that no tile needs sorting. The result does not depend on the cuts.

Most Gaussians are small: two columns and two rows of tiles at most. Their tiles are computed at projection, for 16
Gaussians at a time (`small_footprints`), and listed without an unpredictable branch.

Each pair of Gaussian and tile has a slot: the index of the gradient row that the tile writes for the Gaussian. The
slots of a Gaussian are consecutive, in the order of the Gaussians, which is the order in which they are read.
"""
from __future__ import annotations

import math

import numpy as np

from .compilation import inlined, kernel
from .layout import (
    CHUNK,
    END_ROW,
    ENTRY,
    FIRST_ROW,
    GAUSSIAN,
    HALF,
    HALF_X,
    HALF_Y,
    ONE,
    REACH,
    RECORD,
    SLOT,
    TILE_HEIGHT,
    TILE_SHIFT_X,
    TILE_SHIFT_Y,
    TILE_WIDTH,
    ZERO,
    A,
    D,
    K,
    X,
    Y,
)
from .vector import (
    atomic_add,
    atomic_increment,
    fma,
    load_scalar,
    maximum,
    minimum,
    opaque,
    prefetch,
    prefetch_to_write,
    splat,
    sqrt,
    to_floats,
    to_ints,
    where,
)

ROW_BITS, ROW_MASK = TILE_SHIFT_Y, TILE_HEIGHT - 1
FIRST_BITS, END_BITS = TILE_SHIFT_Y + 1, TILE_SHIFT_Y + 2
COLUMN_BITS = FIRST_BITS + END_BITS
FIRST_MASK, END_MASK = (1 << FIRST_BITS) - 1, (1 << END_BITS) - 1
DIGITS = 3
PREFETCH_DISTANCE = 8
HISTOGRAM_BINS = 1 << 10
"""Bins of the histogram of keys; parts are cut between bins."""
GAUSSIAN_COST = 2
"""Cost of sorting and visiting a Gaussian, relative to listing one tile."""
LIST_ENTRY = 3
"""int32 numbers of an entry of a tile list: Gaussian, slot, and tile with first and last row packed."""
NEXT_LINE = 32
"""Offset, in int32 numbers, of the cache line that is prefetched behind an entry."""
CULLED_KEY = 0x7F800000
"""Key of a Gaussian that is not drawn: the bits of infinity, above those of every depth."""
ROW_MARGIN = np.float32(0.02)
"""Pixels by which the row range is widened against rounding."""


@inlined
def _min(a, b):
    return a if a < b else b  # one instruction; numba's min also tests for NaN


@inlined
def _max(a, b):
    return a if a > b else b


@inlined
def _pixel_rows(y, low, high, height):
    """Return the first and last pixel row whose centre lies within y + low .. y + high, widened by ROW_MARGIN; first >
    last if none does."""
    top = _max(y + low - (HALF + ROW_MARGIN), ZERO)
    bottom = _min(y + high - (HALF - ROW_MARGIN), np.float32(height - 1))
    first = int(top)
    if np.float32(first) < top:
        first += 1
    return first, int(bottom) if bottom >= ZERO else -1


@inlined
def _crossing(half_x, square, bend, lean, x):
    """Return the smallest and largest y of the ellipse at the horizontal offset x, from its centre. x is clamped to the
    ellipse's extent.

    square = t / C, bend = A D / C², lean = -A k / C."""
    x = _min(_max(x, -half_x), half_x)
    root, middle = math.sqrt(_max(square - bend * x * x, ZERO)), lean * x
    return middle - root, middle + root


@inlined
def small_footprints(x, y, half_x, half_y, major, k, minor, reach, visible, width, height):
    """Return the tiles that 16 Gaussians cover, from the fields of their records.

    For Gaussians with at most two columns and rows of tiles: the first tile (-1 for all others), and the first and end
    pixel row in each column, counted from the first tile's top row. The left column takes the lowest COLUMN_BITS; each
    column has FIRST_BITS and END_BITS, 0 if it is not covered."""
    wide = half_x + ROW_MARGIN
    column = to_ints(maximum(x - wide, ZERO)) >> TILE_SHIFT_X
    columns = (to_ints(minimum(x + wide, splat(np.float32(width - 1)))) >> TILE_SHIFT_X) - column
    above, below = _rows_between(y, -half_y, half_y, height)
    row = above >> TILE_SHIFT_Y
    # columns, rows: one less than the number of tiles covered
    rows = (below >> TILE_SHIFT_Y) - row
    # tip: X of the ellipse's smallest y; its largest y lies at -tip
    tip, inverse = k * half_y, ONE / fma(major * k, k, minor)
    square, bend, lean = reach * inverse, major * inverse * (minor * inverse), -major * k * inverse
    left = to_floats(column << TILE_SHIFT_X) - x
    middle = left + np.float32(TILE_WIDTH)
    right = middle + np.float32(TILE_WIDTH)
    low0, high0 = _crossings(half_x, square, bend, lean, left)
    low1, high1 = _crossings(half_x, square, bend, lean, middle)
    low2, high2 = _crossings(half_x, square, bend, lean, right)
    single = columns < 1
    low = where(single | ((left <= tip) & (tip <= middle)), -half_y, minimum(low0, low1))
    high = where(single | ((left <= -tip) & (-tip <= middle)), half_y, maximum(high0, high1))
    left_rows = _pack_rows(y, half_y, low, high, height, row << TILE_SHIFT_Y)
    low = where((middle <= tip) & (tip <= right), -half_y, minimum(low1, low2))
    high = where((middle <= -tip) & (-tip <= right), half_y, maximum(high1, high2))
    right_rows = where(single, 0, _pack_rows(y, half_y, low, high, height, row << TILE_SHIFT_Y))
    few = visible & (columns < 2) & (rows < 2)
    tiles_x = (width + TILE_WIDTH - 1) >> TILE_SHIFT_X
    return where(few, row * tiles_x + column, -1), where(few, left_rows | (right_rows << COLUMN_BITS), 0)


@inlined
def _rows_between(y, low, high, height):
    """Vector version of `_pixel_rows`."""
    top = maximum(y + low - (HALF + ROW_MARGIN), ZERO)
    bottom = minimum(y + high - (HALF - ROW_MARGIN), splat(np.float32(height - 1)))
    first = to_ints(top)
    return where(to_floats(first) < top, first + 1, first), where(bottom >= ZERO, to_ints(bottom), -1)


@inlined
def _crossings(half_x, square, bend, lean, x):
    """Vector version of `_crossing`."""
    x = minimum(maximum(x, -half_x), half_x)
    root, middle = sqrt(maximum(fma(-bend * x, x, square), ZERO)), lean * x
    return middle - root, middle + root


@inlined
def _pack_rows(y, half_y, low, high, height, base):
    """Pack the first and end pixel row of y + low .. y + high, clamped to the ellipse's own rows; 0 if none.

    base: the pixel row that is counted as 0."""
    first, last = _rows_between(y, maximum(low, -half_y), minimum(high, half_y), height)
    return where(first <= last, (first - base) | ((last + 1 - base) << FIRST_BITS), 0)


@inlined
def _write_two(tile, first, end, tiles_x, i, slots_ahead, tile_list, at, tile_counts):
    """List a tile and the one below, covered in pixel rows first .. end - 1, counted from the upper tile's first row.

    i: the Gaussian; at: next free place of the list, which is returned; slots_ahead: slot of an entry minus its place.
    Both are always written, without a branch; the next entry overwrites one that is not counted."""
    upper = np.int64(first < end) & np.int64(first < TILE_HEIGHT)
    lower = np.int64(end > TILE_HEIGHT)
    tile_list[at * LIST_ENTRY], tile_list[at * LIST_ENTRY + 1] = i, at + slots_ahead
    tile_list[at * LIST_ENTRY + 2] = ((tile << ROW_BITS | first) << ROW_BITS) | (_min(end, TILE_HEIGHT) - 1)
    tile_counts[tile] += upper
    at += upper
    tile += tiles_x * lower  # without a lower tile it stays, so that the index below is inside tile_counts
    tile_list[at * LIST_ENTRY], tile_list[at * LIST_ENTRY + 1] = i, at + slots_ahead
    first = _max(first - TILE_HEIGHT, 0)
    tile_list[at * LIST_ENTRY + 2] = ((tile << ROW_BITS | first) << ROW_BITS) | (end - TILE_HEIGHT - 1)
    tile_counts[tile] += lower
    return at + lower


@inlined
def _write_column(column, top, bottom, tiles_x, i, slots_ahead, tile_list, at, tile_counts):
    """List the tiles of a column that cover pixel rows top .. bottom; return the next free place. Arguments as in
    `_write_two`."""
    row, one = top >> TILE_SHIFT_Y, opaque(1)
    while row << TILE_SHIFT_Y <= bottom:
        base = row << TILE_SHIFT_Y
        first = top - base if top > base else 0
        last = bottom - base if bottom - base < ROW_MASK else ROW_MASK
        tile = row * tiles_x + column
        tile_list[at * LIST_ENTRY], tile_list[at * LIST_ENTRY + 1] = i, at + slots_ahead
        tile_list[at * LIST_ENTRY + 2] = ((tile << ROW_BITS | first) << ROW_BITS) | last
        tile_counts[tile] += 1
        at += one
        row += one
    return at


@inlined
def _list_gaussian(records, i, width, height, tiles_x, slots_ahead, tile_list, place, tile_counts):
    """List the tiles of a Gaussian i of any size from `place` on; return the next free place."""
    at = i * RECORD
    x, extent = load_scalar(records, at + X), load_scalar(records, at + HALF_X)
    half_x = extent + ROW_MARGIN
    y, half_y = load_scalar(records, at + Y), load_scalar(records, at + HALF_Y)
    column = int(_max(x - half_x, ZERO)) >> TILE_SHIFT_X
    last_column = int(_min(x + half_x, np.float32(width - 1))) >> TILE_SHIFT_X
    if column == last_column:
        top, bottom = _pixel_rows(y, -half_y, half_y, height)
        return _write_column(column, top, bottom, tiles_x, i, slots_ahead, tile_list, place, tile_counts)
    major, k, minor = load_scalar(records, at + A), load_scalar(records, at + K), load_scalar(records, at + D)
    tip = k * half_y  # X of the ellipse's smallest y; its largest y lies at -tip
    inverse, one = ONE / (major * k * k + minor), opaque(1)
    square, lean = load_scalar(records, at + REACH) * inverse, -major * k * inverse
    bend = major * inverse * (minor * inverse)
    left = np.float32(column << TILE_SHIFT_X) - x
    low0, high0 = _crossing(extent, square, bend, lean, left)
    while column <= last_column:
        right = left + np.float32(TILE_WIDTH)
        low1, high1 = _crossing(extent, square, bend, lean, right)
        low = -half_y if left <= tip <= right else _max(_min(low0, low1), -half_y)
        high = half_y if left <= -tip <= right else _min(_max(high0, high1), half_y)
        top, bottom = _pixel_rows(y, low, high, height)
        place = _write_column(column, top, bottom, tiles_x, i, slots_ahead, tile_list, place, tile_counts)
        left, low0, high0 = right, low1, high1
        column += one
    return place


@inlined
def exclusive_sum(bounds, start, end, firsts):
    """Write the exclusive prefix sums of bounds[start:end] to firsts[start:end]; return the sum of all."""
    total = 0
    for i in range(start, end):
        firsts[i] = total
        total += bounds[i]
    return total


@kernel
def plan_parts(keys, bounds, chunk_bounds, step, work, starts, cuts):
    """Write the inputs of `list_sorted`: exclusive sums of chunk_bounds, and the cuts between parts of equal work.

    starts (chunks,): the sums; the total, the number of slots, is returned. cuts (parts + 1,): keys; the work between
    them is estimated from every step-th Gaussian. work (HISTOGRAM_BINS,): workspace."""
    capacity = exclusive_sum(chunk_bounds, 0, chunk_bounds.size, starts)
    parts = cuts.size - 1
    cuts[0], cuts[1:] = 0, CULLED_KEY
    low, high = np.int64(CULLED_KEY), np.int64(0)
    for i in range(0, keys.size, step):
        key = np.int64(keys[i])
        if key < CULLED_KEY:
            low, high = min(key, low), max(key, high)
    shift = 0  # a bin holds 2^shift keys
    while (high - low) >> shift >= HISTOGRAM_BINS:
        shift += 1
    work[:] = 0
    total = 0
    for i in range(0, keys.size, step):
        key = np.int64(keys[i])
        if key < CULLED_KEY:
            amount = bounds[i] + GAUSSIAN_COST
            work[(key - low) >> shift] += amount
            total += amount
    part, done = 1, 0
    for c in range(HISTOGRAM_BINS if total > 0 else 0):
        done += work[c]
        while part < parts and done * parts >= total * part:
            cuts[part] = min(low + ((c + 1) << shift), CULLED_KEY)
            part += 1
    return capacity


@inlined
def _collect_part(keys, bounds, low, high, cursors, pairs):
    """Collect the Gaussians with keys in low .. high - 1 in a range of pairs[0], key in the upper 32 bits, index below.

    The smallest key is subtracted. bounds: the most tiles that each Gaussian may have. cursors[0]: next free place of
    pairs. Returns the range's begin and length, the largest key that was written, and an upper bound on the length of
    their tile list."""
    count, capacity, smallest, largest = 0, 0, high, low
    for i in range(keys.size):
        key = np.int64(keys[i])
        if low <= key < high:
            count += 1
            capacity += bounds[i]
            smallest = min(key, smallest)
            largest = max(key, largest)
    begin = at = atomic_add(cursors, 0, count + 1)  # one more for a last pair that is written but not counted
    for i in range(keys.size):  # every pair is written, and overwritten if not counted: no unpredictable branch
        key = np.int64(keys[i])
        pairs[0, at] = (key - smallest) << 32 | i
        at += np.int64(low <= key) & np.int64(key < high)
    return begin, count, largest - smallest, capacity


@inlined
def _radix_sort(pairs, begin, count, largest, places):
    """Sort `count` pairs from `begin` on by key, from pairs[0] into pairs[1]: three passes of a stable radix sort, with
    the shortest digits that the largest key allows. places (DIGITS, 2^11): workspace."""
    length = 1
    while largest >> length > 0:
        length += 1
    digit = (length + DIGITS - 1) // DIGITS
    mask = (1 << digit) - 1
    # places: the count of each digit, then the first place of its pairs
    places[:, : mask + 1] = 0
    for j in range(begin, begin + count):
        key = pairs[0, j] >> 32
        for d in range(DIGITS):
            places[d, (key >> (d * digit)) & mask] += 1
    for d in range(DIGITS):
        total = begin
        for b in range(mask + 1):
            number = places[d, b]
            places[d, b] = total
            total += number
    _radix_pass(pairs[0], begin, count, 32, mask, places[0], pairs[1])
    _radix_pass(pairs[1], begin, count, 32 + digit, mask, places[1], pairs[0])
    _radix_pass(pairs[0], begin, count, 32 + 2 * digit, mask, places[2], pairs[1])


@inlined
def _radix_pass(pairs, begin, count, shift, mask, places, out):
    """Move pairs to `out` by the digit above `shift`; places: next free place of each digit."""
    for j in range(begin, begin + count):
        pair = pairs[j]
        b = (pair >> shift) & mask
        place = places[b]
        places[b] = place + 1
        out[place] = pair


@inlined
def _index_of(pair):
    return pair & 0xFFFFFFFF


@inlined
def _list_part(
    pairs, begin, count, records, tiles, rows, bounds, firsts, starts, width, height, tiles_x, tile_list, place,
    tile_counts,
):  # fmt: skip
    """List the tiles of sorted Gaussians; return the end of the list.

    place: where the list begins; the other arguments as in `list_sorted`. Replaces their bounds by the number of tiles,
    and firsts by their first slot."""
    end = begin + count
    for j in range(begin, end):
        far = _index_of(load_scalar(pairs, _min(j + PREFETCH_DISTANCE, end - 1)))  # accesses are scattered in memory
        prefetch(tiles, far)
        prefetch(rows, far)
        prefetch_to_write(firsts, far)
        prefetch_to_write(bounds, far)
        i = _index_of(load_scalar(pairs, j))
        slot, before, tile = starts[i // CHUNK] + load_scalar(firsts, i), place, np.int64(load_scalar(tiles, i))
        if tile >= 0:
            packed, ahead = np.int64(load_scalar(rows, i)), slot - place
            # The left column, then the right one, of which nothing is counted if it is not covered. `last` is the end
            # row, one past the last.
            first, last = packed & FIRST_MASK, (packed >> FIRST_BITS) & END_MASK
            place = _write_two(tile, first, last, tiles_x, i, ahead, tile_list, place, tile_counts)
            first, last = (packed >> COLUMN_BITS) & FIRST_MASK, packed >> (COLUMN_BITS + FIRST_BITS)
            tile += np.int64(last > 0)
            place = _write_two(tile, first, last, tiles_x, i, ahead, tile_list, place, tile_counts)
        else:
            place = _list_gaussian(records, i, width, height, tiles_x, slot - place, tile_list, place, tile_counts)
        firsts[i] = slot
        bounds[i] = place - before
    return place


@kernel
def list_sorted(
    counter, records, keys, tiles, rows, bounds, firsts, starts, cuts, width, height, tiles_x, cursors, places, pairs,
    tile_list, spans, tile_counts,
):  # fmt: skip
    """List the tiles of all Gaussians, part by part, each part sorted by key.

    tile_list: Gaussian, slot, and tile with first and last row packed, for every pair; each part fills its range in
    spans (parts, 2), lowest key first. tile_counts (parts, tiles): entries of each part in each tile.

    keys: uint32, CULLED_KEY for a Gaussian that is not drawn; tiles, rows: from `small_footprints`; cuts (parts + 1,):
    keys at which parts begin and end. bounds, firsts: see `exclusive_sum`, firsts within the chunk, whose own offset is
    in `starts`; replaced by counts and slots.
    cursors (2,): 0, 0; places (parts, DIGITS, 2^11), pairs (2, n + parts): workspace."""
    parts = tile_counts.shape[0]
    while True:
        part = atomic_increment(counter)
        if part >= parts:
            break
        tile_counts[part] = 0
        low, high = np.int64(cuts[part]), np.int64(cuts[part + 1])
        begin, count, largest, capacity = _collect_part(keys, bounds, low, high, cursors, pairs)
        _radix_sort(pairs, begin, count, largest, places[part])
        place = atomic_add(cursors, 1, capacity + 1)  # one more for an entry that is written but not counted
        spans[part, 0] = place
        spans[part, 1] = _list_part(
            pairs[1], begin, count, records, tiles, rows, bounds, firsts, starts, width, height, tiles_x, tile_list,
            place, tile_counts[part],
        )  # fmt: skip


@kernel
def scan_tile_counts(tile_counts, starts):
    """Replace counts (parts, tiles) by the offset of each part in each tile; starts (tiles + 1,): offsets of tiles."""
    parts, tiles = tile_counts.shape
    total = 0
    for tile in range(tiles):
        starts[tile] = total
        for part in range(parts):
            number = tile_counts[part, tile]
            tile_counts[part, tile] = total
            total += number
    starts[tiles] = total


@kernel
def scatter(counter, tile_list, spans, places, entries):
    """Write the entries of all tiles, lowest key first; places: offsets from `scan_tile_counts`, which it advances."""
    while True:
        part = atomic_increment(counter)
        if part >= spans.shape[0]:
            break
        part_offsets = places[part]
        for at in range(spans[part, 0] * LIST_ENTRY, spans[part, 1] * LIST_ENTRY, LIST_ENTRY):
            packed = np.int64(load_scalar(tile_list, at + 2))
            tile = packed >> (2 * ROW_BITS)
            to = part_offsets[tile] * ENTRY
            part_offsets[tile] += 1
            prefetch_to_write(entries, to + NEXT_LINE)
            entries[to + GAUSSIAN], entries[to + SLOT] = load_scalar(tile_list, at), load_scalar(tile_list, at + 1)
            entries[to + FIRST_ROW], entries[to + END_ROW] = (packed >> ROW_BITS) & ROW_MASK, (packed & ROW_MASK) + 1
