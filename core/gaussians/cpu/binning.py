# SPDX-License-Identifier: GPL-3.0-or-later
"""Which Gaussians meet which tile, nearest first.

The extent of a Gaussian is that of the ellipse where alpha is
1/255, which opacity makes smaller (SnugBox of Hanson et al. 2025, Speedy-Splat). In a column of tiles it meets
just the pixel rows between the ellipse's lowest and highest point there (as their AccuTile): with X the
offset of the column's edge from the centre, and the record's A, k, D, C and reach t (all but k negative),

    A (X + k y)² + D y² = t   at   y = (-A k X ± sqrt(C t - A D X²)) / C

and the extreme points of the whole ellipse, y = ± half_y, lie at X = ∓ k half_y. Of an ellipse far larger than the
picture the root loses all its digits, so y is kept within ± half_y: nothing is listed beyond the rows that were
counted for it.

Gaussians have a key, by which they are drawn, lowest first: the bits of the depth, which sort as it does, or their
number. `list_in_order` cuts the range of keys into parts of about equal work, one to a thread at a time. A part
sorts its own Gaussians and lists the tiles of each; `deal` and `scatter` then send the lists to the tiles, part
after part, so that no tile needs sorting. What comes out does not depend on where the cuts are.

Most Gaussians are small: two columns and two rows of tiles at most. What those meet is worked out when they are
projected, for 16 at a time (`few_tiles`), and listed without a branch to guess.

Each pair of Gaussian and tile has a slot, the place of the gradient that the tile sends back to the Gaussian. Those
of a Gaussian follow each other, in the Gaussians' own order, which is the order in which they will be read.
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
    fma,
    get,
    maximum,
    minimum,
    opaque,
    prefetch,
    prefetch_to_write,
    splat,
    sqrt,
    take,
    take_number,
    to_floats,
    to_ints,
    where,
)

ROW_BITS, ROW_MASK = TILE_SHIFT_Y, TILE_HEIGHT - 1
FIRST_BITS, END_BITS = TILE_SHIFT_Y + 1, TILE_SHIFT_Y + 2
COLUMN_BITS = FIRST_BITS + END_BITS
FIRST_MASK, END_MASK = (1 << FIRST_BITS) - 1, (1 << END_BITS) - 1
DIGITS = 3
AHEAD = 8
CLASSES = 1 << 10
"""Of keys, between which parts may be cut."""
PER_GAUSSIAN = 2
"""What it takes to sort and look at a Gaussian, in tiles to list."""
LISTED = 3
NEXT_LINE = 32
"""Numbers beyond an entry that lie on a cache line which its tile will ask for later."""
NOWHERE = 0x7F800000
"""The key of what is not drawn: the bits of infinity, above those of every depth."""
SLACK = np.float32(0.02)
"""Pixels by which the row range is widened against rounding."""


@inlined
def _least(a, b):
    return a if a < b else b  # one instruction; numba's own also ask for NaN


@inlined
def _most(a, b):
    return a if a > b else b


@inlined
def _pixel_rows(y, low, high, height):
    """First and last pixel row whose centre lies within y + low .. y + high; first > last if none does."""
    top = _most(y + low - (HALF + SLACK), ZERO)
    bottom = _least(y + high - (HALF - SLACK), np.float32(height - 1))
    first = int(top)
    if np.float32(first) < top:
        first += 1
    return first, int(bottom) if bottom >= ZERO else -1


@inlined
def _crossing(half_x, square, bend, lean, x):
    """Lowest and highest point of the ellipse at the horizontal offset x, or where it is nearest to that: with
    square = t / C, bend = A D / C², lean = -A k / C."""
    x = _least(_most(x, -half_x), half_x)
    root, middle = math.sqrt(_most(square - bend * x * x, ZERO)), lean * x
    return middle - root, middle + root


@inlined
def few_tiles(x, y, half_x, half_y, major, k, minor, reach, visible, width, height):
    """What 16 Gaussians meet, by the fields of their records. Of those with two columns and rows of tiles at most the
    first tile, -1 for the others; and by column, the left one's COLUMN_BITS lowest, first and end pixel row, counted
    from the first tile's: FIRST_BITS and END_BITS, 0 if none."""
    wide = half_x + SLACK
    column = to_ints(maximum(x - wide, ZERO)) >> TILE_SHIFT_X
    columns = (to_ints(minimum(x + wide, splat(np.float32(width - 1)))) >> TILE_SHIFT_X) - column
    above, below = _rows_between(y, -half_y, half_y, height)
    row = above >> TILE_SHIFT_Y
    rows = (below >> TILE_SHIFT_Y) - row
    tip, inverse = k * half_y, ONE / fma(major * k, k, minor)
    square, bend, lean = reach * inverse, major * inverse * (minor * inverse), -major * k * inverse
    left = to_floats(column << TILE_SHIFT_X) - x
    middle = left + np.float32(TILE_WIDTH)
    right = middle + np.float32(TILE_WIDTH)
    low0, high0 = _crossings(half_x, square, bend, lean, left)
    low1, high1 = _crossings(half_x, square, bend, lean, middle)
    low2, high2 = _crossings(half_x, square, bend, lean, right)
    one = columns < 1
    low = where(one | ((left <= tip) & (tip <= middle)), -half_y, minimum(low0, low1))
    high = where(one | ((left <= -tip) & (-tip <= middle)), half_y, maximum(high0, high1))
    of_left = _packed_rows(y, half_y, low, high, height, row << TILE_SHIFT_Y)
    low = where((middle <= tip) & (tip <= right), -half_y, minimum(low1, low2))
    high = where((middle <= -tip) & (-tip <= right), half_y, maximum(high1, high2))
    of_right = where(one, 0, _packed_rows(y, half_y, low, high, height, row << TILE_SHIFT_Y))
    few = visible & (columns < 2) & (rows < 2)
    tiles_x = (width + TILE_WIDTH - 1) >> TILE_SHIFT_X
    return where(few, row * tiles_x + column, -1), where(few, of_left | (of_right << COLUMN_BITS), 0)


@inlined
def _rows_between(y, low, high, height):
    """As `_pixel_rows`."""
    top = maximum(y + low - (HALF + SLACK), ZERO)
    bottom = minimum(y + high - (HALF - SLACK), splat(np.float32(height - 1)))
    first = to_ints(top)
    return where(to_floats(first) < top, first + 1, first), where(bottom >= ZERO, to_ints(bottom), -1)


@inlined
def _crossings(half_x, square, bend, lean, x):
    """As `_crossing`."""
    x = minimum(maximum(x, -half_x), half_x)
    root, middle = sqrt(maximum(fma(-bend * x, x, square), ZERO)), lean * x
    return middle - root, middle + root


@inlined
def _packed_rows(y, half_y, low, high, height, base):
    """First and end of the pixel rows that y + low .. y + high meets, within the ellipse's own; 0 if none."""
    first, last = _rows_between(y, maximum(low, -half_y), minimum(high, half_y), height)
    return where(first <= last, (first - base) | ((last + 1 - base) << FIRST_BITS), 0)


@inlined
def _write_two(tile, first, end, tiles_x, i, slots_ahead, listed, at, numbers):
    """Lists a tile and the one below, of which pixel rows first .. end - 1 are met, counted from the upper's first.
    Both are written, and over what is not to stay the next will be."""
    upper = np.int64(first < end) & np.int64(first < TILE_HEIGHT)
    lower = np.int64(end > TILE_HEIGHT)
    listed[at * LISTED], listed[at * LISTED + 1] = i, at + slots_ahead
    listed[at * LISTED + 2] = ((tile << ROW_BITS | first) << ROW_BITS) | (_least(end, TILE_HEIGHT) - 1)
    numbers[tile] += upper
    at += upper
    tile += tiles_x * lower
    listed[at * LISTED], listed[at * LISTED + 1] = i, at + slots_ahead
    listed[at * LISTED + 2] = ((tile << ROW_BITS | _most(first - TILE_HEIGHT, 0)) << ROW_BITS) | (end - TILE_HEIGHT - 1)
    numbers[tile] += lower
    return at + lower


@inlined
def _write_column(column, top, bottom, tiles_x, i, slots_ahead, listed, at, numbers):
    """Lists the tiles of a column that pixel rows top .. bottom meet; returns the next place."""
    row, one = top >> TILE_SHIFT_Y, opaque(1)
    while row << TILE_SHIFT_Y <= bottom:
        base = row << TILE_SHIFT_Y
        first = top - base if top > base else 0
        last = bottom - base if bottom - base < ROW_MASK else ROW_MASK
        tile = row * tiles_x + column
        listed[at * LISTED], listed[at * LISTED + 1] = i, at + slots_ahead
        listed[at * LISTED + 2] = ((tile << ROW_BITS | first) << ROW_BITS) | last
        numbers[tile] += 1
        at += one
        row += one
    return at


@inlined
def _list_gaussian(records, i, width, height, tiles_x, slots_ahead, listed, place, numbers):
    """Lists the tiles of any Gaussian i from this place on; returns the place after the last."""
    at = i * RECORD
    x, extent = get(records, at + X), get(records, at + HALF_X)
    half_x = extent + SLACK
    y, half_y = get(records, at + Y), get(records, at + HALF_Y)
    column = int(_most(x - half_x, ZERO)) >> TILE_SHIFT_X
    last_column = int(_least(x + half_x, np.float32(width - 1))) >> TILE_SHIFT_X
    if column == last_column:
        top, bottom = _pixel_rows(y, -half_y, half_y, height)
        return _write_column(column, top, bottom, tiles_x, i, slots_ahead, listed, place, numbers)
    major, k, minor = get(records, at + A), get(records, at + K), get(records, at + D)
    tip = k * half_y  # the highest point lies at -tip, the lowest at tip
    inverse, one = ONE / (major * k * k + minor), opaque(1)
    square, bend, lean = get(records, at + REACH) * inverse, major * inverse * (minor * inverse), -major * k * inverse
    left = np.float32(column << TILE_SHIFT_X) - x
    low0, high0 = _crossing(extent, square, bend, lean, left)
    while column <= last_column:
        right = left + np.float32(TILE_WIDTH)
        low1, high1 = _crossing(extent, square, bend, lean, right)
        low = -half_y if left <= tip <= right else _most(_least(low0, low1), -half_y)
        high = half_y if left <= -tip <= right else _least(_most(high0, high1), half_y)
        top, bottom = _pixel_rows(y, low, high, height)
        place = _write_column(column, top, bottom, tiles_x, i, slots_ahead, listed, place, numbers)
        left, low0, high0 = right, low1, high1
        column += one
    return place


@inlined
def number_slots(bounds, start, end, firsts):
    """firsts: sums of the bounds before each, from `start` on; returns the sum of all."""
    total = 0
    for i in range(start, end):
        firsts[i] = total
        total += bounds[i]
    return total


@kernel
def plan(keys, bounds, chunk_bounds, step, work, starts, cuts):
    """What `list_in_order` needs first: starts (chunks,), sums of chunk_bounds before each, of which the sum of all is
    returned; and cuts (parts + 1,), between which there is about the same to do, judged by every step-th Gaussian.
    work (CLASSES,): workspace."""
    room = number_slots(chunk_bounds, 0, chunk_bounds.size, starts)
    parts = cuts.size - 1
    cuts[0], cuts[1:] = 0, NOWHERE
    low, high = np.int64(NOWHERE), np.int64(0)
    for i in range(0, keys.size, step):
        key = np.int64(keys[i])
        if key < NOWHERE:
            low, high = min(key, low), max(key, high)
    shift = 0
    while (high - low) >> shift >= CLASSES:
        shift += 1
    work[:] = 0
    total = 0
    for i in range(0, keys.size, step):
        key = np.int64(keys[i])
        if key < NOWHERE:
            amount = bounds[i] + PER_GAUSSIAN
            work[(key - low) >> shift] += amount
            total += amount
    part, done = 1, 0
    for c in range(CLASSES if total > 0 else 0):
        done += work[c]
        while part < parts and done * parts >= total * part:
            cuts[part] = min(low + ((c + 1) << shift), NOWHERE)
            part += 1
    return room


@inlined
def _choose(keys, bounds, low, high, taken, pairs):
    """Takes those whose key lies within low .. high - 1 into a stretch of pairs[0] of their own, key above number.
    Returns its beginning and length, the range of the keys, and how much room their lists may need."""
    count, room, smallest, largest = 0, 0, high, low
    for i in range(keys.size):
        key = np.int64(keys[i])
        if low <= key < high:
            count += 1
            room += bounds[i]
            smallest = min(key, smallest)
            largest = max(key, largest)
    begin = at = take(taken, 0, count + 1)
    for i in range(keys.size):  # every one is written, over the last if that is not to stay: no branch to guess
        key = np.int64(keys[i])
        pairs[0, at] = (key - smallest) << 32 | i
        at += np.int64(low <= key) & np.int64(key < high)
    return begin, count, largest - smallest, room


@inlined
def _sort(pairs, begin, count, largest, places):
    """From pairs[0] to pairs[1], by key: three passes of a stable radix sort, by digits as short as the range of
    keys allows. places (DIGITS, 2^11): workspace."""
    length = 1
    while largest >> length > 0:
        length += 1
    digit = (length + DIGITS - 1) // DIGITS
    mask = (1 << digit) - 1
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
    _distribute(pairs[0], begin, count, 32, mask, places[0], pairs[1])
    _distribute(pairs[1], begin, count, 32 + digit, mask, places[1], pairs[0])
    _distribute(pairs[0], begin, count, 32 + 2 * digit, mask, places[2], pairs[1])


@inlined
def _distribute(pairs, begin, count, shift, mask, places, out):
    """One pass: by the digit above `shift`, to where `places` says."""
    for j in range(begin, begin + count):
        pair = pairs[j]
        b = (pair >> shift) & mask
        place = places[b]
        places[b] = place + 1
        out[place] = pair


@inlined
def _number_of(pair):
    return pair & 0xFFFFFFFF


@inlined
def _list_part(
    pairs, begin, count, records, tiles, rows, bounds, firsts, starts, width, height, tiles_x, listed, place, numbers
):  # fmt: skip
    """Lists the tiles of sorted Gaussians; returns the end of the list. Turns their bounds into counts, and firsts
    into the number of their first slot."""
    end = begin + count
    for j in range(begin, end):
        far = _number_of(get(pairs, _least(j + AHEAD, end - 1)))  # the walk jumps about in memory
        prefetch(tiles, far)
        prefetch(rows, far)
        prefetch_to_write(firsts, far)
        prefetch_to_write(bounds, far)
        i = _number_of(get(pairs, j))
        slot, before, tile = starts[i // CHUNK] + get(firsts, i), place, np.int64(get(tiles, i))
        if tile >= 0:
            packed, ahead = np.int64(get(rows, i)), slot - place
            first, last = packed & FIRST_MASK, (packed >> FIRST_BITS) & END_MASK
            place = _write_two(tile, first, last, tiles_x, i, ahead, listed, place, numbers)
            first, last = (packed >> COLUMN_BITS) & FIRST_MASK, packed >> (COLUMN_BITS + FIRST_BITS)
            tile += np.int64(last > 0)
            place = _write_two(tile, first, last, tiles_x, i, ahead, listed, place, numbers)
        else:
            place = _list_gaussian(records, i, width, height, tiles_x, slot - place, listed, place, numbers)
        firsts[i] = slot
        bounds[i] = place - before
    return place


@kernel
def list_in_order(
    counter, records, keys, tiles, rows, bounds, firsts, starts, cuts, width, height, tiles_x, taken, places, pairs,
    listed, spans, numbers,
):  # fmt: skip
    """listed: Gaussian, slot, and tile, first and last row in one number, of every pair; those of a part lie within
    its span (parts, 2), lowest key first. numbers (parts, tiles): how often a part meets a tile.

    keys: from 0, uint32, NOWHERE for what is not drawn; tiles, rows: of `few_tiles`; cuts (parts + 1,): where parts
    begin and end. bounds, firsts: see `number_slots`, firsts counted from that of the chunk in `starts`; become counts,
    and slots.
    taken (2,): 0, 0; places (parts, DIGITS, 2^11), pairs (2, n + parts): workspace."""
    parts = numbers.shape[0]
    while True:
        part = take_number(counter)
        if part >= parts:
            break
        numbers[part] = 0
        low, high = np.int64(cuts[part]), np.int64(cuts[part + 1])
        begin, count, largest, room = _choose(keys, bounds, low, high, taken, pairs)
        _sort(pairs, begin, count, largest, places[part])
        place = take(taken, 1, room + 1)  # what is written to be written over may lie one beyond
        spans[part, 0] = place
        spans[part, 1] = _list_part(
            pairs[1], begin, count, records, tiles, rows, bounds, firsts, starts, width, height, tiles_x, listed, place,
            numbers[part],
        )  # fmt: skip


@kernel
def deal(numbers, starts):
    """Turns numbers into the place where each part starts in each tile; starts (tiles + 1,): of the tiles."""
    parts, tiles = numbers.shape
    total = 0
    for tile in range(tiles):
        starts[tile] = total
        for part in range(parts):
            number = numbers[part, tile]
            numbers[part, tile] = total
            total += number
    starts[tiles] = total


@kernel
def scatter(counter, listed, spans, places, entries):
    """Writes the entries of all tiles, lowest key first; places: from `deal`, used up."""
    while True:
        part = take_number(counter)
        if part >= spans.shape[0]:
            break
        of_part = places[part]
        for at in range(spans[part, 0] * LISTED, spans[part, 1] * LISTED, LISTED):
            word = np.int64(get(listed, at + 2))
            tile = word >> (2 * ROW_BITS)
            to = of_part[tile] * ENTRY
            of_part[tile] += 1
            prefetch_to_write(entries, to + NEXT_LINE)
            entries[to + GAUSSIAN], entries[to + SLOT] = get(listed, at), get(listed, at + 1)
            entries[to + FIRST_ROW], entries[to + END_ROW] = (word >> ROW_BITS) & ROW_MASK, (word & ROW_MASK) + 1
