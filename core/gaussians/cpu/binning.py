# SPDX-License-Identifier: GPL-3.0-or-later
"""Which Gaussians meet which tile, nearest first.

The extent of a Gaussian is that of the ellipse where alpha is
1/255, which opacity makes smaller (SnugBox of Hanson et al. 2025, Speedy-Splat). In a column of tiles it meets
just the pixel rows between the ellipse's lowest and highest point there (as their AccuTile): with X the
offset of the column's edge from the centre, and the record's A, k, D, C and reach t (all but k negative),

    A (X + k y)² + D y² = t   at   y = (-A k X ± sqrt(C t - A D X²)) / C

and the extreme points of the whole ellipse, y = ± half_y, lie at X = ∓ k half_y.

First, `list_and_sort` writes down the tiles of each Gaussian, in the Gaussians' own order, each in a slot, and
orders the Gaussians by depth; then `count`, `deal` and `scatter` walk them in that order and deal the slots out
to the tiles, so that no tile needs sorting. A slot number also is the place of the gradient that the tile sends
back to the Gaussian.
"""
from __future__ import annotations

import math

import numpy as np

from .compilation import inlined, kernel
from .layout import (
    DEPTH,
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
from .projection import CHUNK
from .vector import get, opaque, prefetch, take_number

ROW_BITS, ROW_MASK = TILE_SHIFT_Y, TILE_HEIGHT - 1
DIGITS = 3
AHEAD = 8
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
def _crossing(records, at, x):
    """Lowest and highest point of the ellipse at the horizontal offset x, or where it is nearest to that."""
    half_x, k, major = get(records, at + HALF_X), get(records, at + K), get(records, at + A)
    inverse = ONE / (major * k * k + get(records, at + D))
    x = _least(_most(x, -half_x), half_x)
    major = major * inverse
    square = inverse * (get(records, at + REACH) - major * get(records, at + D) * x * x)
    root = math.sqrt(_most(square, ZERO))
    middle = -major * k * x
    return middle - root, middle + root


@inlined
def _write_column(column, top, bottom, tiles_x, slots, slot):
    """Writes the tiles of a column that pixel rows top .. bottom meet; returns the next slot."""
    row, one = top >> TILE_SHIFT_Y, opaque(1)
    while row << TILE_SHIFT_Y <= bottom:
        base = row << TILE_SHIFT_Y
        first = top - base if top > base else 0
        last = bottom - base if bottom - base < ROW_MASK else ROW_MASK
        slots[slot] = (((row * tiles_x + column) << ROW_BITS | first) << ROW_BITS) | last
        slot += one
        row += one
    return slot


@inlined
def _list_gaussian(records, i, slot, width, height, tiles_x, slots):
    """Writes the tiles of Gaussian i from this slot on; returns the slot after the last."""
    at = i * RECORD
    x, half_x = get(records, at + X), get(records, at + HALF_X) + SLACK
    y, half_y = get(records, at + Y), get(records, at + HALF_Y)
    column = int(_most(x - half_x, ZERO)) >> TILE_SHIFT_X
    last_column = int(_least(x + half_x, np.float32(width - 1))) >> TILE_SHIFT_X
    if column == last_column:
        top, bottom = _pixel_rows(y, -half_y, half_y, height)
        return _write_column(column, top, bottom, tiles_x, slots, slot)
    tip = get(records, at + K) * half_y  # the highest point lies at -tip, the lowest at tip
    one = opaque(1)
    left = np.float32(column << TILE_SHIFT_X) - x
    low0, high0 = _crossing(records, at, left)
    while column <= last_column:
        right = left + np.float32(TILE_WIDTH)
        low1, high1 = _crossing(records, at, right)
        low = -half_y if left <= tip <= right else _least(low0, low1)
        high = half_y if left <= -tip <= right else _most(high0, high1)
        top, bottom = _pixel_rows(y, low, high, height)
        slot = _write_column(column, top, bottom, tiles_x, slots, slot)
        left, low0, high0 = right, low1, high1
        column += one
    return slot


@inlined
def _list_chunk(chunk, records, bounds, chunk_starts, width, height, tiles_x, slots, firsts, counts):
    slot = chunk_starts[chunk]
    for i in range(chunk * CHUNK, min(chunk * CHUNK + CHUNK, bounds.size)):
        first = slot
        if bounds[i] > 0:
            slot = _list_gaussian(records, i, slot, width, height, tiles_x, slots)
        firsts[i] = first
        counts[i] = slot - first


@kernel
def list_and_sort(
    counter, records, bits, bounds, chunk_starts, width, height, tiles_x, by_depth,
    slots, firsts, counts, places, keys, spare_keys, order, spare_order,
):  # fmt: skip
    """slots: tile, first and last row of every pair of Gaussian and tile, in the Gaussians' order; those of
    Gaussian i are the counts[i] from firsts[i] on. chunk_starts: where each chunk may write. order: see `_sort`;
    as many as there are bounds > 0. bits: the records as uint32."""
    while True:
        piece = take_number(counter)
        if piece > chunk_starts.size:
            break
        if piece > 0:
            _list_chunk(
                piece - 1, records, bounds, chunk_starts, width, height, tiles_x, slots, firsts, counts
            )
        elif by_depth:  # the longest piece goes first
            _sort(bits, bounds, places, keys, spare_keys, order, spare_order)
        else:
            m = 0
            for i in range(bounds.size):
                if bounds[i] > 0:
                    order[m] = i
                    m += 1


@inlined
def _sort(bits, bounds, places, keys, spare_keys, order, spare_order):
    """Writes to `order` the Gaussians whose bound is not 0, nearest first.

    Depths are positive, so their bits sort as they do. Three passes of a radix sort, stable, by digits as short
    as the range of the depths allows; places (DIGITS, 2^11) and the arrays (n,) are its workspace.
    """
    smallest, largest, m = np.uint32(0xFFFFFFFF), np.uint32(0), 0
    for i in range(bounds.size):
        if bounds[i] > 0:
            key = get(bits, i * RECORD + DEPTH)
            smallest = key if key < smallest else smallest
            largest = key if key > largest else largest
            spare_keys[m] = key
            spare_order[m] = i
            m += 1
    if m == 0:
        return
    length = 1
    while (largest - smallest) >> np.uint32(length) > 0:
        length += 1
    digit = (length + DIGITS - 1) // DIGITS
    mask = (1 << digit) - 1
    places[:, : mask + 1] = 0
    for i in range(m):
        key = spare_keys[i] - smallest
        spare_keys[i] = key
        for d in range(DIGITS):
            places[d, (key >> np.uint32(d * digit)) & mask] += 1
    _distribute(spare_keys, spare_order, m, digit * 0, mask, places[0], keys, order)
    _distribute(keys, order, m, digit, mask, places[1], spare_keys, spare_order)
    _distribute(spare_keys, spare_order, m, 2 * digit, mask, places[2], keys, order)


@inlined
def _distribute(keys, order, m, shift, mask, places, to_keys, to_order):
    """One pass: by the digit above `shift`, whose counts are in `places`."""
    total = 0
    for b in range(mask + 1):
        number = places[b]
        places[b] = total
        total += number
    for i in range(m):
        key = keys[i]
        b = (key >> np.uint32(shift)) & mask
        place = places[b]
        places[b] = place + 1
        to_keys[place] = key
        to_order[place] = order[i]


@inlined
def _part(order_size, parts, part):
    return order_size * part // parts, order_size * (part + 1) // parts


@inlined
def _prefetch_slots(j, end, order, slots, firsts, counts):
    """Asks for what the walk in order of depth will need soon: it jumps about in memory."""
    far = get(order, _least(j + 2 * AHEAD, end - 1))
    prefetch(firsts, far)
    prefetch(counts, far)
    prefetch(slots, get(firsts, get(order, _least(j + AHEAD, end - 1))))


@kernel
def count(counter, order, m, slots, firsts, counts, numbers):
    """numbers (parts, tiles): how often each tile is met by each part of the sorted Gaussians."""
    parts = numbers.shape[0]
    while True:
        part = take_number(counter)
        if part >= parts:
            break
        numbers[part] = 0
        start, end = _part(m, parts, part)
        for j in range(start, end):
            _prefetch_slots(j, end, order, slots, firsts, counts)
            i = order[j]
            slot, stop, one = get(firsts, i), get(firsts, i) + get(counts, i), opaque(1)
            while slot < stop:
                numbers[part, get(slots, slot) >> (2 * ROW_BITS)] += 1
                slot += one


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
def scatter(counter, order, m, slots, firsts, counts, places, entries):
    """Writes the entries of all tiles, nearest first; places: from `deal`, used up."""
    parts = places.shape[0]
    while True:
        part = take_number(counter)
        if part >= parts:
            break
        start, end = _part(m, parts, part)
        for j in range(start, end):
            _prefetch_slots(j, end, order, slots, firsts, counts)
            i = order[j]
            slot, stop, one = get(firsts, i), get(firsts, i) + get(counts, i), opaque(1)
            while slot < stop:
                word = get(slots, slot)
                tile = word >> (2 * ROW_BITS)
                place = places[part, tile]
                places[part, tile] = place + 1
                at = place * ENTRY
                entries[at + GAUSSIAN], entries[at + SLOT] = i, slot
                entries[at + FIRST_ROW], entries[at + END_ROW] = (word >> ROW_BITS) & ROW_MASK, (word & ROW_MASK) + 1
                slot += one
