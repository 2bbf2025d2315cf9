# SPDX-License-Identifier: GPL-3.0-or-later
"""Which Gaussians meet which tile, nearest first.

Tiles are 16 pixels wide, one vector, and 32 high. The extent of a Gaussian is that of the ellipse where alpha is
1/255, which opacity makes smaller (SnugBox of Hanson et al. 2025, Speedy-Splat). In a column of tiles it meets
exactly the pixel rows between the ellipse's lowest and highest point there (as their AccuTile): with X the
offset of a pixel column from the centre, and the record's A, k, D, C and reach t,

    A (X + k y)² + D y² = t   at   y = (-A k X ± sqrt(C t - A D X²)) / C

and the extreme points of the whole ellipse, y = ± half_y, lie at X = ∓ k half_y.

Three steps: `list_tiles` writes down the tiles of each Gaussian, in the Gaussians' own order, each in a slot;
`sort_by_depth` orders the Gaussians; `count`, `deal` and `scatter` walk them in that order and deal the slots out to
the tiles, so that no tile needs sorting. A slot number also is the place of the gradient that the tile sends
back to the Gaussian.
"""
from __future__ import annotations

import math

import numpy as np

from .compilation import inlined, kernel
from .projection import BEND, CHUNK, DEPTH, HALF_X, HALF_Y, REACH, RECORD, A, D, K, X, Y
from .vector import take_number

TILE_SHIFT_X, TILE_SHIFT_Y = 4, 5
TILE_WIDTH, TILE_HEIGHT = 1 << TILE_SHIFT_X, 1 << TILE_SHIFT_Y
ROW_BITS = TILE_SHIFT_Y
ROW_MASK = TILE_HEIGHT - 1
# An entry of a tile: which Gaussian, first row and end row within the tile, slot.
GAUSSIAN, FIRST_ROW, END_ROW, SLOT, ENTRY = 0, 1, 2, 3, 4
DIGITS = 3
HALF, ZERO, ONE = np.float32(0.5), np.float32(0), np.float32(1)
SLACK = np.float32(0.02)
"""Pixels by which the row range is widened against rounding."""


@inlined
def _column_rows(records, at, left, height):  # type: ignore[no-untyped-def]
    """First and last pixel row that the ellipse meets among the pixel columns left .. left + 15."""
    half_y = records[at + HALF_Y]
    tip = records[at + K] * half_y  # the highest point lies at -tip, the lowest at tip
    x0 = np.float32(left) + HALF - records[at + X]
    x1 = x0 + np.float32(TILE_WIDTH - 1)
    bend = records[at + BEND]
    inverse = ONE / bend
    slope = -records[at + A] * records[at + K] * inverse
    quadratic = records[at + A] * records[at + D]
    constant = bend * records[at + REACH]
    root0 = math.sqrt(max(constant - quadratic * x0 * x0, ZERO)) * inverse
    root1 = math.sqrt(max(constant - quadratic * x1 * x1, ZERO)) * inverse
    low, high = -half_y, half_y
    if not (x0 <= tip <= x1):
        low = min(slope * x0 - root0, slope * x1 - root1)
    if not (x0 <= -tip <= x1):
        high = max(slope * x0 + root0, slope * x1 + root1)
    y = records[at + Y] - HALF
    first = max(y + max(low, -half_y) - SLACK, ZERO)
    last = min(y + min(high, half_y) + SLACK, np.float32(height - 1))
    if last < ZERO or first > last:
        return 1, 0
    return int(math.ceil(first)), int(last)


@inlined
def _list_gaussian(records, i, slot, width, height, tiles_x, slots):  # type: ignore[no-untyped-def]
    """Writes the tiles of Gaussian i from this slot on; returns the slot after the last."""
    at = i * RECORD
    x, half_x = records[at + X], records[at + HALF_X]
    first_column = int(min(max(x - half_x - SLACK, ZERO), np.float32(width - 1))) >> TILE_SHIFT_X
    last_column = int(min(max(x + half_x + SLACK, ZERO), np.float32(width - 1))) >> TILE_SHIFT_X
    for column in range(first_column, last_column + 1):
        top, bottom = _column_rows(records, at, column << TILE_SHIFT_X, height)
        if top > bottom:
            continue
        for row in range(top >> TILE_SHIFT_Y, (bottom >> TILE_SHIFT_Y) + 1):
            base = row << TILE_SHIFT_Y
            first, last = max(top - base, 0), min(bottom - base, ROW_MASK)
            slots[slot] = (((row * tiles_x + column) << ROW_BITS | first) << ROW_BITS) | last
            slot += 1
    return slot


@kernel
def list_tiles(counter, scratch, records, bounds, chunk_starts, width, height, tiles_x, slots, firsts, counts):  # type: ignore[no-untyped-def]
    """slots: tile, first and last row of every pair of Gaussian and tile, in the Gaussians' order;
    those of Gaussian i are the counts[i] from firsts[i] on. chunk_starts: where each chunk may write."""
    n = bounds.size
    while True:
        chunk = take_number(counter)
        start, end = chunk * CHUNK, min(chunk * CHUNK + CHUNK, n)
        if start >= n:
            break
        room = chunk_starts[chunk]
        for i in range(start, end):
            slot = room
            if bounds[i] > 0:
                slot = _list_gaussian(records, i, slot, width, height, tiles_x, slots)
            firsts[i] = room
            counts[i] = slot - room
            room = slot


@kernel
def sort_by_depth(bits, counts, places, keys, spare_keys, order, spare_order):  # type: ignore[no-untyped-def]
    """Writes to `order` the Gaussians that meet any tile, nearest first, and returns how many.

    bits: the records as uint32; depths are positive, so their bits sort as they do. Three passes of a radix
    sort, stable, by digits as short as the range of the depths allows; places (DIGITS, 2^11) and
    the arrays (n,) are its workspace.
    """
    smallest, largest, m = np.uint32(0xFFFFFFFF), np.uint32(0), 0
    for i in range(counts.size):
        if counts[i] > 0:
            key = bits[i * RECORD + DEPTH]
            smallest, largest = min(smallest, key), max(largest, key)
            spare_keys[m] = key
            spare_order[m] = i
            m += 1
    if m == 0:
        return 0
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
    _distribute(spare_keys, spare_order, m, 0, mask, places[0], keys, order)
    _distribute(keys, order, m, digit, mask, places[1], spare_keys, spare_order)
    _distribute(spare_keys, spare_order, m, 2 * digit, mask, places[2], keys, order)
    return m


@inlined
def _distribute(keys, order, m, shift, mask, places, to_keys, to_order):  # type: ignore[no-untyped-def]
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
def _part(order_size, parts, part):  # type: ignore[no-untyped-def]
    return order_size * part // parts, order_size * (part + 1) // parts


@kernel
def count(counter, scratch, order, m, slots, firsts, counts, numbers):  # type: ignore[no-untyped-def]
    """numbers (parts, tiles): how often each tile is met by each part of the sorted Gaussians."""
    parts = numbers.shape[0]
    while True:
        part = take_number(counter)
        if part >= parts:
            break
        numbers[part] = 0
        start, end = _part(m, parts, part)
        for j in range(start, end):
            i = order[j]
            for slot in range(firsts[i], firsts[i] + counts[i]):
                numbers[part, slots[slot] >> (2 * ROW_BITS)] += 1


@kernel
def deal(numbers, starts):  # type: ignore[no-untyped-def]
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
def scatter(counter, scratch, order, m, slots, firsts, counts, places, entries):  # type: ignore[no-untyped-def]
    """Writes the entries of all tiles, nearest first; places: from `deal`, used up."""
    parts = places.shape[0]
    while True:
        part = take_number(counter)
        if part >= parts:
            break
        start, end = _part(m, parts, part)
        for j in range(start, end):
            i = order[j]
            for slot in range(firsts[i], firsts[i] + counts[i]):
                word = slots[slot]
                tile = word >> (2 * ROW_BITS)
                place = places[part, tile]
                places[part, tile] = place + 1
                at = place * ENTRY
                entries[at + GAUSSIAN], entries[at + SLOT] = i, slot
                entries[at + FIRST_ROW], entries[at + END_ROW] = (word >> ROW_BITS) & ROW_MASK, (word & ROW_MASK) + 1
