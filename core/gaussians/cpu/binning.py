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
a time. Each part sorts its own Gaussians and lists their tiles. `scan_tile_counts` and `scatter_entries` then
distribute the lists to the tiles, part after part, so that no tile needs sorting. The result does not depend on the
cuts.

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
LIST_ENTRY, LIST_SLOT, LIST_TILE = 3, 1, 2
"""int32 numbers of an entry of a tile list: Gaussian, slot, and tile with first and last row packed; offsets of the
latter two."""
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
def _ellipse_rows(half_x, root_squared, root_falloff, shear, x):
    """Return the smallest and largest y, from the centre, of the ellipse at the horizontal offset x, which is clamped
    to ± half_x.

    y = shear x ± sqrt(root_squared - root_falloff x²) with root_squared = t / C, root_falloff = A D / C² and
    shear = -A k / C; the module head explains t, A, C, D, k."""
    x = _min(_max(x, -half_x), half_x)
    root, centre_y = math.sqrt(_max(root_squared - root_falloff * x * x, ZERO)), shear * x
    return centre_y - root, centre_y + root


@inlined
def small_footprints(x, y, half_x, half_y, major, k, minor, reach, is_visible, width, height):
    """Return the tiles that 16 Gaussians cover, as two integer vectors: first tile, and packed pixel rows.

    Only for visible Gaussians with at most two columns and two rows of tiles; all others get tile -1 and rows 0.
    Packed rows: the left column's in the lowest COLUMN_BITS, the right column's above. A column's first pixel row has
    FIRST_BITS, its end row END_BITS, both counted from the first tile's top row; all 0 if it is not covered.

    x, y, half_x, half_y: centre and half size, px; major, k, minor, reach: A, k, D and t of the module head;
    is_visible: false for Gaussians that are not drawn; width, height: size of the picture, px."""
    padded_half_x = half_x + ROW_MARGIN
    tile_column = to_ints(maximum(x - padded_half_x, ZERO)) >> TILE_SHIFT_X
    extra_columns = (to_ints(minimum(x + padded_half_x, splat(np.float32(width - 1)))) >> TILE_SHIFT_X) - tile_column
    top_row, bottom_row = _pixel_row_vectors(y, -half_y, half_y, height)
    tile_row = top_row >> TILE_SHIFT_Y
    extra_rows = (bottom_row >> TILE_SHIFT_Y) - tile_row
    # tip: X of the ellipse's smallest y; its largest y lies at -tip
    tip, inverse = k * half_y, ONE / fma(major * k, k, minor)
    root_squared, root_falloff, shear = reach * inverse, major * inverse * (minor * inverse), -major * k * inverse
    left_edge = to_floats(tile_column << TILE_SHIFT_X) - x
    middle_edge = left_edge + np.float32(TILE_WIDTH)
    right_edge = middle_edge + np.float32(TILE_WIDTH)
    low0, high0 = _ellipse_row_vectors(half_x, root_squared, root_falloff, shear, left_edge)
    low1, high1 = _ellipse_row_vectors(half_x, root_squared, root_falloff, shear, middle_edge)
    low2, high2 = _ellipse_row_vectors(half_x, root_squared, root_falloff, shear, right_edge)
    is_one_column = extra_columns < 1
    low = where(is_one_column | ((left_edge <= tip) & (tip <= middle_edge)), -half_y, minimum(low0, low1))
    high = where(is_one_column | ((left_edge <= -tip) & (-tip <= middle_edge)), half_y, maximum(high0, high1))
    left_rows = _pack_rows(y, half_y, low, high, height, tile_row << TILE_SHIFT_Y)
    low = where((middle_edge <= tip) & (tip <= right_edge), -half_y, minimum(low1, low2))
    high = where((middle_edge <= -tip) & (-tip <= right_edge), half_y, maximum(high1, high2))
    right_rows = where(is_one_column, 0, _pack_rows(y, half_y, low, high, height, tile_row << TILE_SHIFT_Y))
    is_small = is_visible & (extra_columns < 2) & (extra_rows < 2)
    tiles_x = (width + TILE_WIDTH - 1) >> TILE_SHIFT_X
    tile = where(is_small, tile_row * tiles_x + tile_column, -1)
    return tile, where(is_small, left_rows | (right_rows << COLUMN_BITS), 0)


@inlined
def _pixel_row_vectors(y, low, high, height):
    """Return the result of `_pixel_rows` for vectors of 16 Gaussians."""
    top = maximum(y + low - (HALF + ROW_MARGIN), ZERO)
    bottom = minimum(y + high - (HALF - ROW_MARGIN), splat(np.float32(height - 1)))
    first = to_ints(top)
    return where(to_floats(first) < top, first + 1, first), where(bottom >= ZERO, to_ints(bottom), -1)


@inlined
def _ellipse_row_vectors(half_x, root_squared, root_falloff, shear, x):
    """Return the result of `_ellipse_rows` for vectors of 16 Gaussians."""
    x = minimum(maximum(x, -half_x), half_x)
    root, centre_y = sqrt(maximum(fma(-root_falloff * x, x, root_squared), ZERO)), shear * x
    return centre_y - root, centre_y + root


@inlined
def _pack_rows(y, half_y, low, high, height, origin_row):
    """Pack the first and end pixel row of y + low .. y + high, clamped to the ellipse's own rows; 0 if there are none.

    origin_row: the pixel row that is counted as 0."""
    first, last = _pixel_row_vectors(y, maximum(low, -half_y), minimum(high, half_y), height)
    return where(first <= last, (first - origin_row) | ((last + 1 - origin_row) << FIRST_BITS), 0)


@inlined
def _list_two_tiles(tile, first_row, end_row, tiles_x, i, slot_offset, tile_list, place, tile_counts):
    """Append a tile and the tile below it to tile_list, each if Gaussian i covers it.

    first_row, end_row: the pixel rows that the Gaussian covers, first and after the last, from the upper tile's top;
    tiles_x: tiles in a row of the picture; slot_offset: slot of an entry minus its place; place: next free place of
    tile_list, of which the new value is returned; tile_counts: entries by tile, which are increased. Both entries are
    always written, without a branch; one that is not counted is overwritten by the next."""
    has_upper = np.int64(first_row < end_row) & np.int64(first_row < TILE_HEIGHT)
    has_lower = np.int64(end_row > TILE_HEIGHT)
    tile_list[place * LIST_ENTRY], tile_list[place * LIST_ENTRY + LIST_SLOT] = i, place + slot_offset
    tile_rows = ((tile << ROW_BITS | first_row) << ROW_BITS) | (_min(end_row, TILE_HEIGHT) - 1)
    tile_list[place * LIST_ENTRY + LIST_TILE] = tile_rows
    tile_counts[tile] += has_upper
    place += has_upper
    tile += tiles_x * has_lower  # without a lower tile it stays, so that the index below is inside tile_counts
    tile_list[place * LIST_ENTRY], tile_list[place * LIST_ENTRY + LIST_SLOT] = i, place + slot_offset
    first_row = _max(first_row - TILE_HEIGHT, 0)
    tile_rows = ((tile << ROW_BITS | first_row) << ROW_BITS) | (end_row - TILE_HEIGHT - 1)
    tile_list[place * LIST_ENTRY + LIST_TILE] = tile_rows
    tile_counts[tile] += has_lower
    return place + has_lower


@inlined
def _list_column(column, top_row, bottom_row, tiles_x, i, slot_offset, tile_list, place, tile_counts):
    """Append the tiles of a tile column that contain pixel rows top_row .. bottom_row to tile_list, for Gaussian i.

    tiles_x: tiles in a row of the picture; slot_offset: slot of an entry minus its place; place: next free place of
    tile_list, of which the new value is returned; tile_counts: entries by tile, which are increased."""
    tile_row, opaque_one = top_row >> TILE_SHIFT_Y, opaque(1)  # opaque: the loop is not unrolled
    while tile_row << TILE_SHIFT_Y <= bottom_row:
        tile_top = tile_row << TILE_SHIFT_Y
        first_row = top_row - tile_top if top_row > tile_top else 0
        last_row = bottom_row - tile_top if bottom_row - tile_top < ROW_MASK else ROW_MASK
        tile = tile_row * tiles_x + column
        tile_list[place * LIST_ENTRY], tile_list[place * LIST_ENTRY + LIST_SLOT] = i, place + slot_offset
        tile_rows = ((tile << ROW_BITS | first_row) << ROW_BITS) | last_row
        tile_list[place * LIST_ENTRY + LIST_TILE] = tile_rows
        tile_counts[tile] += 1
        place += opaque_one
        tile_row += opaque_one
    return place


@inlined
def _list_tiles(records, i, width, height, tiles_x, slot_offset, tile_list, place, tile_counts):
    """Append the tiles of Gaussian i, of any size, to tile_list from `place` on; return the next free place.

    In each column these are the tiles between the ellipse's smallest and largest y there (equations: module head).
    records: RECORD numbers for each Gaussian (`layout`). width, height: of the picture, px. tiles_x: tiles in a row of
    it. slot_offset: slot of an entry minus its place. tile_counts: entries by tile, which are increased."""
    record = i * RECORD
    x, half_x = load_scalar(records, record + X), load_scalar(records, record + HALF_X)
    padded_half_x = half_x + ROW_MARGIN
    y, half_y = load_scalar(records, record + Y), load_scalar(records, record + HALF_Y)
    column = int(_max(x - padded_half_x, ZERO)) >> TILE_SHIFT_X
    last_column = int(_min(x + padded_half_x, np.float32(width - 1))) >> TILE_SHIFT_X
    if column == last_column:
        top_row, bottom_row = _pixel_rows(y, -half_y, half_y, height)
        return _list_column(column, top_row, bottom_row, tiles_x, i, slot_offset, tile_list, place, tile_counts)
    major, k = load_scalar(records, record + A), load_scalar(records, record + K)
    minor = load_scalar(records, record + D)
    tip = k * half_y  # X of the ellipse's smallest y; its largest y lies at -tip
    inverse, opaque_one = ONE / (major * k * k + minor), opaque(1)  # opaque: the loop is not unrolled
    root_squared, shear = load_scalar(records, record + REACH) * inverse, -major * k * inverse
    root_falloff = major * inverse * (minor * inverse)
    left = np.float32(column << TILE_SHIFT_X) - x
    left_low, left_high = _ellipse_rows(half_x, root_squared, root_falloff, shear, left)
    while column <= last_column:
        right = left + np.float32(TILE_WIDTH)
        right_low, right_high = _ellipse_rows(half_x, root_squared, root_falloff, shear, right)
        low = -half_y if left <= tip <= right else _max(_min(left_low, right_low), -half_y)
        high = half_y if left <= -tip <= right else _min(_max(left_high, right_high), half_y)
        top_row, bottom_row = _pixel_rows(y, low, high, height)
        place = _list_column(column, top_row, bottom_row, tiles_x, i, slot_offset, tile_list, place, tile_counts)
        left, left_low, left_high = right, right_low, right_high
        column += opaque_one
    return place


@inlined
def exclusive_sum(values, start, end, sums):
    """Write the exclusive prefix sums of values[start:end] to sums[start:end]; return the sum of values[start:end]."""
    total = 0
    for i in range(start, end):
        sums[i] = total
        total += values[i]
    return total


@kernel
def plan_parts(keys, max_tiles, chunk_max_tiles, stride, histogram, chunk_starts, cuts):
    """Write the inputs of `list_sorted`: each chunk's first slot, and the cuts between parts of equal work; return
    the number of slots.

    keys, max_tiles (n,): key of each Gaussian, and upper bound on its number of tiles
    chunk_max_tiles (chunks,): sums of max_tiles by chunk
    chunk_starts (chunks,): result: first slot of each chunk, the exclusive prefix sums of chunk_max_tiles
    cuts (parts + 1,): result: keys at which parts begin and end; every stride-th Gaussian serves to estimate the work
    histogram (HISTOGRAM_BINS,): workspace"""
    num_slots = exclusive_sum(chunk_max_tiles, 0, chunk_max_tiles.size, chunk_starts)
    parts = cuts.size - 1
    cuts[0], cuts[1:] = 0, CULLED_KEY
    low, high = np.int64(CULLED_KEY), np.int64(0)
    for i in range(0, keys.size, stride):
        key = np.int64(keys[i])
        if key < CULLED_KEY:
            low, high = min(key, low), max(key, high)
    shift = 0  # a bin holds 2^shift keys
    while (high - low) >> shift >= HISTOGRAM_BINS:
        shift += 1
    histogram[:] = 0
    total = 0
    for i in range(0, keys.size, stride):
        key = np.int64(keys[i])
        if key < CULLED_KEY:
            cost = max_tiles[i] + GAUSSIAN_COST
            histogram[(key - low) >> shift] += cost
            total += cost
    part, work_before = 1, 0
    for bin_index in range(HISTOGRAM_BINS if total > 0 else 0):
        work_before += histogram[bin_index]
        while part < parts and work_before * parts >= total * part:
            cuts[part] = min(low + ((bin_index + 1) << shift), CULLED_KEY)
            part += 1
    return num_slots


@inlined
def _collect_part(keys, max_tiles, low, high, cursors, pairs):
    """Write the Gaussians with keys in low .. high - 1 to a range of pairs[0]: the key, less the smallest one, in the
    upper 32 bits of a pair, the Gaussian's index in the lower.

    max_tiles: upper bound on the number of tiles of each Gaussian; cursors[0]: next free place of pairs, shared by the
    threads. Return the range's begin and length, the largest key less the smallest, and an upper bound on the number of
    the Gaussians' tiles."""
    count, max_entries, smallest, largest = 0, 0, high, low
    for i in range(keys.size):
        key = np.int64(keys[i])
        if low <= key < high:
            count += 1
            max_entries += max_tiles[i]
            smallest = min(key, smallest)
            largest = max(key, largest)
    begin = place = atomic_add(cursors, 0, count + 1)  # one more for a last pair that is written but not counted
    for i in range(keys.size):  # every pair is written, and overwritten if not counted: no unpredictable branch
        key = np.int64(keys[i])
        pairs[0, place] = (key - smallest) << 32 | i
        place += np.int64(low <= key) & np.int64(key < high)
    return begin, count, largest - smallest, max_entries


@inlined
def _radix_sort(pairs, begin, count, largest_key, places):
    """Sort `count` pairs from `begin` on by key, from pairs[0] into pairs[1]: three passes of a stable radix sort, with
    the shortest digits that the largest key allows. places (DIGITS, 2^11): workspace."""
    key_bits = 1
    while largest_key >> key_bits > 0:
        key_bits += 1
    digit_bits = (key_bits + DIGITS - 1) // DIGITS
    mask = (1 << digit_bits) - 1
    # places: the count of each digit, then the first place of its pairs
    places[:, : mask + 1] = 0
    for pair_index in range(begin, begin + count):
        key = pairs[0, pair_index] >> 32
        for pass_index in range(DIGITS):
            places[pass_index, (key >> (pass_index * digit_bits)) & mask] += 1
    for pass_index in range(DIGITS):
        total = begin
        for digit in range(mask + 1):
            count_of_digit = places[pass_index, digit]
            places[pass_index, digit] = total
            total += count_of_digit
    _radix_pass(pairs[0], begin, count, 32, mask, places[0], pairs[1])
    _radix_pass(pairs[1], begin, count, 32 + digit_bits, mask, places[1], pairs[0])
    _radix_pass(pairs[0], begin, count, 32 + 2 * digit_bits, mask, places[2], pairs[1])


@inlined
def _radix_pass(pairs, begin, count, shift, mask, places, out):
    """Move `count` pairs from `begin` on to `out`, sorted by the digit (pair >> shift) & mask, equal ones in order.

    places: next free place of each digit in `out`, which is advanced."""
    for pair_index in range(begin, begin + count):
        pair = pairs[pair_index]
        digit = (pair >> shift) & mask
        place = places[digit]
        places[digit] = place + 1
        out[place] = pair


@inlined
def _index_of(pair):
    return pair & 0xFFFFFFFF


@inlined
def _list_part(
    pairs, begin, count, records, small_tiles, small_rows, max_tiles, first_slots, chunk_starts, width, height,
    tiles_x, tile_list, place, tile_counts,
):  # fmt: skip
    """List the tiles of `count` sorted Gaussians, whose pairs start at `begin`; return the end of the list.

    place: where the list begins; tile_counts (tiles,): this part's entries in each tile; `list_sorted` explains the
    others. In max_tiles each Gaussian's bound is replaced by its number of tiles, in first_slots its slot within the
    chunk by that among all."""
    end = begin + count
    for pair_index in range(begin, end):
        # Accesses are scattered in memory.
        upcoming = _index_of(load_scalar(pairs, _min(pair_index + PREFETCH_DISTANCE, end - 1)))
        prefetch(small_tiles, upcoming)
        prefetch(small_rows, upcoming)
        prefetch_to_write(first_slots, upcoming)
        prefetch_to_write(max_tiles, upcoming)
        i = _index_of(load_scalar(pairs, pair_index))
        slot, first_place = chunk_starts[i // CHUNK] + load_scalar(first_slots, i), place
        tile = np.int64(load_scalar(small_tiles, i))
        if tile >= 0:
            packed, slot_offset = np.int64(load_scalar(small_rows, i)), slot - place
            # The left column, then the right one, of which nothing is counted if it is not covered.
            first_row, end_row = packed & FIRST_MASK, (packed >> FIRST_BITS) & END_MASK
            place = _list_two_tiles(tile, first_row, end_row, tiles_x, i, slot_offset, tile_list, place, tile_counts)
            first_row, end_row = (packed >> COLUMN_BITS) & FIRST_MASK, packed >> (COLUMN_BITS + FIRST_BITS)
            tile += np.int64(end_row > 0)
            place = _list_two_tiles(tile, first_row, end_row, tiles_x, i, slot_offset, tile_list, place, tile_counts)
        else:
            place = _list_tiles(records, i, width, height, tiles_x, slot - place, tile_list, place, tile_counts)
        first_slots[i] = slot
        max_tiles[i] = place - first_place
    return place


@kernel
def list_sorted(
    counter, records, keys, small_tiles, small_rows, max_tiles, first_slots, chunk_starts, cuts, width, height,
    tiles_x, cursors, places, pairs, tile_list, spans, tile_counts,
):  # fmt: skip
    """List the tiles of all Gaussians, part by part, each part sorted by key.

    counter                  index of the next part, shared by the threads
    records                  of the Gaussians, 16 numbers each (`layout`)
    keys                     uint32; CULLED_KEY for a Gaussian that is not drawn
    small_tiles, small_rows  from `small_footprints`
    max_tiles                upper bounds on the Gaussians' numbers of tiles; replaced by the numbers
    first_slots              each Gaussian's first slot within its chunk; replaced by that among all
    chunk_starts             first slot of each chunk
    cuts                     (parts + 1,) keys at which parts begin and end
    width, height, tiles_x   size of the picture, px, and tiles in a row of them
    cursors                  0, 0: next free places of pairs and tile_list, shared by the threads
    places, pairs            (parts, DIGITS, 2^11), (2, n + parts): workspaces
    tile_list                result: Gaussian, slot, and tile with first and last row packed, for each pair of these two
    spans                    result: (parts, 2) range of each part in tile_list, lowest key first
    tile_counts              result: (parts, tiles) entries of each part in each tile"""
    parts = tile_counts.shape[0]
    while True:
        part = atomic_increment(counter)
        if part >= parts:
            break
        tile_counts[part] = 0
        low, high = np.int64(cuts[part]), np.int64(cuts[part + 1])
        begin, count, largest_key, max_entries = _collect_part(keys, max_tiles, low, high, cursors, pairs)
        _radix_sort(pairs, begin, count, largest_key, places[part])
        place = atomic_add(cursors, 1, max_entries + 1)  # one more for an entry that is written but not counted
        spans[part, 0] = place
        spans[part, 1] = _list_part(
            pairs[1], begin, count, records, small_tiles, small_rows, max_tiles, first_slots, chunk_starts, width,
            height, tiles_x, tile_list, place, tile_counts[part],
        )  # fmt: skip


@kernel
def scan_tile_counts(tile_counts, starts):
    """Replace tile_counts (parts, tiles) by the index at which each part's entries of each tile begin, if entries are
    ordered by tile, then by part; write the first index of each tile to starts (tiles + 1,)."""
    parts, tiles = tile_counts.shape
    offset = 0
    for tile in range(tiles):
        starts[tile] = offset
        for part in range(parts):
            count = tile_counts[part, tile]
            tile_counts[part, tile] = offset
            offset += count
    starts[tiles] = offset


@kernel
def scatter_entries(counter, tile_list, spans, places, entries):
    """Write the entries of all tiles, lowest key first, from the lists of the parts.

    counter: index of the next part, shared by the threads; spans (parts, 2): range of each part in tile_list; places
    (parts, tiles): the indices from `scan_tile_counts`, which are advanced."""
    while True:
        part = atomic_increment(counter)
        if part >= spans.shape[0]:
            break
        part_offsets = places[part]
        for source in range(spans[part, 0] * LIST_ENTRY, spans[part, 1] * LIST_ENTRY, LIST_ENTRY):
            packed = np.int64(load_scalar(tile_list, source + LIST_TILE))
            tile = packed >> (2 * ROW_BITS)
            target = part_offsets[tile] * ENTRY
            part_offsets[tile] += 1
            prefetch_to_write(entries, target + NEXT_LINE)
            entries[target + GAUSSIAN] = load_scalar(tile_list, source)
            entries[target + SLOT] = load_scalar(tile_list, source + LIST_SLOT)
            entries[target + FIRST_ROW] = (packed >> ROW_BITS) & ROW_MASK
            entries[target + END_ROW] = (packed & ROW_MASK) + 1
