# SPDX-License-Identifier: GPL-3.0-or-later
"""Bilinear upsampling of reduced layers and compositing of a layer over a background; the definition is `..layers`.

Upsampling by f applies a tent of 2 f weights along both axes. Each new row interpolates between two of the small ones,

    new[(r - 1) f + j] = (1 - |p|) small[r] + |p| small[r - 1 if p < 0 else r + 1],   p = (j + 1/2) / f - 1/2

so in the backward pass each small row gathers 2 f new ones: small[r] = sum_k tent[k] new[(r - 1) f - f / 2 + k]. No two
threads write to the same row, and the order of summation is fixed. Rows are interpolated first, as vectors, into
scratch, then the pixels within them.

The composite is colour + t behind; in the backward pass t receives gradient . behind.
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
from .vector import LANES, atomic_increment, deinterleave, fma, interleave, load, load_scalar, splat, store, store_rows

PIXELS_PER_TASK = 1 << 12
"""Pixels that a thread composites at a time."""
PADDING = 8
"""Zero pixels on both sides of a scratch row: border pixels gather up to 3/4 of a tent there, 6 pixels for factor 4."""
ZERO = np.float32(0)


@inlined
def _interpolate_rows(plane, row_length, nearest, other, other_weight, out):
    """Write (1 - other_weight) plane[nearest] + other_weight plane[other] to the row `out`; rows have at least 16
    numbers."""
    for block in range(0, row_length, LANES):
        column = min(block, row_length - LANES)
        nearest_row = load(plane, nearest * row_length + column)
        store(out, column, fma(load(plane, other * row_length + column) - nearest_row, other_weight, nearest_row))


@inlined
def _upsample_row(row, channels, factor, width, out, out_start):
    """Upsample the pixels of an interpolated row, which has a border of one pixel, to `width` pixels of `out`, from the
    flat index out_start on."""
    for x in range(width):
        nearest, position = x // factor + 1, x % factor
        offset = (position + 0.5) / factor - 0.5
        other = nearest - 1 if offset < 0 else nearest + 1
        other_weight = np.float32(abs(offset))
        for channel in range(channels):
            nearest_value = load_scalar(row, nearest * channels + channel)
            other_value = load_scalar(row, other * channels + channel)
            out[out_start + x * channels + channel] = nearest_value + other_weight * (other_value - nearest_value)


@kernel
def upsample_kernel(counter, row, colour, t, small_width, factor, width, height, out_colour, out_t):
    """Upsample colour (h, w, 3) and t (h, w), which have a border of one pixel, to (height, width), all flat.

    counter: index of the next row; row: scratch; small_width: w; factor: large size over small size."""
    while True:
        y = atomic_increment(counter)
        if y >= height:
            break
        nearest, position = y // factor + 1, y % factor
        offset = (position + 0.5) / factor - 0.5
        other = nearest - 1 if offset < 0 else nearest + 1
        other_weight = np.float32(abs(offset))
        _interpolate_rows(colour, 3 * small_width, nearest, other, other_weight, row)
        _upsample_row(row, 3, factor, width, out_colour, 3 * y * width)
        _interpolate_rows(t, small_width, nearest, other, other_weight, row)
        _upsample_row(row, 1, factor, width, out_t, y * width)


@inlined
def _gather_rows(plane, row_length, small_row, factor, height, row, padding):
    """Write the tent-weighted sum of the rows of a plane about small_row to row[padding : padding + row_length].

    row_length, height: numbers in a row of the plane, and its number of rows."""
    start = (small_row - 1) * factor - factor // 2
    first_row, end_row = max(start, 0), min(start + 2 * factor, height)
    for block in range(0, row_length, LANES):
        column = min(block, row_length - LANES)
        total = splat(ZERO)
        for y in range(first_row, end_row):
            weight = (min(y - start, start + 2 * factor - 1 - y) + 0.5) / factor
            total = fma(load(plane, y * row_length + column), np.float32(weight), total)
        store(row, padding + column, total)


@inlined
def _gather_pixels(row, padding, channels, factor, small_width, out, out_start):
    """Write the tent-weighted sums along a row of `_gather_rows` to small_width pixels of `out`, from index out_start
    on."""
    for x in range(small_width):
        start = padding + ((x - 1) * factor - factor // 2) * channels
        for channel in range(channels):
            total = ZERO
            for k in range(factor):
                weight = np.float32((k + 0.5) / factor)
                mirrored_value = load_scalar(row, start + (2 * factor - 1 - k) * channels + channel)
                total += weight * (load_scalar(row, start + k * channels + channel) + mirrored_value)
            out[out_start + x * channels + channel] = total


@kernel
def upsample_backward_kernel(
    counter, row, d_colour, d_t, small_width, small_height, factor, width, height, out_colour, out_t
):  # fmt: skip
    """Write the gradients of the small picture (out_colour, out_t), border included, from those of the large one
    (d_colour, d_t), all flat; d_t may be empty.

    counter: index of the next small row; row: scratch; small_width, small_height: with the border; factor: large size
    over small size."""
    padding = 3 * PADDING
    row[:] = ZERO
    while True:
        small_row = atomic_increment(counter)
        if small_row >= small_height:
            break
        _gather_rows(d_colour, 3 * width, small_row, factor, height, row, padding)
        row[padding + 3 * width :] = ZERO
        _gather_pixels(row, padding, 3, factor, small_width, out_colour, 3 * small_row * small_width)
        if d_t.size > 0:
            _gather_rows(d_t, width, small_row, factor, height, row, padding)
            row[padding + width : padding + width + 3 * PADDING] = ZERO
            _gather_pixels(row, padding, 1, factor, small_width, out_t, small_row * small_width)


@kernel
def composite_kernel(counter, colour, t, behind, out):
    """Write colour + t behind to `out`; colour, behind and out (n 3), t (n,), all flat; n at least 16.

    counter: index of the next task of PIXELS_PER_TASK pixels."""
    n = t.size
    while True:
        start = atomic_increment(counter) * PIXELS_PER_TASK
        if start >= n:
            break
        for block in range(start, min(start + PIXELS_PER_TASK, n), LANES):
            pixel = min(block, n - LANES)
            t_by_channel = interleave((load(t, pixel), load(t, pixel), load(t, pixel)))
            for vector_index in range(3):
                index = 3 * pixel + vector_index * LANES
                store(out, index, fma(load(behind, index), t_by_channel[vector_index], load(colour, index)))


@kernel
def composite_backward_kernel(counter, gradient, t, behind, d_t, d_behind):
    """Write d_t = gradient . behind and d_behind = t gradient, in the shapes of `composite_kernel`.

    counter: index of the next task of PIXELS_PER_TASK pixels."""
    n = t.size
    while True:
        start = atomic_increment(counter) * PIXELS_PER_TASK
        if start >= n:
            break
        for block in range(start, min(start + PIXELS_PER_TASK, n), LANES):
            pixel = min(block, n - LANES)
            index = 3 * pixel
            v = deinterleave((load(gradient, index), load(gradient, index + LANES), load(gradient, index + 2 * LANES)))
            b = deinterleave((load(behind, index), load(behind, index + LANES), load(behind, index + 2 * LANES)))
            transmittance = load(t, pixel)
            store(d_t, pixel, fma(v[0], b[0], fma(v[1], b[1], v[2] * b[2])))
            products = (v[0] * transmittance, v[1] * transmittance, v[2] * transmittance)
            store_rows(d_behind, index, LANES, interleave(products))


class _Upsample(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
                ctx: Any, colour: Tensor, t: Tensor, factor: int, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """Return colour (height, width, 3) and transmittance (height, width), upsampled bilinearly by `factor`.

        colour, t: the small pictures, with a border of one pixel."""
        small_height, small_width = t.shape
        ctx.sizes = small_width, small_height, factor, width, height
        ctx.set_materialize_grads(False)
        large, large_flat = buffers.tensor_and_array(height, width, 3)
        large_t, large_t_flat = buffers.tensor_and_array(height, width)
        parallel(
            upsample_kernel, flat(colour), flat(t), small_width, factor, width, height, large_flat, large_t_flat,
            scratch=3 * small_width,
        )  # fmt: skip
        return large, large_t

    @staticmethod
    def backward(ctx: Any, d_large: Tensor | None, d_large_t: Tensor | None) -> Any:  # type: ignore[override]
        """Return the gradients of the small colour and transmittance; None arrives for a result that was not used."""
        small_width, small_height, factor, width, height = ctx.sizes
        d_colour, d_colour_flat = buffers.tensor_and_array(small_height, small_width, 3)
        d_t, d_t_flat = buffers.tensor_and_array(small_height, small_width)
        v = buffers.zeros(3 * width * height) if d_large is None else flat(d_large)
        v_t: Array = np.empty(0, np.float32) if d_large_t is None else flat(d_large_t)
        parallel(
            upsample_backward_kernel, v, v_t, *ctx.sizes, d_colour_flat, d_t_flat,
            scratch=3 * (small_width * factor + 2 * PADDING),
        )  # fmt: skip
        return d_colour, None if d_large_t is None else d_t, None, None, None


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, colour: Tensor, t: Tensor, behind: Tensor) -> Tensor:  # type: ignore[override]
        picture, picture_flat = buffers.tensor_and_array(*colour.shape)
        parallel(composite_kernel, flat(colour), flat(t), flat(behind), picture_flat)
        ctx.save_for_backward(t, behind)
        return picture

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:  # type: ignore[override]
        t, behind = ctx.saved_tensors
        d_t, d_t_flat = buffers.tensor_and_array(*t.shape)
        d_behind, d_behind_flat = buffers.tensor_and_array(*behind.shape)
        parallel(composite_backward_kernel, flat(gradient), flat(t), flat(behind), d_t_flat, d_behind_flat)
        return gradient, d_t, d_behind


def upsample(colour: Tensor, t: Tensor, factor: int, width: int, height: int) -> tuple[Tensor, Tensor] | None:
    """Upsample as `upsample_layer` of `..layers` does; None for pictures too small for vectors."""
    if min(width, t.shape[1]) < LANES:
        return None
    return _Upsample.apply(colour, t, factor, width, height)


def over(colour: Tensor, t: Tensor, behind: Tensor) -> Tensor | None:
    """Composite as `over` of `..layers` does; None for pictures too small for vectors."""
    return _Composite.apply(colour, t, behind) if t.numel() >= LANES else None
