# SPDX-License-Identifier: GPL-3.0-or-later
"""Layers on their way to a picture: small ones enlarged, and one laid over what is behind (the definition is
`..layers`).

Enlarging by f is the tent of 2 f weights on which the f rows that a row becomes and the halves of its neighbours
lie, along both axes. A new row mixes two of the small ones,

    new[(r - 1) f + j] = (1 - |p|) small[r] + |p| small[r - 1 if p < 0 else r + 1],   p = (j + 1/2) / f - 1/2

so that backward each small row gathers 2 f new ones: small[r] = sum_k tent[k] new[(r - 1) f - f / 2 + k]. No two
threads write to the same row, and sums have one order. Rows are mixed first, as vectors, into scratch, then
the pixels within them.

A layer over what is behind is colour + t behind; backward, t gets the product of gradient and what is behind.
"""
from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from . import buffers
from .buffers import Array
from .compilation import inlined, kernel
from .threads import parallel
from .tiles import flat
from .vector import LANES, deinterleave, fma, get, interleave, load, splat, store, store_rows, take_number

PIECE = 1 << 12
"""Pixels to a piece of work."""
REACH = 8
"""Pixels of zeros on both sides of a scratch row: more than half a tent."""
ZERO = np.float32(0)


@inlined
def _mix_rows(plane, length, near, far, share, row):
    """row = (1 - share) plane[near] + share plane[far], rows of at least 16 numbers."""
    for block in range(0, length, LANES):
        at = min(block, length - LANES)
        here = load(plane, near * length + at)
        store(row, at, fma(load(plane, far * length + at) - here, share, here))


@inlined
def _enlarge_row(row, channels, factor, width, out, at):
    """The pixels of a mixed row into `width` new ones, from the flat index `at` on."""
    for i in range(width):
        cell, j = i // factor + 1, i % factor
        share = (j + 0.5) / factor - 0.5
        other = cell - 1 if share < 0 else cell + 1
        weight = np.float32(abs(share))
        for c in range(channels):
            here = get(row, cell * channels + c)
            out[at + i * channels + c] = here + weight * (get(row, other * channels + c) - here)


@kernel
def enlarge(counter, row, colour, t, small_width, factor, width, height, out_colour, out_t):
    """colour (h, w, 3) and t (h, w) of a small picture with a border of one pixel, to (height, width)."""
    while True:
        y = take_number(counter)
        if y >= height:
            break
        near, j = y // factor + 1, y % factor
        share = (j + 0.5) / factor - 0.5
        far = near - 1 if share < 0 else near + 1
        weight = np.float32(abs(share))
        _mix_rows(colour, 3 * small_width, near, far, weight, row)
        _enlarge_row(row, 3, factor, width, out_colour, 3 * y * width)
        _mix_rows(t, small_width, near, far, weight, row)
        _enlarge_row(row, 1, factor, width, out_t, y * width)


@inlined
def _gather_rows(plane, length, r, factor, height, row, pad):
    """The tent over the rows of a plane, about small row r, into row[pad : pad + length]."""
    start = (r - 1) * factor - factor // 2
    first, last = max(start, 0), min(start + 2 * factor, height)
    for block in range(0, length, LANES):
        at = min(block, length - LANES)
        total = splat(ZERO)
        for y in range(first, last):
            weight = (min(y - start, start + 2 * factor - 1 - y) + 0.5) / factor
            total = fma(load(plane, y * length + at), np.float32(weight), total)
        store(row, pad + at, total)


@inlined
def _gather_pixels(row, pad, channels, factor, small_width, out, at):
    for x in range(small_width):
        first = pad + ((x - 1) * factor - factor // 2) * channels
        for c in range(channels):
            total = ZERO
            for k in range(factor):
                weight = np.float32((k + 0.5) / factor)
                far = get(row, first + (2 * factor - 1 - k) * channels + c)
                total += weight * (get(row, first + k * channels + c) + far)
            out[at + x * channels + c] = total


@kernel
def enlarge_backward(counter, row, d_colour, d_t, small_width, small_height, factor, width, height, out_colour, out_t):
    """The gradients of the small picture; d_t may be empty."""
    pad = 3 * REACH
    row[:] = ZERO
    while True:
        r = take_number(counter)
        if r >= small_height:
            break
        _gather_rows(d_colour, 3 * width, r, factor, height, row, pad)
        row[pad + 3 * width :] = ZERO
        _gather_pixels(row, pad, 3, factor, small_width, out_colour, 3 * r * small_width)
        if d_t.size > 0:
            _gather_rows(d_t, width, r, factor, height, row, pad)
            row[pad + width : pad + width + 3 * REACH] = ZERO
            _gather_pixels(row, pad, 1, factor, small_width, out_t, r * small_width)


@kernel
def lay(counter, colour, t, behind, out):
    """out = colour + t behind; (n, 3) and t (n,), n at least 16."""
    n = t.size
    while True:
        start = take_number(counter) * PIECE
        if start >= n:
            break
        for block in range(start, min(start + PIECE, n), LANES):
            at = min(block, n - LANES)
            shares = interleave((load(t, at), load(t, at), load(t, at)))
            for part in range(3):
                i = 3 * at + part * LANES
                store(out, i, fma(load(behind, i), shares[part], load(colour, i)))


@kernel
def lay_backward(counter, gradient, t, behind, d_t, d_behind):
    """d_t = gradient . behind, d_behind = t gradient."""
    n = t.size
    while True:
        start = take_number(counter) * PIECE
        if start >= n:
            break
        for block in range(start, min(start + PIECE, n), LANES):
            at = min(block, n - LANES)
            i = 3 * at
            v = deinterleave((load(gradient, i), load(gradient, i + LANES), load(gradient, i + 2 * LANES)))
            b = deinterleave((load(behind, i), load(behind, i + LANES), load(behind, i + 2 * LANES)))
            share = load(t, at)
            store(d_t, at, fma(v[0], b[0], fma(v[1], b[1], v[2] * b[2])))
            store_rows(d_behind, i, LANES, interleave((v[0] * share, v[1] * share, v[2] * share)))


class _Enlarge(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, colour: Tensor, t: Tensor, factor: int, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        small_height, small_width = t.shape
        ctx.sizes = small_width, small_height, factor, width, height
        ctx.set_materialize_grads(False)
        large, large_flat = buffers.pair(height, width, 3)
        large_t, large_t_flat = buffers.pair(height, width)
        parallel(
            enlarge, flat(colour), flat(t), small_width, factor, width, height, large_flat, large_t_flat,
            scratch=3 * small_width,
        )  # fmt: skip
        return large, large_t

    @staticmethod
    def backward(ctx: Any, d_large: Tensor | None, d_large_t: Tensor | None) -> Any:  # type: ignore[override]
        small_width, small_height, factor, width, height = ctx.sizes
        d_colour, d_colour_flat = buffers.pair(small_height, small_width, 3)
        d_t, d_t_flat = buffers.pair(small_height, small_width)
        v = buffers.zeros(3 * width * height) if d_large is None else flat(d_large)
        v_t: Array = np.empty(0, np.float32) if d_large_t is None else flat(d_large_t)
        parallel(
            enlarge_backward, v, v_t, *ctx.sizes, d_colour_flat, d_t_flat,
            scratch=3 * (small_width * factor + 2 * REACH),
        )  # fmt: skip
        return d_colour, None if d_large_t is None else d_t, None, None, None


class _Lay(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, colour: Tensor, t: Tensor, behind: Tensor) -> Tensor:  # type: ignore[override]
        picture, picture_flat = buffers.pair(*colour.shape)
        parallel(lay, flat(colour), flat(t), flat(behind), picture_flat)
        ctx.save_for_backward(t, behind)
        return picture

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:  # type: ignore[override]
        t, behind = ctx.saved_tensors
        d_t, d_t_flat = buffers.pair(*t.shape)
        d_behind, d_behind_flat = buffers.pair(*behind.shape)
        parallel(lay_backward, flat(gradient), flat(t), flat(behind), d_t_flat, d_behind_flat)
        return gradient, d_t, d_behind


def enlarged(colour: Tensor, t: Tensor, factor: int, width: int, height: int) -> tuple[Tensor, Tensor] | None:
    """See `..layers`; None for pictures too small for vectors."""
    if min(width, t.shape[1]) < LANES:
        return None
    return _Enlarge.apply(colour, t, factor, width, height)


def over(colour: Tensor, t: Tensor, behind: Tensor) -> Tensor | None:
    """See `..layers`; None for pictures too small for vectors."""
    return _Lay.apply(colour, t, behind) if t.numel() >= LANES else None
