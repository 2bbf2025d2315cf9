# SPDX-License-Identifier: GPL-3.0-or-later
"""Transmittance of the Gaussians between cameras and lights, forward and backward; the definition is
`core.flare.visibility`.

A small camera looks along each line of sight. Each pixel of its picture gets the product of 1 - alpha over the
Gaussians that may hide the light. A product has no order, so nothing is sorted or put into tiles. The result is the
mean over a soft disk. `ellipse` has alpha and its gradients. With w the weight of a pixel in the disk, T its product,
and V the result,

    dV / d ln alpha = -w T alpha / (1 - alpha)

T is at least T_LEAST, the least that a rasterizer leaves behind opaque Gaussians. So behind many layers, which hide a
light altogether, the logarithm of V still has a gradient by each of them.

Arguments of the kernels:

    means, quats, scales, opacities   raw, see `rasterization`; flat
    lines      (m, LINE): packed cameras, and the offsets below
    size       pixels of a side of the picture
    pixels     (2, p) x and y of the pixel centres, px; p: size² rounded up to whole vectors
"""
from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...conventions.pixel_grid import DILATION
from .. import rendering
from . import buffers
from .buffers import Array
from .compilation import inlined, kernel
from .ellipse import (
    CAMERA,
    NEAR,
    axes_backward,
    ellipses,
    load_opacities,
    mean_gradient,
    opacity_gradient,
    pack_camera,
    project_axes,
    to_camera,
)
from .layout import ALPHA_MIN, ONE, OPACITY, OPACITY_MAX, RECORD, ZERO, A, D, G, K, X, Y
from .raster_forward import POWER_MIN
from .stepping import add_gradients
from .threads import parallel
from .tiles import flat
from .vector import (
    LANES,
    any_of,
    atomic_increment,
    exp,
    exp2_unclamped,
    fma,
    lane_index,
    load,
    load3,
    load4,
    load_rows,
    load_scalar,
    maximum,
    minimum,
    reduce_add_each,
    splat,
    sqrt,
    store,
    store3,
    store4,
    store_rows,
    transpose,
    where,
)

FAR_DEPTH, CONE_SLOPE, CENTRE, MAX_DISTANCE2, LINE = CAMERA, CAMERA + 1, CAMERA + 2, CAMERA + 5, CAMERA + 6
"""Offsets of a line behind its packed camera, and its length: depth beyond which nothing hides the light, slope of the
cone about the line, centre of the far sphere, squared distance from it beyond which nothing hides the light."""
HIDES = OPACITY + 1
"""Field of a record, here 1 for a Gaussian that may hide the light and 0 for others."""
REACH = np.float32(rendering.OCCLUDER_REACH)
T_LEAST = np.float32(rendering.TRANSMITTANCE_MIN * (1 - rendering.OPACITY_MAX))
"""Least transmittance of a pixel."""
GAUSSIANS_PER_TASK = 1 << 12
"""Gaussians that a thread processes at a time: a chunk."""
SQUARE = LANES * LANES


@inlined
def _find_occluders(means, scales, line, first, is_new):
    """Return which of the 16 Gaussians from `first` on may hide the light: those in front of it, near enough to the
    line. is_new: lanes that count."""
    x, y, z = load3(means, first)
    across, down, depth = to_camera(line, (x, y, z))
    scale_x, scale_y, scale_z = load3(scales, first)
    reach = exp(maximum(maximum(scale_x, scale_y), scale_z)) * REACH
    far_x, far_y, far_z = x - line[CENTRE], y - line[CENTRE + 1], z - line[CENTRE + 2]
    distance2 = fma(far_x, far_x, fma(far_y, far_y, far_z * far_z))
    is_between = (depth > line[NEAR]) & (depth < line[FAR_DEPTH]) & (distance2 <= line[MAX_DISTANCE2])
    is_near_line = sqrt(fma(across, across, down * down)) < fma(depth, splat(line[CONE_SLOPE]), reach)
    return is_between & is_near_line & is_new


@inlined
def _write_records(means, quats, scales, opacities, line, size, first, hides, records):
    """Write records of the 16 Gaussians from `first` on, seen by a line's camera; return their axes and opacities.

    Fields X, Y, A, K, D, OPACITY and HIDES alone. hides: from `_find_occluders`."""
    axes = project_axes(means, quats, scales, True, line, first)
    opacity = load_opacities(opacities, first, True)
    clamped = minimum(splat(OPACITY_MAX), opacity)
    e = ellipses(axes, clamped, line, size, size)
    zero = splat(ZERO)
    store_rows(records, 0, RECORD, transpose((
        e.x, e.y, e.major, e.k, e.minor, clamped, where(hides & e.is_visible, splat(ONE), zero),
        zero, zero, zero, zero, zero, zero, zero, zero, zero,
    )))  # fmt: skip
    return axes, opacity


@inlined
def _alphas(records, record, pixels, i):
    """Return alpha of a Gaussian at the 16 pixels from `i` on, and their u and d_y (`ellipse`)."""
    dy = load(pixels[1], i) - load_scalar(records, record + Y)
    u = fma(dy, splat(load_scalar(records, record + K)), load(pixels[0], i) - load_scalar(records, record + X))
    power = fma(u * load_scalar(records, record + A), u, load_scalar(records, record + D) * dy * dy)
    e = where(power > POWER_MIN, exp2_unclamped(power), ZERO) * load_scalar(records, record + OPACITY)
    return where(e >= ALPHA_MIN, e, ZERO), u, dy


@inlined
def _chunk_bounds(chunk, chunks, n):
    """Return the first Gaussian of a chunk, and the one after its last; a remainder below 16 joins the last chunk."""
    return chunk * GAUSSIANS_PER_TASK, n if chunk == chunks - 1 else (chunk + 1) * GAUSSIANS_PER_TASK


@kernel
def transmittance_kernel(counter, records, means, quats, scales, opacities, lines, size, pixels, chunks, products):
    """Write the product of 1 - alpha of each chunk of Gaussians at each pixel, for each line; (m, chunks, p), flat.

    counter: index of the next task; records: workspace of SQUARE numbers. The module head lists the others."""
    n, width = opacities.size, pixels.shape[1]
    while True:
        task = atomic_increment(counter)
        if task >= len(lines) * chunks:
            break
        line, target = lines[task // chunks], task * width
        for i in range(0, width, LANES):
            store(products, target + i, splat(ONE))
        start, end = _chunk_bounds(task % chunks, chunks, n)
        for block in range(start, end, LANES):
            first = min(block, n - LANES)  # the last block overlaps the one before
            hides = _find_occluders(means, scales, line, first, lane_index() >= np.float32(block - first))
            if any_of(hides):
                _write_records(means, quats, scales, opacities, line, size, first, hides, records)
                for record in range(0, SQUARE, RECORD):
                    if load_scalar(records, record + HIDES) > ZERO:
                        for i in range(0, width, LANES):
                            alpha, _, _ = _alphas(records, record, pixels, i)
                            store(products, target + i, load(products, target + i) * (ONE - alpha))


@inlined
def _moments(records, record, pixels, weights):
    """Return a row of gradients of one Gaussian (`layout`), from G_U to G; weights (p,): dL/dT T by pixel."""
    zero = splat(ZERO)
    s_u, s_y, s_uu, s_uy, s_yy, s = zero, zero, zero, zero, zero, zero
    for i in range(0, pixels.shape[1], LANES):
        alpha, u, dy = _alphas(records, record, pixels, i)
        g = -load(weights, i) * alpha / (ONE - alpha)
        g_u, g_y = g * u, g * dy
        s_u, s_y, s = s_u + g_u, s_y + g_y, s + g
        s_uu, s_uy, s_yy = fma(g_u, u, s_uu), fma(g_u, dy, s_uy), fma(g_y, dy, s_yy)
    return reduce_add_each((s_u, s_y, s_uu, s_uy, s_yy, s))


@inlined
def _accumulate3(array, first, mask, values):
    """Add vectors x, y and z, where the mask is true, to 16 rows of an array (n, 3)."""
    x, y, z = load3(array, first)
    store3(array, first, (x + where(mask, values[0], ZERO), y + where(mask, values[1], ZERO),
                          z + where(mask, values[2], ZERO)))


@inlined
def _accumulate4(array, first, mask, values):
    """Add vectors w, x, y and z, where the mask is true, to 16 rows of an array (n, 4)."""
    w, x, y, z = load4(array, first)
    store4(array, first, (w + where(mask, values[0], ZERO), x + where(mask, values[1], ZERO),
                          y + where(mask, values[2], ZERO), z + where(mask, values[3], ZERO)))


@kernel
def transmittance_backward_kernel(
    counter, scratch, means, quats, scales, opacities, lines, size, pixels, chunks, weights,
    d_means, d_quats, d_scales, d_opacities,
):  # fmt: skip
    """Write the gradients d_... of the parameters; weights (m, p): dL/dT T of each line and pixel.

    counter: index of the next chunk; scratch: workspace of 2 SQUARE numbers. The module head lists the others."""
    n = opacities.size
    records, rows = scratch[:SQUARE], scratch[SQUARE : 2 * SQUARE]
    zero = splat(ZERO)
    while True:
        chunk = atomic_increment(counter)
        if chunk >= chunks:
            break
        start, end = _chunk_bounds(chunk, chunks, n)
        d_means[3 * start : 3 * end], d_quats[4 * start : 4 * end] = ZERO, ZERO
        d_scales[3 * start : 3 * end], d_opacities[start:end] = ZERO, ZERO
        for number in range(len(lines)):
            line = lines[number]
            for block in range(start, end, LANES):
                first = min(block, n - LANES)
                hides = _find_occluders(means, scales, line, first, lane_index() >= np.float32(block - first))
                if any_of(hides):
                    axes, opacity = _write_records(
                        means, quats, scales, opacities, line, size, first, hides, records
                    )
                    for record in range(0, SQUARE, RECORD):
                        is_occluder = load_scalar(records, record + HIDES) > ZERO
                        store(rows, record, _moments(records, record, pixels, weights[number]) if is_occluder else zero)
                    fields = transpose(load_rows(rows, 0, LANES))
                    gradients = axes_backward(axes, fields, line, True, zero)
                    d_mean = mean_gradient(gradients.point, line, (zero, zero, zero))
                    _accumulate3(d_means, first, hides, d_mean)
                    _accumulate3(d_scales, first, hides, gradients.scale)
                    _accumulate4(d_quats, first, hides, gradients.quaternion)
                    d_opacity = where(hides, opacity_gradient(opacity, fields[G], True), ZERO)
                    store(d_opacities, first, load(d_opacities, first) + d_opacity)


class _MeanTransmittances(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, lines: Array, disk: Tensor, *parameters: Tensor) -> Tensor:
        """Return (m,), the mean transmittances; lines (m, LINE), disk (size, size): weights of the
        pixels, parameters of the Gaussians."""
        n, size = len(parameters[0]), len(disk)
        chunks = max(1, n // GAUSSIANS_PER_TASK + (n % GAUSSIANS_PER_TASK >= LANES))
        pixels, weights = _pixel_centres(size), _pad(disk.numpy().ravel())
        arrays = tuple(map(flat, parameters))
        products = buffers.empty(len(lines) * chunks * len(weights))
        parallel(transmittance_kernel, *arrays, lines, size, pixels, chunks, products, scratch=SQUARE,
                 limit=len(lines) * chunks)
        weighted = np.maximum(products.reshape(len(lines), chunks, len(weights)).prod(1), T_LEAST) * weights
        ctx.save_for_backward(*parameters)
        ctx.lines, ctx.size, ctx.chunks, ctx.weighted = lines, size, chunks, weighted
        return torch.from_numpy(weighted.sum(1))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        parameters = ctx.saved_tensors
        weights = ctx.weighted * gradient.numpy()[:, None]
        gradients, arrays = zip(*(buffers.tensor_and_array(*part.shape) for part in parameters), strict=True)
        parallel(transmittance_backward_kernel, *map(flat, parameters), ctx.lines, ctx.size, _pixel_centres(ctx.size),
                 ctx.chunks, weights, *arrays, scratch=2 * SQUARE, limit=ctx.chunks)
        if add_gradients(parameters, gradients):
            return (None,) * (2 + len(parameters))
        return (None, None, *gradients)


def mean_transmittances(
    means: Tensor, quaternions: Tensor, log_scales: Tensor, opacity_logits: Tensor, poses: Tensor, intrinsics: Tensor,
    weights: Tensor, depths: Tensor, slope: float, centre: tuple[float, ...], max_distance: float,
) -> Tensor | None:  # fmt: skip
    """Return the mean transmittances (m,), 0..1, of n Gaussians along m lines of sight; None for fewer than 16
    Gaussians.

    means (n, 3), quaternions (n, 4), log_scales (n, 3), opacity_logits (n,): as of `SceneGaussians`. poses (m, 4, 4),
    world to camera, and intrinsics (3, 3), px: of the small cameras. weights (size, size): of the pixels of a picture;
    they sum to 1. A Gaussian counts if it lies between the two depths (m, 2), nearer to the line than `slope` times its
    depth plus OCCLUDER_REACH of its largest standard deviations, and within max_distance of `centre`. Lengths are in
    world units. Differentiable by the Gaussians.
    """
    if len(means) < LANES:
        return None
    size, lines = len(weights), np.empty((len(poses), LINE), np.float32)
    for line, pose, (near, far) in zip(lines, poses, depths.tolist(), strict=True):
        pack_camera(flat(pose), flat(intrinsics), size, size, near, DILATION, line[:CAMERA])
        line[FAR_DEPTH] = far
    lines[:, CONE_SLOPE], lines[:, MAX_DISTANCE2] = slope, max_distance**2
    lines[:, CENTRE : CENTRE + 3] = centre
    result: Tensor = _MeanTransmittances.apply(lines, weights, means, quaternions, log_scales, opacity_logits)
    return result


def _pad(values: Array) -> Array:
    """Return an array with zeros behind it, up to whole vectors."""
    return np.pad(values, (0, -values.size % LANES)).astype(np.float32)


@lru_cache(8)
def _pixel_centres(size: int) -> Array:
    """Return (2, p), x and y of the pixel centres of a square picture, row by row, px."""
    y, x = np.mgrid[:size, :size] + 0.5
    return np.stack([_pad(x.ravel()), _pad(y.ravel())])
