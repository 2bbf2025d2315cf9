# SPDX-License-Identifier: GPL-3.0-or-later
"""The deformation network of a flare's Gaussians, forth and back; the definition is `core.flare.deformation`.

Each Gaussian's position is encoded by sines and cosines, followed by its latent code: a row e of E numbers, padded to
a multiple of 16. Then come three hidden layers and the heads:

    x1 = relu(We e + view)      x2 = relu(W2 x1 + b2)      x3 = relu(W3 x2 + b3)      offsets = Wh x3 + bh

All products are sums c[row, column] = sum_k a[row, k] b[k, column]. `_product` computes four rows of 16 columns of
them: in the AVX2 registers, all four sums and a row of b have room. Its b is a panel of a matrix, 16 columns in
sequence (`_pack`), since rows of 128 numbers would fall into the same few sets of the cache. The weights' gradients are
sums over Gaussians, a the gradient of a layer's output and b its input.

A thread processes blocks of Gaussians, through all layers, while their rows are in the cache. In the backward pass each
part of the Gaussians, one for each thread, has sums of its own, which are added up in the order of the parts. So the
result depends on the number of threads, but not on which thread takes which part.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from . import buffers
from .buffers import Array
from .compilation import inlined, kernel
from .threads import parallel
from .tiles import EMPTY, flat
from .vector import LANES, atomic_increment, fma, load, load_scalar, maximum, splat, store, where

HIDDEN = 128
"""Width of the hidden layers."""
BLOCK = 32
"""Gaussians that pass through the layers together."""
ROWS = 4
"""Rows of `_product`."""
ZERO = np.float32(0)


# --- products --------------------------------------------------------------------------------------------


@inlined
def _product(a, a_start, row_stride, depth_stride, b, b_start, b_stride, depth):
    """Return sum_k a[row, k] b[k, columns] for four rows, as four vectors of 16 columns; k < depth.

    a_start: index of a[0, 0]. row_stride, depth_stride: steps of the index from row to row and from k to k + 1.
    b_start, b_stride: index of b[0, 0], and step from k to k + 1.
    """
    c0, c1, c2, c3 = splat(ZERO), splat(ZERO), splat(ZERO), splat(ZERO)
    for k in range(depth):
        row, i = load(b, b_start + k * b_stride), a_start + k * depth_stride
        c0 = fma(row, load_scalar(a, i), c0)
        c1 = fma(row, load_scalar(a, i + row_stride), c1)
        c2 = fma(row, load_scalar(a, i + 2 * row_stride), c2)
        c3 = fma(row, load_scalar(a, i + 3 * row_stride), c3)
    return c0, c1, c2, c3


@inlined
def _apply_layer(x, x_start, x_width, panels, bias, rows, width, y, y_start, is_hidden):
    """Write W x + b of a block to y, with relu if `is_hidden`.

    x, y: rows of x_width and `width` numbers, from index x_start and y_start on. panels: W, packed, x_width deep.
    rows: a multiple of 4. width: a multiple of 16.
    """
    for column in range(0, width, LANES):
        offset = load(bias, column)
        for row in range(0, rows, ROWS):
            c = _product(x, x_start + row * x_width, x_width, 1, panels, column * x_width, LANES, x_width)
            c0, c1, c2, c3 = c[0] + offset, c[1] + offset, c[2] + offset, c[3] + offset
            if is_hidden:
                c0, c1, c2, c3 = maximum(c0, ZERO), maximum(c1, ZERO), maximum(c2, ZERO), maximum(c3, ZERO)
            i = y_start + row * width + column
            store(y, i, c0)
            store(y, i + width, c1)
            store(y, i + 2 * width, c2)
            store(y, i + 3 * width, c3)


@inlined
def _input_gradient(d_y, y_width, panels, rows, width, d_x, x, x_start, is_hidden):
    """Write the gradient of a layer's input, W^T d_y, to d_x; with `is_hidden` 0 where the input x is 0.

    d_y, d_x: of a block, rows of y_width and `width` numbers. panels: W, packed, y_width deep. x: the layer's input,
    from index x_start on. rows: a multiple of 4.
    """
    for column in range(0, width, LANES):
        for row in range(0, rows, ROWS):
            c0, c1, c2, c3 = _product(d_y, row * y_width, y_width, 1, panels, column * y_width, LANES, y_width)
            i = row * width + column
            if is_hidden:
                j = x_start + i
                c0, c1 = where(load(x, j) > ZERO, c0, ZERO), where(load(x, j + width) > ZERO, c1, ZERO)
                c2 = where(load(x, j + 2 * width) > ZERO, c2, ZERO)
                c3 = where(load(x, j + 3 * width) > ZERO, c3, ZERO)
            store(d_x, i, c0)
            store(d_x, i + width, c1)
            store(d_x, i + 2 * width, c2)
            store(d_x, i + 3 * width, c3)


@inlined
def _add_weight_gradient(d_y, y_width, x, x_start, x_width, rows, sums, first):
    """Add d_y^T x of a block to the gradient of W, (y_width, x_width) in `sums` from index `first` on, and the sums of
    d_y to that of the bias (y_width,), which follows."""
    for output in range(0, y_width, ROWS):
        for column in range(0, x_width, LANES):
            c0, c1, c2, c3 = _product(d_y, output, 1, y_width, x, x_start + column, x_width, rows)
            i = first + output * x_width + column
            store(sums, i, load(sums, i) + c0)
            store(sums, i + x_width, load(sums, i + x_width) + c1)
            store(sums, i + 2 * x_width, load(sums, i + 2 * x_width) + c2)
            store(sums, i + 3 * x_width, load(sums, i + 3 * x_width) + c3)
    bias = first + y_width * x_width
    for column in range(0, y_width, LANES):
        total = load(sums, bias + column)
        for row in range(rows):
            total = total + load(d_y, row * y_width + column)
        store(sums, bias + column, total)


# --- forward ---------------------------------------------------------------------------------------------


@inlined
def _encode(positions, latent, position_width, bands, latent_width, width, first_row, rows, count, encoded):
    """Write the encoded rows first_row .. first_row + rows - 1, zeros from row `count` on; width: of an encoded row."""
    half = position_width * bands
    for row in range(first_row, first_row + rows):
        start = row * width
        for column in range(width):
            encoded[start + column] = ZERO
        if row < count:
            for axis in range(position_width):
                angle = positions[row * position_width + axis] * np.float32(math.pi)
                for band in range(bands):
                    i = start + axis * bands + band
                    encoded[i], encoded[i + half] = math.sin(angle), math.cos(angle)
                    angle = angle + angle
            for column in range(latent_width):
                encoded[start + 2 * half + column] = latent[row * latent_width + column]


@kernel
def deform_kernel(
    counter, scratch, positions, latent, position_width, bands, latent_width, encoded_width, view, encoded_panels,
    panels2, bias2, panels3, bias3, head_panels, head_bias, outputs, count, encoded, x1, x2, x3, offsets,
):  # fmt: skip
    """Write the offsets (count, outputs), and what the backward pass needs: the encoded rows, and the hidden layers x1,
    x2 and x3, whose rows are padded to a multiple of 4.

    counter: index of the next block. scratch: workspace of a block's padded offsets. The module head explains the
    layers; all arrays are flat, and the weights packed.
    """
    head_width = head_bias.size
    while True:
        first_row = atomic_increment(counter) * BLOCK
        if first_row >= count:
            break
        end_row = min(first_row + BLOCK, count)
        rows = (end_row - first_row + ROWS - 1) // ROWS * ROWS
        start = first_row * HIDDEN
        _encode(positions, latent, position_width, bands, latent_width, encoded_width, first_row, rows, count, encoded)
        _apply_layer(encoded, first_row * encoded_width, encoded_width, encoded_panels, view, rows, HIDDEN, x1, start,
                     True)
        _apply_layer(x1, start, HIDDEN, panels2, bias2, rows, HIDDEN, x2, start, True)
        _apply_layer(x2, start, HIDDEN, panels3, bias3, rows, HIDDEN, x3, start, True)
        _apply_layer(x3, start, HIDDEN, head_panels, head_bias, rows, head_width, scratch, 0, False)
        for row in range(first_row, end_row):
            for column in range(outputs):
                offsets[row * outputs + column] = scratch[(row - first_row) * head_width + column]


# --- backward --------------------------------------------------------------------------------------------


@kernel
def deform_backward_kernel(
    counter, scratch, d_offsets, outputs, head_width, position_width, bands, latent_width, encoded_width, count,
    encoded, x1, x2, x3, encoded_panels, panels2, panels3, head_panels, sums, d_positions, d_latent,
):  # fmt: skip
    """Write the gradients of positions and latent codes, and add the gradients of weights and biases of each part of
    the Gaussians to its row of `sums` (parts, ...): of We and view, W2 and b2, W3 and b3, Wh and bh.

    counter: index of the next part. scratch: workspace. encoded, x1, x2, x3: of the forward pass. The panels are packed
    from the weights as they are, those of the forward pass from the transposed ones.
    """
    parts = sums.shape[0]
    d_output, d_a = scratch[: BLOCK * head_width], scratch[BLOCK * head_width :][: BLOCK * HIDDEN]
    d_b = scratch[BLOCK * (head_width + HIDDEN) :][: BLOCK * HIDDEN]
    d_encoded = scratch[BLOCK * (head_width + 2 * HIDDEN) :][: BLOCK * encoded_width]
    first2 = HIDDEN * (encoded_width + 1)
    first3 = first2 + HIDDEN * (HIDDEN + 1)
    first_head = first3 + HIDDEN * (HIDDEN + 1)
    half, blocks = position_width * bands, (count + BLOCK - 1) // BLOCK
    while True:
        part = atomic_increment(counter)
        if part >= parts:
            break
        totals = sums[part]
        for block in range(blocks * part // parts, blocks * (part + 1) // parts):
            first_row = block * BLOCK
            end_row = min(first_row + BLOCK, count)
            rows = (end_row - first_row + ROWS - 1) // ROWS * ROWS
            for i in range(rows * head_width):
                d_output[i] = ZERO
            for row in range(first_row, end_row):
                for column in range(outputs):
                    d_output[(row - first_row) * head_width + column] = d_offsets[row * outputs + column]
            start = first_row * HIDDEN
            _add_weight_gradient(d_output, head_width, x3, start, HIDDEN, rows, totals, first_head)
            _input_gradient(d_output, head_width, head_panels, rows, HIDDEN, d_a, x3, start, True)
            _add_weight_gradient(d_a, HIDDEN, x2, start, HIDDEN, rows, totals, first3)
            _input_gradient(d_a, HIDDEN, panels3, rows, HIDDEN, d_b, x2, start, True)
            _add_weight_gradient(d_b, HIDDEN, x1, start, HIDDEN, rows, totals, first2)
            _input_gradient(d_b, HIDDEN, panels2, rows, HIDDEN, d_a, x1, start, True)
            encoded_start = first_row * encoded_width
            _add_weight_gradient(d_a, HIDDEN, encoded, encoded_start, encoded_width, rows, totals, 0)
            _input_gradient(d_a, HIDDEN, encoded_panels, rows, encoded_width, d_encoded, encoded, encoded_start, False)
            for row in range(first_row, end_row):
                i = (row - first_row) * encoded_width
                for axis in range(position_width):
                    d_position, octave = ZERO, np.float32(math.pi)
                    for band in range(bands):
                        j = axis * bands + band
                        sine, cosine = encoded[row * encoded_width + j], encoded[row * encoded_width + half + j]
                        d_position += octave * (d_encoded[i + j] * cosine - d_encoded[i + half + j] * sine)
                        octave = octave + octave
                    d_positions[row * position_width + axis] = d_position
                for column in range(latent_width):
                    d_latent[row * latent_width + column] = d_encoded[i + 2 * half + column]


# --- autograd --------------------------------------------------------------------------------------------


class _Sizes(NamedTuple):
    """Widths of the network's rows: of a position, its bands, latent code, padded encoding, offsets, padded offsets;
    and the number of Gaussians."""

    position: int
    bands: int
    latent: int
    encoded: int
    outputs: int
    head: int
    gaussians: int


def _pad(width: int) -> int:
    """Round a width up to a multiple of 16."""
    return -(-width // LANES) * LANES


def _pack(matrix: Array) -> Array:
    """Return a matrix (depth, width) as flat panels of 16 columns each, padded by zeros."""
    depth, width = matrix.shape
    panels = np.zeros((_pad(width) // LANES, depth, LANES), np.float32)
    for panel in range(len(panels)):
        columns = matrix[:, panel * LANES : (panel + 1) * LANES]
        panels[panel, :, : columns.shape[1]] = columns
    return panels.ravel()


def _pad_rows(matrix: Array, rows: int) -> Array:
    """Return a matrix with rows of zeros appended, `rows` in all."""
    return matrix if len(matrix) == rows else np.concatenate([matrix, np.zeros((rows - len(matrix), matrix.shape[1]),
                                                                               np.float32)])


class _Deform(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, bands: int, positions: Tensor, latent: Tensor | None, view: Tensor, encoded_weight: Tensor,
        *parameters: Tensor,
    ) -> Tensor:  # fmt: skip
        """Return the offsets (n, outputs); the arguments are those of `deform`."""
        weight2, bias2, weight3, bias3, head_weight, head_bias = parameters
        count, outputs = len(positions), len(head_bias)
        latent_width = 0 if latent is None else latent.shape[1]
        sizes = _Sizes(positions.shape[1], bands, latent_width, _pad(encoded_weight.shape[1]), outputs, _pad(outputs),
                       count)
        we, w2, w3, wh = (w.detach().numpy() for w in (encoded_weight, weight2, weight3, head_weight))
        padded_bias = np.zeros(sizes.head, np.float32)
        padded_bias[:outputs] = flat(head_bias)
        rows = -(-count // ROWS) * ROWS
        encoded, *hidden = (buffers.empty(rows * width) for width in (sizes.encoded, HIDDEN, HIDDEN, HIDDEN))
        offsets, offsets_flat = buffers.tensor_and_array(count, outputs)
        parallel(
            deform_kernel, flat(positions), EMPTY if latent is None else flat(latent), *sizes[:4], flat(view),
            _pack(_pad_rows(we.T, sizes.encoded)), _pack(w2.T), flat(bias2), _pack(w3.T), flat(bias3), _pack(wh.T),
            padded_bias, outputs, count, encoded, *hidden, offsets_flat, scratch=BLOCK * sizes.head,
            limit=max(-(-count // BLOCK), 1),
        )  # fmt: skip
        ctx.save_for_backward(encoded_weight, weight2, weight3, head_weight)
        ctx.sizes, ctx.arrays = sizes, (encoded, *hidden)
        ctx.has_latent = latent is not None
        return offsets

    @staticmethod
    def backward(ctx: Any, d_offsets: Tensor) -> Any:
        sizes: _Sizes = ctx.sizes
        we, w2, w3, wh = (w.detach().numpy() for w in ctx.saved_tensors)
        shapes = ((HIDDEN, sizes.encoded), (HIDDEN, HIDDEN), (HIDDEN, HIDDEN), (sizes.head, HIDDEN))
        sums = np.zeros((torch.get_num_threads(), sum(rows * (width + 1) for rows, width in shapes)), np.float32)
        d_positions, d_positions_flat = buffers.tensor_and_array(sizes.gaussians, sizes.position)
        d_latent, d_latent_flat = (buffers.tensor_and_array(sizes.gaussians, sizes.latent) if ctx.has_latent
                                   else (None, EMPTY))
        parallel(
            deform_backward_kernel, flat(d_offsets), sizes.outputs, sizes.head, *sizes[:4], sizes.gaussians,
            *ctx.arrays, _pack(we), _pack(w2), _pack(w3), _pack(_pad_rows(wh, sizes.head)), sums, d_positions_flat,
            d_latent_flat,
            scratch=BLOCK * (sizes.head + 2 * HIDDEN + sizes.encoded),
        )  # fmt: skip
        total, gradients, first = sums.sum(0), [], 0
        for rows, width in shapes:
            gradients += [total[first : first + rows * width].reshape(rows, width),
                          total[first + rows * width : first + rows * (width + 1)]]
            first += rows * (width + 1)
        d_we, d_view, d_w2, d_b2, d_w3, d_b3, d_wh, d_bh = map(torch.from_numpy, gradients)
        return (None, d_positions, d_latent, d_view, d_we[:, : we.shape[1]].contiguous(), d_w2, d_b2, d_w3, d_b3,
                d_wh[: sizes.outputs], d_bh[: sizes.outputs])


def deform(positions: Tensor, latent: Tensor | None, bands: int, view: Tensor, encoded_weight: Tensor,
           layers: Sequence[tuple[Tensor, Tensor]]) -> Tensor | None:
    """Return the offsets (n, outputs) of n Gaussians, or None for a network of other layers than the module head's.

    positions: (n, d). latent: codes (n, c), or None. bands: octaves of the encoding. view: (128,), the view's part of
    the first layer, with its bias. encoded_weight: (128, 2 d bands + c). layers: weight and bias of the two other
    hidden layers and of the heads. Differentiable by every tensor.
    """
    widths = [tuple(weight.shape) for weight, _ in layers]
    if len(positions) == 0 or len(encoded_weight) != HIDDEN or widths[:-1] != [(HIDDEN, HIDDEN)] * 2:
        return None
    parameters = [part for layer in layers for part in layer]
    offsets: Tensor = _Deform.apply(bands, positions, latent, view, encoded_weight, *parameters)
    return offsets
